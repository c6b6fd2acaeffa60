//! Timing of a camera's frames: intervals, jitter and latency.

use std::time::Instant;

/// Intervals and latency of one camera, as means over about its last hundred frames.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Timing {
    /// Capture time of the last frame, nanoseconds.
    last_nanos: Option<i64>,
    /// Intervals in the means.
    frames: f64,
    pub interval_ms: f64,
    /// Mean square of the difference from the mean interval, square milliseconds.
    pub variance: f64,
    /// Mean time from capture to ingestion.
    pub lateness_ms: f64,
    /// Arrival of the last frame.
    pub arrived: Option<Instant>,
}

impl Timing {
    /// Frames after which a frame's share in the means has faded.
    const MEMORY: f64 = 100.0;

    /// Adds a frame with its capture time and the current time, nanoseconds on one clock.
    pub fn add(&mut self, capture_nanos: i64, now_nanos: i64) {
        self.arrived = Some(Instant::now());
        if let Some(last) = self.last_nanos.replace(capture_nanos) {
            self.frames = (self.frames + 1.0).min(Self::MEMORY);
            let interval = capture_nanos.saturating_sub(last) as f64 * 1e-6;
            let off = interval - self.interval_ms;
            self.interval_ms += off / self.frames;
            self.variance += (off * off * (1.0 - 1.0 / self.frames) - self.variance) / self.frames;
            self.lateness_ms +=
                (now_nanos.saturating_sub(capture_nanos) as f64 * 1e-6 - self.lateness_ms) / self.frames;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_jitter_and_lateness_are_means() {
        let mut timing = Timing::default();
        for n in 0..1000i64 {
            let capture = n * 33_000_000 + if n % 2 == 0 { 1_000_000 } else { 0 };
            timing.add(capture, capture + 7_000_000);
        }
        assert!((timing.interval_ms - 33.0).abs() < 0.1, "{timing:?}");
        // Intervals are 32 and 34 in turn.
        assert!((timing.variance.sqrt() - 1.0).abs() < 0.1, "{timing:?}");
        assert!((timing.lateness_ms - 7.0).abs() < 1e-6, "{timing:?}");
        timing.add(i64::MIN, i64::MAX);
        timing.add(i64::MAX, i64::MIN);
        assert!(timing.variance.is_finite());
    }
}
