//! Frame rate of a camera, compared with that of its mode.

use std::collections::VecDeque;

use flyrig_types::Frame;

/// Time over which the rate is measured, nanoseconds.
const WINDOW: i64 = 3_000_000_000;
/// Least interval between remembered frames, nanoseconds: bounds their number.
const SAMPLE: i64 = 100_000_000;
/// Interval after which the measurement starts anew, in periods of the mode, and at least in nanoseconds: the camera paused, or was lost.
const PAUSE_PERIODS: f64 = 5.0;
const PAUSE: f64 = 0.5e9;
/// Ratio to the mode's rate below which a camera is slow.
const SLOW_BELOW: f64 = 0.7;

/// Frame rate of a camera over the last three seconds, by the frames' own numbers and times: frames lost on their way count as captured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameRate {
    /// Rate of the camera's mode, frames per second.
    pub mode_fps: f64,
    /// Measured rate, frames per second.
    pub measured_fps: f64,
}

impl FrameRate {
    /// Returns the measured rate over that of the mode.
    #[must_use]
    pub fn ratio(&self) -> f64 {
        self.measured_fps / self.mode_fps
    }

    /// Returns whether the camera captures less than 0.7 of its mode's frames, as with an exposure longer than its period.
    #[must_use]
    pub fn is_slow(&self) -> bool {
        self.ratio() < SLOW_BELOW
    }
}

/// Meter of a camera's rate.
#[derive(Debug)]
pub(super) struct RateMeter {
    /// Capture time and sequence number of frames at least [`SAMPLE`] apart; the first is the newest that is [`WINDOW`] old.
    samples: VecDeque<(i64, u64)>,
    /// Capture time and sequence number of the last frame.
    last: Option<(i64, u64)>,
}

impl RateMeter {
    pub fn new() -> Self {
        Self { samples: VecDeque::with_capacity((WINDOW / SAMPLE) as usize + 4), last: None }
    }

    /// Forgets all frames: the camera was lost.
    pub fn reset(&mut self) {
        self.samples.clear();
        self.last = None;
    }

    /// Adds a frame; returns the rate once the frames span the window. `mode_fps` is the rate of the mode where it is known.
    pub fn add(&mut self, frame: &Frame, mode_fps: Option<f64>) -> Option<FrameRate> {
        let (nanos, sequence) = (frame.capture_nanos, frame.sequence);
        let pause = mode_fps.map_or(PAUSE, |fps| PAUSE.max(PAUSE_PERIODS * 1e9 / fps));
        let goes_on = |(before, number): (i64, u64)| {
            sequence > number && nanos > before && (nanos.abs_diff(before) as f64) < pause
        };
        if !self.last.is_some_and(goes_on) {
            self.samples.clear();
        }
        self.last = Some((nanos, sequence));
        if self.samples.back().is_none_or(|(at, _)| nanos.saturating_sub(*at) >= SAMPLE) {
            self.samples.push_back((nanos, sequence));
        }
        while self.samples.get(1).is_some_and(|(at, _)| nanos.saturating_sub(*at) >= WINDOW) {
            self.samples.pop_front();
        }
        let &(at, number) = self.samples.front()?;
        let (mode_fps, span) = (mode_fps?, nanos.saturating_sub(at));
        let measured_fps = sequence.saturating_sub(number) as f64 / (span as f64 * 1e-9);
        (span >= WINDOW).then_some(FrameRate { mode_fps, measured_fps })
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Image, PixelFormat};

    use super::*;

    const FPS: f64 = 30.0;

    /// Camera whose rate the test changes.
    struct Camera {
        meter: RateMeter,
        nanos: i64,
        sequence: u64,
    }

    impl Camera {
        fn new() -> Self {
            Self { meter: RateMeter::new(), nanos: 0, sequence: 0 }
        }

        /// Captures for `secs` at `fps`, of which every `kept`th frame arrives; returns the rates at their times.
        fn run(&mut self, secs: f64, fps: f64, kept: u64) -> Vec<(f64, Option<FrameRate>)> {
            let (start, mut rates) = (self.nanos, Vec::new());
            while ((self.nanos - start) as f64) < secs * 1e9 {
                self.nanos += (1e9 / fps) as i64;
                self.sequence += 1;
                if !self.sequence.is_multiple_of(kept) {
                    continue;
                }
                let image = Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap();
                let frame = Frame {
                    camera: "a".into(),
                    sequence: self.sequence,
                    capture_nanos: self.nanos,
                    exposure_nanos: None,
                    image,
                    mask: None,
                };
                rates.push(((self.nanos - start) as f64 * 1e-9, self.meter.add(&frame, Some(FPS))));
            }
            rates
        }
    }

    fn is_slow(rate: Option<FrameRate>) -> bool {
        rate.is_some_and(|rate| rate.is_slow())
    }

    #[test]
    fn a_slow_camera_is_flagged_within_three_seconds_and_no_longer() {
        for share in [0.5, 0.25, 0.68] {
            let mut camera = Camera::new();
            assert!(camera.run(10.0, FPS, 1).iter().all(|(_, rate)| !is_slow(*rate)));
            let slow = camera.run(10.0, share * FPS, 1);
            let since = slow.iter().find(|(_, rate)| is_slow(*rate)).unwrap().0;
            assert!(since <= 3.0, "{share}: {since} s");
            assert!(
                slow.iter()
                    .filter(|(at, _)| *at > 3.2)
                    .all(|(_, rate)| { is_slow(*rate) && (rate.unwrap().ratio() - share).abs() < 0.02 })
            );
            let back = camera.run(10.0, FPS, 1);
            let until = back.iter().rfind(|(_, rate)| is_slow(*rate)).unwrap().0;
            assert!(until <= 3.0, "{share}: {until} s");
        }
        // Three quarters of the rate are no alarm.
        assert!(Camera::new().run(10.0, 0.75 * FPS, 1).iter().all(|(_, rate)| !is_slow(*rate)));
    }

    #[test]
    fn a_start_a_pause_and_lost_frames_are_no_alarm() {
        let mut camera = Camera::new();
        let first = camera.run(5.0, FPS, 1);
        assert!(first.iter().all(|(at, rate)| rate.is_some() == (*at > 3.05)), "{first:?}");
        // The driver or the network loses two of three frames.
        assert!(camera.run(10.0, FPS, 3).iter().all(|(_, rate)| !is_slow(*rate)));
        for pause in [700_000_000, 2_000_000_000, 60_000_000_000] {
            camera.nanos += pause;
            assert!(camera.run(5.0, FPS, 1).iter().all(|(_, rate)| !is_slow(*rate)), "{pause} ns");
        }
        camera.meter.reset();
        assert_eq!(camera.run(1.0, FPS, 1).last().unwrap().1, None);
    }

    #[test]
    fn modes_and_numbers_may_be_anything() {
        let mut meter = RateMeter::new();
        let image = || Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap();
        for (n, nanos) in [0, i64::MAX, i64::MIN, 1, 2, i64::MAX - 1].into_iter().cycle().take(5000).enumerate() {
            let sequence = (n as u64).wrapping_mul(u64::MAX / 3);
            let frame = Frame {
                camera: "a".into(),
                sequence,
                capture_nanos: nanos,
                exposure_nanos: None,
                image: image(),
                mask: None,
            };
            assert!(!is_slow(meter.add(&frame, [None, Some(1e-9), Some(1e9)][n % 3])));
            assert!(meter.samples.len() < 40);
        }
    }
}
