//! Processor time and memory of this process.

use std::time::Duration;

/// Returns the processor time of all threads of this process together: the cost of drawing where the graphics adapter is
/// software, independent of other programs.
#[must_use]
pub fn processor_time() -> Duration {
    let spent = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Duration::new(spent.tv_sec.unsigned_abs(), spent.tv_nsec.unsigned_abs().min(999_999_999) as u32)
}

/// Returns the resident memory of this process in MiB, on systems with /proc.
#[must_use]
pub fn resident_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    let kib: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib / 1024.0)
}

/// Lets threads share the pools of glibc's allocator: one for every two cores, at least two and at most eight. By default each of many
/// threads has its own, and what they free stays spread over all of them: a rig of three cameras then needs half as much memory again.
/// Leaves the number alone where the user has set one. Call it at the beginning of `main`. Does nothing with other allocators.
#[allow(unsafe_code)]
pub fn share_memory_pools() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        let is_set = std::env::var_os("MALLOC_ARENA_MAX").is_some()
            || std::env::var("GLIBC_TUNABLES").is_ok_and(|all| all.contains("glibc.malloc.arena_max"));
        if is_set {
            return;
        }
        let cores = std::thread::available_parallelism().map_or(2, std::num::NonZero::get);
        // SAFETY: the call takes two numbers, and may be made at any time.
        unsafe { libc::mallopt(libc::M_ARENA_MAX, (cores / 2).clamp(2, 8) as libc::c_int) };
    }
}

/// Returns to the system the memory that a large, short task has left free. Takes milliseconds, in which other threads that allocate may
/// wait. Does nothing with allocators other than glibc's.
#[allow(unsafe_code)]
pub(crate) fn release_free_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: the call takes a number, and may be made at any time from any thread.
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_plausible() {
        if let Some(mib) = resident_mib() {
            assert!(mib > 0.5 && mib < 1e6, "{mib}");
        }
    }
}
