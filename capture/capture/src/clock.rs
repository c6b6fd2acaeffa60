//! Clock of live frames.

/// Returns the time of `CLOCK_MONOTONIC`, nanoseconds: the clock of the capture times of live frames.
#[cfg(target_os = "linux")]
pub use crate::v4l2::monotonic_nanos;

/// Returns the nanoseconds since the first call, by a clock that never steps: the clock of the capture times of live
/// frames.
#[cfg(not(target_os = "linux"))]
#[must_use]
pub fn monotonic_nanos() -> i64 {
    static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    let start = START.get_or_init(std::time::Instant::now);
    i64::try_from(start.elapsed().as_nanos()).unwrap_or(i64::MAX)
}
