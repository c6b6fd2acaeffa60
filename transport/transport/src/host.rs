//! Identity and clocks of this host.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// One moment by the clocks of this host.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moment {
    pub instant: Instant,
    /// Clock that no setting of the time moves, nanoseconds.
    pub monotonic_nanos: i64,
    /// Wall clock, nanoseconds since 1970.
    pub unix_nanos: i64,
}

impl Moment {
    pub(crate) fn now() -> Self {
        Self { instant: Instant::now(), monotonic_nanos: monotonic_nanos(), unix_nanos: unix_nanos() }
    }
}

/// Returns the wall clock, nanoseconds since 1970. It may be set at any time, so it only informs people.
pub(crate) fn unix_nanos() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// Returns `CLOCK_MONOTONIC`, nanoseconds: the same for all programs of this host, and never set.
#[cfg(target_os = "linux")]
pub(crate) fn monotonic_nanos() -> i64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
}

/// Returns the nanoseconds since the first call, at least 1.
#[cfg(not(target_os = "linux"))]
pub(crate) fn monotonic_nanos() -> i64 {
    static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
    i64::try_from(START.get_or_init(Instant::now).elapsed().as_nanos()).unwrap_or(i64::MAX).max(1)
}

/// Returns a number that identifies this host since its last boot; 0 where the system has none.
pub(crate) fn host_id() -> u64 {
    std::fs::read("/proc/sys/kernel/random/boot_id").map_or(0, |id| fnv1a(&id))
}

/// Hashes bytes by FNV-1a, 64 bits: the same on every machine, not for security.
pub(crate) fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &b| (hash ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}
