//! The clock of live frames.

/// Time of `CLOCK_MONOTONIC`, nanoseconds: the clock of live frames' capture times.
#[cfg(target_os = "linux")]
pub use crate::v4l2::monotonic_nanos;

/// Nanoseconds since this was asked first, by a clock that never steps: the clock of live frames' capture times.
#[cfg(not(target_os = "linux"))]
#[must_use]
pub fn monotonic_nanos() -> i64 {
    static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    let start = START.get_or_init(std::time::Instant::now);
    i64::try_from(start.elapsed().as_nanos()).unwrap_or(i64::MAX)
}
