//! Conversion of driver timestamps to the middle of the exposure on `CLOCK_MONOTONIC`, robust to implausible ones.

/// Instant that a frame's timestamp refers to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StampSource {
    /// Start of the exposure on `CLOCK_MONOTONIC` (for USB cameras: arrival of the first packet).
    #[cfg_attr(not(target_os = "linux"), expect(dead_code))]
    StartOfExposure,
    /// Arrival of the last pixel on `CLOCK_MONOTONIC`.
    EndOfFrame,
    /// Another clock, or no timestamp.
    Other,
}

/// Maximum age of a plausible timestamp at its frame's arrival, beyond the exposure, nanoseconds.
const OLDEST: i64 = 1_000_000_000;
/// Maximum lead of a plausible timestamp over its frame's arrival, nanoseconds: the clocks are read one after the
/// other.
const NEWEST: i64 = 5_000_000;
/// Consecutive timestamps with a constant offset that prove another clock instead of a glitch.
const CONFIRMATIONS: u32 = 8;
/// Tolerance of that constant offset, nanoseconds: arrivals on a busy machine are uneven.
const AGREEMENT: u64 = 150_000_000;

/// Converter from timestamps to capture times.
///
/// An implausible timestamp (far from its frame's arrival) is replaced by the arrival. When timestamps keep a constant
/// offset, as after a step of the driver's clock, that offset is subtracted from then on.
#[derive(Debug, Default)]
pub(crate) struct Stamps {
    /// Correction added to the driver's clock.
    offset_nanos: i64,
    suspect: Option<Suspect>,
    /// Number of replaced timestamps.
    pub replaced: u64,
    last_nanos: Option<i64>,
}

/// Run of recent implausible timestamps.
#[derive(Debug, Clone, Copy)]
struct Suspect {
    /// Smallest and largest offset, nanoseconds.
    least: i64,
    most: i64,
    times: u32,
    last_stamp: i64,
}

impl Stamps {
    /// Returns the middle of the exposure of the middle row, nanoseconds. `half` is half of exposure and readout
    /// together, nanoseconds.
    pub fn capture_nanos(&mut self, stamp_nanos: i64, source: StampSource, arrival_nanos: i64, half: i64) -> i64 {
        let capture = match source {
            StampSource::Other => arrival_nanos.saturating_sub(half),
            source => {
                // A stamp of the start lies a whole exposure before the arrival.
                let oldest = OLDEST.saturating_add(half.saturating_mul(2));
                let stamp = self.believed(stamp_nanos, arrival_nanos, oldest);
                if source == StampSource::StartOfExposure {
                    stamp.saturating_add(half)
                } else {
                    stamp.saturating_sub(half)
                }
            }
        };
        // A frame is later than the one before, whatever its stamp says.
        let capture = self.last_nanos.map_or(capture, |last| capture.max(last.saturating_add(1)));
        self.last_nanos = Some(capture);
        capture
    }

    fn believed(&mut self, stamp_nanos: i64, arrival_nanos: i64, oldest: i64) -> i64 {
        // Modulo 2^64, since drivers' clocks may wrap.
        let stamp = stamp_nanos.wrapping_add(self.offset_nanos);
        if (-NEWEST..=oldest).contains(&arrival_nanos.wrapping_sub(stamp)) {
            self.suspect = None;
            return stamp;
        }
        self.replaced += 1;
        let off = arrival_nanos.wrapping_sub(stamp_nanos);
        let fresh = Suspect { least: off, most: off, times: 1, last_stamp: stamp_nanos };
        let suspect = self.suspect.map_or(fresh, |before| {
            let (least, most) = (off.min(before.least), off.max(before.most));
            // A stuck clock is off by ever more.
            let advances = stamp_nanos.wrapping_sub(before.last_stamp) > 0;
            if advances && most.abs_diff(least) <= AGREEMENT {
                Suspect { least, most, times: before.times + 1, last_stamp: stamp_nanos }
            } else {
                fresh
            }
        });
        self.suspect = Some(suspect);
        if suspect.times >= CONFIRMATIONS {
            // The least is nearest to the truth: arrivals are only ever late.
            (self.offset_nanos, self.suspect) = (suspect.least, None);
            return stamp_nanos.wrapping_add(suspect.least);
        }
        arrival_nanos
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const SECOND: i64 = 1000 * MS;

    /// Feeds frames that arrive 8 ms after their true timestamp; returns the error of each capture time, nanoseconds.
    fn errors(stamps: &mut Stamps, frames: i64, stamp: impl Fn(i64, i64) -> i64) -> Vec<i64> {
        (0..frames)
            .map(|n| {
                let truth = 1000 * SECOND + n * 33 * MS;
                stamps.capture_nanos(stamp(n, truth), StampSource::EndOfFrame, truth + 8 * MS, 0) - truth
            })
            .collect()
    }

    #[test]
    fn the_middle_of_the_exposure_lies_after_its_start_and_before_its_end() {
        let at = |source| Stamps::default().capture_nanos(100 * MS, source, 108 * MS, 5 * MS);
        assert_eq!(at(StampSource::StartOfExposure), 105 * MS);
        assert_eq!(at(StampSource::EndOfFrame), 95 * MS);
        assert_eq!(at(StampSource::Other), 103 * MS, "without a stamp the arrival is the end");
    }

    #[test]
    fn sound_stamps_are_taken_as_they_are() {
        let mut stamps = Stamps::default();
        assert!(errors(&mut stamps, 1000, |_, truth| truth).iter().all(|&error| error == 0));
        assert_eq!(stamps.replaced, 0);
    }

    #[test]
    fn single_wild_stamps_cost_their_latency_alone() {
        for wild in [i64::MAX, i64::MIN, 0, 2_000_000 * SECOND] {
            let mut stamps = Stamps::default();
            let errors = errors(&mut stamps, 100, |n, truth| if n == 50 { wild } else { truth });
            assert_eq!((errors[49], errors[50], errors[51], stamps.replaced), (0, 8 * MS, 0, 1));
        }
    }

    #[test]
    fn a_step_of_the_clock_is_learnt_and_its_undoing_too() {
        for step in [10 * SECOND, -10 * SECOND] {
            let mut stamps = Stamps::default();
            let errors = errors(&mut stamps, 300, |n, t| if (100..200).contains(&n) { t + step } else { t });
            assert!(errors.iter().all(|error| (0..=8 * MS).contains(error)), "{errors:?}");
            assert!(errors[110..200].iter().all(|&error| error == 8 * MS), "the unknown latency stays, without jitter");
            assert_eq!(stamps.replaced, 2 * u64::from(CONFIRMATIONS));
        }
    }

    #[test]
    fn a_clock_that_wraps_and_an_uneven_machine_are_borne() {
        let mut stamps = Stamps::default();
        let truth = |n: i64| 1000 * SECOND + n * 33 * MS;
        let errors: Vec<i64> = (0..300)
            .map(|n| {
                let stamp = truth(n).wrapping_add(i64::MAX - truth(150));
                let late = (3 + 100 * (n % 7) / 7) * MS;
                stamps.capture_nanos(stamp, StampSource::EndOfFrame, truth(n) + late, 0) - truth(n)
            })
            .collect();
        assert!(errors[10..].iter().all(|&error| error == 3 * MS), "{:?}", &errors[..20]);
        assert_eq!(stamps.replaced, u64::from(CONFIRMATIONS));
    }

    #[test]
    fn a_stuck_clock_is_never_believed() {
        let mut stamps = Stamps::default();
        let errors = errors(&mut stamps, 300, |_, _| 5);
        assert!(errors.iter().all(|&error| error == 8 * MS));
        assert_eq!(stamps.replaced, 300);
    }

    #[test]
    fn times_grow_whatever_comes() {
        let mut stamps = Stamps::default();
        let mut last = i64::MIN;
        for (n, stamp) in [0, i64::MAX, i64::MIN, 5, 5, -1, i64::MAX].into_iter().cycle().take(500).enumerate() {
            let now = stamps.capture_nanos(stamp, StampSource::EndOfFrame, n as i64 * MS, 5);
            assert!(now > last);
            last = now;
        }
        stamps.capture_nanos(0, StampSource::StartOfExposure, i64::MAX, i64::MAX);
        stamps.capture_nanos(0, StampSource::EndOfFrame, i64::MIN, i64::MAX);
    }
}
