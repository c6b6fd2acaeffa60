//! Identity and wall clock of this host.

use std::time::{SystemTime, UNIX_EPOCH};

/// Returns the wall clock, nanoseconds since 1970.
pub(crate) fn unix_nanos() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// Returns a number that identifies this host since its last boot; 0 where the system has none.
pub(crate) fn host_id() -> u64 {
    std::fs::read("/proc/sys/kernel/random/boot_id").map_or(0, |id| fnv1a(&id))
}

/// Hashes bytes by FNV-1a, 64 bits: the same on every machine, not for security.
pub(crate) fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &b| (hash ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}
