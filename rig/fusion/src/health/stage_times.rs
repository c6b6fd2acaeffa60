//! Run times of stages, processor time and memory of the process.

use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

use flyrig_gpu::GpuTraffic;
use serde::Serialize;

use crate::stage_trace::{trace_adapter, trace_stage};

/// Run times of named stages over many frames; keeps the last 3600 samples of each.
#[derive(Debug, Default)]
pub struct StageTimes {
    stages: Vec<Stage>,
    counts: Vec<(&'static str, u64)>,
}

#[derive(Debug)]
struct Stage {
    name: &'static str,
    millis: Vec<f32>,
    next: usize,
}

/// Summary of one stage over the kept samples.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageSummary {
    /// Name of the stage; parts of a stage are indented by two spaces.
    pub name: String,
    /// Samples.
    pub frames: usize,
    /// Mean, milliseconds.
    pub mean_ms: f32,
    /// Median, milliseconds.
    pub p50_ms: f32,
    /// 95th percentile, milliseconds.
    pub p95_ms: f32,
    /// 99th percentile, milliseconds.
    pub p99_ms: f32,
}

impl StageTimes {
    /// Samples kept a stage: bounds the memory of a rig that runs for days.
    const WINDOW: usize = 3600;

    /// Adds one measurement of what has just ended.
    pub fn add(&mut self, name: &'static str, time: Duration) {
        trace_stage(name, time);
        self.push(name, time.as_secs_f32() * 1e3);
    }

    /// Adds a time that the graphics adapter measured.
    pub(crate) fn add_of_adapter(&mut self, name: &'static str, time: Duration) {
        trace_adapter(name, time);
        self.push(name, time.as_secs_f32() * 1e3);
    }

    /// Adds processor time, which is no part of a stage's run time.
    pub(crate) fn add_processor_time(&mut self, name: &'static str, time: Duration) {
        self.push(name, time.as_secs_f32() * 1e3);
    }

    fn push(&mut self, name: &'static str, millis: f32) {
        let stage = match self.stages.iter_mut().find(|stage| stage.name == name) {
            Some(stage) => stage,
            None => {
                self.stages.push(Stage { name, millis: Vec::new(), next: 0 });
                let last = self.stages.len() - 1;
                &mut self.stages[last]
            }
        };
        if stage.millis.len() < Self::WINDOW {
            stage.millis.push(millis);
        } else {
            stage.millis[stage.next] = millis;
        }
        stage.next = (stage.next + 1) % Self::WINDOW;
    }

    /// Measures a closure.
    pub fn time<T>(&mut self, name: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.add(name, start.elapsed());
        result
    }

    /// Adds the samples and counts of `other`.
    pub(crate) fn merge(&mut self, other: &Self) {
        for stage in &other.stages {
            stage.millis.iter().for_each(|millis| self.push(stage.name, *millis));
        }
        for &(name, by) in &other.counts {
            self.count(name, by);
        }
    }

    /// Counts dispatches, waits and bytes of the device; leaves out what is 0.
    pub(crate) fn count_traffic(&mut self, traffic: GpuTraffic) {
        let GpuTraffic { dispatches, waits, uploaded_bytes, read_bytes } = traffic;
        let kinds = [
            ("dispatches of kernels", dispatches),
            ("waits for the device", waits),
            ("KiB uploaded", uploaded_bytes / 1024),
            ("KiB read back", read_bytes / 1024),
        ];
        for (name, count) in kinds.into_iter().filter(|(_, count)| *count > 0) {
            self.count(name, count);
        }
    }

    /// Counts work that was done or left out.
    pub fn count(&mut self, name: &'static str, by: u64) {
        match self.counts.iter_mut().find(|(known, _)| *known == name) {
            Some((_, count)) => *count += by,
            None => self.counts.push((name, by)),
        }
    }

    /// Counts of work that was done or left out so far.
    pub fn counts(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        self.counts.iter().copied()
    }

    /// Sums the kept samples of a stage, milliseconds.
    #[must_use]
    pub fn total_ms(&self, name: &str) -> f64 {
        let stage = self.stages.iter().find(|stage| stage.name == name);
        stage.map_or(0.0, |stage| stage.millis.iter().map(|ms| f64::from(*ms)).sum())
    }

    /// Summarises the stages, in the order in which they were first seen.
    #[must_use]
    pub fn summary(&self) -> Vec<StageSummary> {
        self.stages
            .iter()
            .map(|stage| {
                let mut sorted = stage.millis.clone();
                sorted.sort_by(f32::total_cmp);
                let at = |part: f64| sorted[((sorted.len() - 1) as f64 * part).round() as usize];
                StageSummary {
                    name: stage.name.to_owned(),
                    frames: sorted.len(),
                    mean_ms: sorted.iter().sum::<f32>() / sorted.len() as f32,
                    p50_ms: at(0.5),
                    p95_ms: at(0.95),
                    p99_ms: at(0.99),
                }
            })
            .collect()
    }

    /// Formats a table for the terminal.
    #[must_use]
    pub fn table(&self) -> String {
        let [mean, half, most, all] = ["mean ms", "p50 ms", "p95 ms", "p99 ms"];
        let mut text = format!("{:<28} {:>7} {mean:>9} {half:>9} {most:>9} {all:>9}\n", "stage", "frames");
        for StageSummary { name, frames, mean_ms, p50_ms, p95_ms, p99_ms } in self.summary() {
            let _ = write!(text, "{name:<28} {frames:>7}");
            for millis in [mean_ms, p50_ms, p95_ms, p99_ms] {
                let _ = write!(text, " {millis:>9.2}");
            }
            text.push('\n');
        }
        for (name, count) in self.counts() {
            let _ = writeln!(text, "{name:<28} {count:>7}");
        }
        text
    }
}

/// Returns the processor time of all threads of this process together: the cost of drawing where the graphics adapter is
/// software, whatever else is running.
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
    fn percentiles_and_bounded_memory() {
        let mut times = StageTimes::default();
        for i in 0..StageTimes::WINDOW + 10 {
            times.add("a", Duration::from_millis(if i < 10 { 1_000_000 } else { 10 }));
        }
        times.add("b", Duration::from_millis(3));
        let summary = times.summary();
        assert_eq!(summary[0].frames, StageTimes::WINDOW);
        assert!((summary[0].mean_ms - 10.0).abs() < 0.01, "the oldest fall out: {}", summary[0].mean_ms);
        assert_eq!((summary[1].name.as_str(), summary[1].frames), ("b", 1));
        assert!((times.total_ms("a") - 36_000.0).abs() < 0.5, "{}", times.total_ms("a"));
        times.count("views left out", 2);
        times.count("views left out", 3);
        assert_eq!(times.counts().collect::<Vec<_>>(), [("views left out", 5)]);
        assert_eq!(times.table().lines().count(), 4);
        let mut device = StageTimes::default();
        device.count_traffic(GpuTraffic::default());
        assert_eq!(device.counts().count(), 0, "nothing of a device that is not asked");
        device.count_traffic(GpuTraffic { dispatches: 7, waits: 1, uploaded_bytes: 5000, read_bytes: 0 });
        let expected = [("dispatches of kernels", 7), ("waits for the device", 1), ("KiB uploaded", 4)];
        assert_eq!(device.counts().collect::<Vec<_>>(), expected);
        let mut sum = StageTimes::default();
        sum.add("b", Duration::from_millis(5));
        sum.merge(&times);
        assert!((sum.total_ms("b") - 8.0).abs() < 1e-3 && (sum.total_ms("a") - 36_000.0).abs() < 0.5);
        assert_eq!(sum.counts().collect::<Vec<_>>(), [("views left out", 5)]);
    }

    #[test]
    fn memory_is_plausible() {
        if let Some(mib) = resident_mib() {
            assert!(mib > 0.5 && mib < 1e6, "{mib}");
        }
    }
}
