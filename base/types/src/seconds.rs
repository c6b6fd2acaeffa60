//! Durations from seconds of settings, files and other programs.

use std::time::{Duration, Instant};

/// Longest duration of [`saturating_secs`], seconds: 100 years, which every `Instant` and `SystemTime` of today can be moved by.
const LONGEST: f64 = 100.0 * 365.25 * 86_400.0;

/// Returns a duration of `seconds`, clamped to 0 to 100 years; NaN is 0. `Duration::from_secs_f64` panics where this clamps, and an
/// `Instant` plus its result may panic too.
///
/// ```
/// use std::time::{Duration, Instant};
/// use flyrig_types::saturating_secs;
///
/// assert_eq!(saturating_secs(0.25), Duration::from_millis(250));
/// assert_eq!(saturating_secs(-1.0), Duration::ZERO);
/// assert_eq!(saturating_secs(f64::NAN), Duration::ZERO);
/// assert!(Instant::now() + saturating_secs(1.0 / 5e-324) > Instant::now());
/// ```
#[must_use]
pub fn saturating_secs(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds.clamp(0.0, LONGEST)).unwrap_or_default()
}

/// Returns the time `timeout` from now, at most 100 years ahead: `Duration::MAX` waits for ever, where `Instant::now() + timeout` panics.
///
/// ```
/// use std::time::{Duration, Instant};
///
/// assert!(flyrig_types::deadline_after(Duration::MAX) > Instant::now());
/// ```
#[must_use]
pub fn deadline_after(timeout: Duration) -> Instant {
    Instant::now() + timeout.min(saturating_secs(LONGEST))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_number_is_a_duration() {
        for seconds in [f64::NAN, f64::NEG_INFINITY, -1e300, -0.0, 5e-324, f64::MIN_POSITIVE] {
            assert_eq!(saturating_secs(seconds), Duration::ZERO, "{seconds}");
        }
        for seconds in [1e10, 1e20, f64::MAX, f64::INFINITY] {
            assert_eq!(saturating_secs(seconds), Duration::from_secs(LONGEST as u64), "{seconds}");
        }
        assert_eq!(saturating_secs(1.0 / 30.0), Duration::from_nanos(33_333_333));
    }
}
