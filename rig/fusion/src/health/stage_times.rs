//! Run times and counts of the stages of a session.

use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

use flyrig_gpu::GpuTraffic;
use serde::Serialize;

use super::stage_trace::{trace_adapter, trace_stage};

/// Run times of named stages over many frame sets; the last 3600 samples of each are kept.
///
/// # Example
/// ```
/// use std::time::Duration;
///
/// let mut stages = flyrig_fusion::StageTimes::default();
/// let sum = stages.time("sum", || (1..=100).sum::<u32>());
/// stages.add("wait", Duration::from_millis(3));
/// stages.count("frame sets", 1);
/// assert_eq!((sum, stages.summary().len()), (5050, 2));
/// assert!((stages.total_ms("wait") - 3.0).abs() < 1e-3);
/// ```
#[derive(Debug, Default)]
pub struct StageTimes {
    stages: Vec<Stage>,
    counts: Vec<(&'static str, u64)>,
}

/// Ring of one stage's samples.
#[derive(Debug)]
struct Stage {
    name: &'static str,
    millis: Vec<f32>,
    /// Index of the sample that is replaced next.
    next: usize,
}

/// Summary of one stage over the kept samples.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageSummary {
    /// Name of the stage; parts of a stage are indented by two spaces.
    pub name: String,
    /// Number of samples.
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
    /// Samples kept per stage, which bounds the memory of a rig that runs for days.
    const WINDOW: usize = 3600;

    /// Adds the run time of a stage that has just ended.
    pub fn add(&mut self, name: &'static str, time: Duration) {
        trace_stage(name, time);
        self.push(name, time.as_secs_f32() * 1e3);
    }

    /// Adds a time that the graphics adapter measured.
    pub(crate) fn add_of_adapter(&mut self, name: &'static str, time: Duration) {
        trace_adapter(name, time);
        self.push(name, time.as_secs_f32() * 1e3);
    }

    /// Adds processor time, which is not part of a stage's run time.
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

    /// Runs a closure and adds its run time.
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

    /// Counts dispatches, waits and bytes of the device; zeros are left out.
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

    /// Returns the counts of work that was done or left out so far.
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

    /// Formats the summary as a table for the terminal.
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
}
