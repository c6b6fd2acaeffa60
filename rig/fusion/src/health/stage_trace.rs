//! Trace of every stage with its thread and time, for a profiler's viewer (`--trace`). Off until a program starts it.

use std::{
    collections::HashMap,
    sync::Mutex,
    time::{Duration, Instant},
};

/// Largest number of kept events: an hour of a rig, and some 50 MB.
const MOST: usize = 500_000;
/// Name of the track with times that the graphics adapter measures itself.
const ADAPTER: &str = "adapter";
/// Time after the end of a stage within which parts are added to it.
const AFTERWARDS: Duration = Duration::from_millis(2);

/// Run of one stage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TracedStage {
    /// Name of the stage.
    pub name: &'static str,
    /// Thread that ran it, or "adapter".
    pub track: String,
    /// Start, since the trace was started.
    pub start: Duration,
    /// Run time.
    pub time: Duration,
}

/// Last stage of one track, and parts that wait for their stage.
#[derive(Debug, Default)]
struct Track {
    /// Start of the next part of the last stage.
    parts_from: Duration,
    /// End of that stage.
    end: Duration,
    /// Parts whose stage has not been added yet.
    waiting: Vec<(&'static str, Duration)>,
}

/// Trace under way.
#[derive(Debug)]
struct StageTrace {
    origin: Instant,
    tracks: HashMap<String, Track>,
    stages: Vec<TracedStage>,
}

static TRACE: Mutex<Option<StageTrace>> = Mutex::new(None);

/// Starts or restarts a trace of all stages of this process.
pub fn start_stage_trace() {
    *lock() = Some(StageTrace::new(Instant::now()));
}

/// Ends the trace and returns its stages in the order in which they ended; none where no trace was started. Half a million stages are kept
/// at most.
#[must_use]
pub fn take_stage_trace() -> Vec<TracedStage> {
    lock().take().map_or_else(Vec::new, |trace| trace.stages)
}

/// Adds a stage of this thread that has just ended. Parts of a stage (names indented by two spaces) are sums over its run time: they are
/// drawn one after the other from its start.
pub(crate) fn trace_stage(name: &'static str, time: Duration) {
    if let Some(trace) = lock().as_mut() {
        let thread = std::thread::current();
        trace.add(thread.name().unwrap_or("thread"), name, Instant::now(), time);
    }
}

/// Adds a time that the graphics adapter measured and that is known only afterwards.
pub(crate) fn trace_adapter(name: &'static str, time: Duration) {
    if let Some(trace) = lock().as_mut() {
        let now = Instant::now();
        let busy_until = trace.tracks.get(ADAPTER).map_or(Duration::ZERO, |track| track.end);
        let end = now.duration_since(trace.origin).max(busy_until + time);
        trace.add(ADAPTER, name, trace.origin + end, time);
    }
}

fn lock() -> std::sync::MutexGuard<'static, Option<StageTrace>> {
    flyrig_types::lock(&TRACE)
}

impl StageTrace {
    fn new(origin: Instant) -> Self {
        Self { origin, tracks: HashMap::new(), stages: Vec::new() }
    }

    fn add(&mut self, track: &str, name: &'static str, now: Instant, time: Duration) {
        let now = now.saturating_duration_since(self.origin);
        if !self.tracks.contains_key(track) {
            self.tracks.insert(track.to_owned(), Track::default());
        }
        let Some(known) = self.tracks.get_mut(track) else { return };
        let mut placed = Vec::new();
        if let Some(part) = name.strip_prefix("  ") {
            if now.saturating_sub(known.end) > AFTERWARDS {
                known.waiting.push((part, time));
            } else {
                placed.push((part, known.parts_from, time));
                known.parts_from += time;
            }
        } else {
            let start = now.saturating_sub(time);
            (known.parts_from, known.end) = (start, now);
            placed.push((name, start, time));
            for (part, time) in known.waiting.drain(..) {
                placed.push((part, known.parts_from, time));
                known.parts_from += time;
            }
        }
        let room = MOST.saturating_sub(self.stages.len());
        let stage = |(name, start, time)| TracedStage { name, track: track.to_owned(), start, time };
        self.stages.extend(placed.into_iter().take(room).map(stage));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    /// Returns track, name, start and run time in milliseconds.
    fn rows(trace: &StageTrace) -> Vec<(&str, &str, u128, u128)> {
        trace.stages.iter().map(|s| (s.track.as_str(), s.name, s.start.as_millis(), s.time.as_millis())).collect()
    }

    #[test]
    fn stages_end_when_they_are_added_and_hold_their_parts() {
        let origin = Instant::now();
        let mut trace = StageTrace::new(origin);
        // Parts before their stage, as perception adds them, and after it, as deformation does; two threads.
        trace.add("perception", "  network", origin + ms(70), ms(40));
        trace.add("main", "deformation", origin + ms(80), ms(30));
        trace.add("main", "  draw", origin + ms(80), ms(20));
        trace.add("main", "  solve", origin + ms(81), ms(8));
        trace.add("perception", "  masks", origin + ms(90), ms(15));
        trace.add("perception", "pose from images", origin + ms(100), ms(60));
        assert_eq!(
            rows(&trace),
            [
                ("main", "deformation", 50, 30),
                ("main", "draw", 50, 20),
                ("main", "solve", 70, 8),
                ("perception", "pose from images", 40, 60),
                ("perception", "network", 40, 40),
                ("perception", "masks", 80, 15),
            ]
        );
        // A stage that began before the trace.
        trace.add("main", "visibility", origin + ms(5), ms(9));
        assert_eq!(rows(&trace).last(), Some(&("main", "visibility", 0, 9)));
    }

    #[test]
    fn a_trace_has_an_end() {
        let origin = Instant::now();
        let mut trace = StageTrace::new(origin);
        for i in 0..MOST as u64 + 5 {
            trace.add("main", "stage", origin + Duration::from_micros(i), Duration::from_micros(1));
        }
        assert_eq!(trace.stages.len(), MOST);
    }
}
