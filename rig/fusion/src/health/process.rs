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
