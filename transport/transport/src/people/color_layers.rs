//! Choice of the colour layers that a line carries: fewer while motion is late or missing, more again once it is on time.
//!
//! The receiver alone decides, from the arrival of motion: colours that are not subscribed to are not sent, so the slow line of one viewer
//! costs the others nothing, and a relay adapts to its own line. Wall clocks play no part, since a step of one looks like a queue. On an
//! overloaded computer threads ingest messages late whatever the line does: a thread that only waits measures by how much (`wake_lag.rs`).

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use flyrig_stream::LAYERS;

/// Shortest window of a decision, and least number of motions in it.
const WINDOW: Duration = Duration::from_millis(600);
const MIN_MOTIONS: usize = 4;
/// Fraction of a window's motions, the fastest, that indicates the length of queues: lost packets delay the others for a moment.
const FASTEST_SHARE: f64 = 0.2;
/// Time over which the least latency counts as that without queues: clocks drift, routes change.
const FASTEST_OF: Duration = Duration::from_secs(30);
/// Queueing delays: above the first a line is congested, below the second it is clear, above the third all colours stop.
const LATE_NANOS: i64 = 70_000_000;
const CLEAR_NANOS: i64 = 35_000_000;
const VERY_LATE_NANOS: i64 = 300_000_000;
/// Scheduling delay of a thread that ingests messages, as a multiple of that of one that only waits.
const BUSIER: i64 = 2;
/// Scheduling delay above which missing motions are no sign of congestion.
const STARVED_NANOS: i64 = 10_000_000;
/// Length of a window as a multiple of the longest scheduling delay, since single delays are noisy; and its bound.
const LAGS_IN_WINDOW: u32 = 6;
const LONGEST_WINDOW: Duration = Duration::from_secs(15);
/// Largest number of scheduling delays that are kept while no motion arrives.
const MOST_LAGS: usize = 1024;
/// Fraction of missing motions on a congested line. A line with 1 % loss misses a quarter while TCP retransmits.
const MISSED_SHARE: f64 = 0.45;
/// Pause after which missed motions are no sign of congestion: the line was cut, or there was no subscription.
const PAUSE: Duration = Duration::from_secs(1);
/// Delay of the next decision after a change: queues drain, and the change has to reach the rig.
const SETTLING: Duration = Duration::from_millis(1500);
/// Time without congestion before a layer is tried: at first, later, and at most; it doubles after each failed trial.
const FIRST_TRIAL: Duration = Duration::from_millis(500);
const LATER_TRIAL: Duration = Duration::from_secs(8);
const MOST_PATIENCE: Duration = Duration::from_secs(240);
/// Duration after which a trial has succeeded.
const SUCCESS: Duration = Duration::from_secs(10);
/// A template fills the line, so its transfer measures the line's throughput: least size, bytes, and validity of the measurement.
const LEAST_FETCH_BYTES: usize = 200_000;
const CARRIED_FOR: Duration = Duration::from_secs(300);
/// Least bytes of a layer as a multiple of the layer before it, and of the coarsest as a multiple of motion. Where the line does not carry
/// that, a trial would stop motion for seconds, and comes only after [`UNLIKELY_TRIAL`].
const NEXT_LAYER: f64 = 2.3;
const FIRST_LAYER: f64 = 0.2;
/// Fraction by which the byte rate of the busiest window decays per window: a person who moves more takes more bytes.
const FORGOTTEN: f64 = 0.05;
/// Time without congestion before a layer is tried that the line does not seem to carry.
const UNLIKELY_TRIAL: Duration = Duration::from_secs(60);
/// Most bytes of motion and all colours of a frame set, those of a slow rig (`flyrig_stream::ColorSettings::max_frame_bytes`), and the
/// interval assumed before it is known. A line that was measured to carry twice as much gets all layers at once.
const MOST_SET_BYTES: f64 = 36e3;
const MOST_SLOW_SET_BYTES: f64 = 8.0 * MOST_SET_BYTES;
const UNKNOWN_INTERVAL_SECS: f64 = 1.0 / 30.0;
const RESERVE: f64 = 2.0;
/// Fraction by which the longest interval of motions decays per motion.
const INTERVAL_FORGOTTEN: f64 = 0.3;
/// Interval of motions above which a refresh of all colours takes longer than a second.
const SLOW_INTERVAL_SECS: f64 = 0.25;

/// Chooses the number of layers to subscribe to.
#[derive(Debug)]
pub(crate) struct ColorLayers {
    /// Number of layers to subscribe to, from the coarsest.
    wanted: usize,
    /// Number of layers to return to when queues are empty again.
    carried: usize,
    is_begun: bool,
    /// Identity of the clock that stamps motion.
    clock: Option<u64>,
    /// Start and least latency of each second.
    fastest: VecDeque<(Instant, i64)>,
    latencies: Vec<i64>,
    /// Scheduling delays of this computer, nanoseconds.
    lags: Vec<i64>,
    missed: u64,
    /// Number of templates being fetched, which fill any line.
    fetches: usize,
    /// Start of the fetches, and bytes received since.
    fetched: Option<(Instant, usize)>,
    /// Time and result of the last measurement of throughput, bytes per second.
    carries: Option<(Instant, f64)>,
    /// Bytes of motion and of each layer in this window, and bytes per second of the busiest recent window.
    bytes: [usize; 1 + LAYERS],
    bytes_per_sec: [f64; 1 + LAYERS],
    /// Arrival of the last motion.
    last: Option<Instant>,
    /// Recent longest interval of motions, seconds.
    interval_secs: Option<f64>,
    /// Time since the last motion during which a fetch held it up, seconds.
    fetching_secs: f64,
    /// Whether the line was congested since all layers were subscribed to.
    has_been_congested: bool,
    window_began: Instant,
    /// Time of the last change, and whether it added a layer.
    changed: Option<(Instant, bool)>,
    /// Start of the time without congestion.
    clear_since: Option<Instant>,
    /// Time without congestion before the next trial.
    patience: Duration,
}

impl ColorLayers {
    pub fn new(now: Instant) -> Self {
        Self {
            wanted: 0,
            carried: 0,
            is_begun: false,
            clock: None,
            fastest: VecDeque::new(),
            latencies: Vec::new(),
            lags: Vec::new(),
            missed: 0,
            fetches: 0,
            fetched: None,
            carries: None,
            bytes: [0; 1 + LAYERS],
            bytes_per_sec: [0.0; 1 + LAYERS],
            last: None,
            interval_secs: None,
            fetching_secs: 0.0,
            has_been_congested: false,
            window_began: now,
            changed: None,
            clear_since: None,
            patience: FIRST_TRIAL,
        }
    }

    /// Returns the number of layers to subscribe to, from the coarsest, 0..=[`LAYERS`].
    pub fn wanted(&self) -> usize {
        self.wanted
    }

    /// Returns whether [`Self::begin`] was called.
    pub fn has_begun(&self) -> bool {
        self.is_begun
    }

    /// Begins with the coarsest layer, or with all where the line carries them by far; before, motion only measures the line without
    /// colours.
    pub fn begin(&mut self) {
        if !std::mem::replace(&mut self.is_begun, true) {
            (self.wanted, self.carried) = (1, 1);
            self.take_all_if_carried();
        }
    }

    /// Returns whether frame sets come so rarely that a refresh of all colours takes long.
    pub fn is_rig_slow(&self) -> bool {
        self.interval_secs.is_none_or(|interval| interval > SLOW_INTERVAL_SECS)
    }

    /// Returns whether the line, and not the rate of the rig or the time since the start, is why layers are missing.
    pub fn is_line_slow(&self) -> bool {
        self.is_begun && self.wanted < LAYERS && (self.has_been_congested || self.is_unlikely(self.last))
    }

    /// Returns whether the line was measured to carry less than one more layer needs.
    fn is_unlikely(&self, now: Option<Instant>) -> bool {
        let is_valid = |at: Instant| now.is_none_or(|now| now.duration_since(at) < CARRIED_FOR);
        self.carries.is_some_and(|(at, carried)| is_valid(at) && self.with_one_more() > carried)
    }

    /// Subscribes to all layers where the measured throughput leaves no doubt: a slow rig would need minutes for trials.
    fn take_all_if_carried(&mut self) {
        let Some((_, carried)) = self.carries.filter(|_| self.is_begun && !self.has_been_congested) else { return };
        let interval = self.interval_secs.unwrap_or(UNKNOWN_INTERVAL_SECS).max(1e-3);
        let set_bytes = (10.0 * interval * MOST_SET_BYTES).clamp(MOST_SET_BYTES, MOST_SLOW_SET_BYTES);
        if RESERVE * set_bytes / interval <= carried {
            (self.wanted, self.carried) = (LAYERS, LAYERS);
        }
    }

    /// Records the start of a template's fetch. Nothing is decided meanwhile, nor until queues are empty again.
    pub fn fetch_begins(&mut self, now: Instant) {
        self.fetches += 1;
        self.fetched.get_or_insert((now, 0));
        self.changed = Some((now, false));
        self.clear_since = None;
    }

    /// Records the end of a fetch with `bytes` bytes; 0 where it failed.
    pub fn fetch_ends(&mut self, now: Instant, bytes: usize) {
        self.fetches = self.fetches.saturating_sub(1);
        self.changed = Some((now, false));
        self.clear_since = None;
        let Some((begun, sum)) = &mut self.fetched else { return };
        *sum = sum.saturating_add(bytes);
        if self.fetches == 0 {
            let secs = now.duration_since(*begun).as_secs_f64();
            self.fetching_secs += secs;
            if *sum >= LEAST_FETCH_BYTES {
                self.carries = Some((now, *sum as f64 / secs.max(1e-3)));
            }
            self.fetched = None;
            self.take_all_if_carried();
        }
    }

    /// Counts the bytes of a message of a layer of colours, or of motion.
    pub fn count(&mut self, layer: Option<usize>, bytes: usize) {
        if let Some(sum) = self.bytes.get_mut(layer.map_or(0, |layer| 1 + layer)) {
            *sum = sum.saturating_add(bytes);
        }
    }

    /// Returns the byte rate of the current subscriptions and one more layer.
    fn with_one_more(&self) -> f64 {
        let subscribed = &self.bytes_per_sec[..=self.wanted.min(LAYERS)];
        let growth = if self.wanted == 0 { FIRST_LAYER } else { NEXT_LAYER };
        subscribed.iter().sum::<f64>() + growth * subscribed.last().copied().unwrap_or(0.0)
    }

    /// Records a scheduling delay of a thread that only waits.
    pub fn woke_late(&mut self, by: Duration) {
        if self.lags.len() < MOST_LAGS {
            self.lags.push(i64::try_from(by.as_nanos()).unwrap_or(i64::MAX));
        }
    }

    /// Ingests the arrival of a motion: its latency by any two clocks that are never set, the identity of the sender's clock, and the number
    /// of motions missed before it.
    pub fn motion(&mut self, now: Instant, clock: u64, latency_nanos: i64, missed: u64) {
        if self.clock.replace(clock) != Some(clock) {
            // Another computer, or the same after a boot: its times compare with no earlier ones.
            self.fastest.clear();
            self.latencies.clear();
        }
        self.note_way(now, latency_nanos);
        let since_last = self.last.replace(now).map(|last| now.duration_since(last));
        let is_pause = since_last.is_some_and(|since| since > PAUSE);
        if let Some(since) = since_last {
            let since = (since.as_secs_f64() - std::mem::take(&mut self.fetching_secs)).max(0.0);
            let decayed = self.interval_secs.map_or(0.0, |longest| longest * (1.0 - INTERVAL_FORGOTTEN));
            self.interval_secs = Some(decayed.max(since));
            self.take_all_if_carried();
        }
        let missed = if is_pause { 0 } else { missed };
        self.latencies.push(latency_nanos);
        self.missed = self.missed.saturating_add(missed);
        let longest = self.lags.iter().copied().max().unwrap_or(0);
        let lags = Duration::from_nanos(longest.unsigned_abs()).saturating_mul(LAGS_IN_WINDOW);
        let window = WINDOW.max(lags.min(LONGEST_WINDOW));
        if now.duration_since(self.window_began) < window || self.latencies.len() < MIN_MOTIONS {
            return;
        }
        let mut latencies = std::mem::take(&mut self.latencies);
        let mut lags = std::mem::take(&mut self.lags);
        let missed = std::mem::take(&mut self.missed) as f64;
        let secs = now.duration_since(self.window_began).as_secs_f64();
        for (busiest, bytes) in self.bytes_per_sec.iter_mut().zip(std::mem::take(&mut self.bytes)) {
            *busiest = (bytes as f64 / secs).max((1.0 - FORGOTTEN) * *busiest);
        }
        self.window_began = now;
        if !self.is_begun || self.fetches > 0 {
            return;
        }
        let missed_share = missed / (missed + latencies.len() as f64);
        let fast = fast_of(&mut latencies);
        let fastest = self.fastest.iter().map(|(_, nanos)| *nanos).min().unwrap_or(fast);
        self.judge(now, fast.saturating_sub(fastest), fast_of(&mut lags), missed_share);
    }

    fn note_way(&mut self, now: Instant, latency_nanos: i64) {
        match self.fastest.back_mut() {
            Some((begun, least)) if now.duration_since(*begun) < Duration::from_secs(1) => {
                *least = latency_nanos.min(*least);
            }
            _ => self.fastest.push_back((now, latency_nanos)),
        }
        while self.fastest.front().is_some_and(|(begun, _)| now.duration_since(*begun) > FASTEST_OF) {
            self.fastest.pop_front();
        }
    }

    fn judge(&mut self, now: Instant, late_nanos: i64, lag_nanos: i64, missed_share: f64) {
        let queued_nanos = late_nanos.saturating_sub(lag_nanos.saturating_mul(BUSIER));
        let (queued_ms, lag_ms) = (queued_nanos / 1_000_000, lag_nanos / 1_000_000);
        tracing::trace!(queued_ms, lag_ms, missed_share, layers = self.wanted, "line");
        let since_change = self.changed.map(|(at, _)| now.duration_since(at));
        let is_trial = matches!(self.changed, Some((_, true)));
        let is_missing = missed_share > MISSED_SHARE && lag_nanos < STARVED_NANOS;
        let is_congested = queued_nanos > LATE_NANOS || is_missing;
        if is_congested {
            self.clear_since = None;
            // After a layer is dropped, queues are still full of it; an added layer shows at once.
            if self.wanted == 0 || (!is_trial && since_change.is_some_and(|since| since < SETTLING)) {
                return;
            }
            let has_failed = is_trial && since_change.is_some_and(|since| since < SUCCESS);
            self.patience =
                if has_failed { (2 * self.patience).clamp(LATER_TRIAL, MOST_PATIENCE) } else { LATER_TRIAL };
            self.has_been_congested = true;
            self.carried = self.wanted - 1;
            // Without any colours, long queues empty sooner.
            self.wanted = if queued_nanos > VERY_LATE_NANOS { 0 } else { self.carried };
            self.changed = Some((now, false));
            return;
        }
        if is_trial && since_change.is_some_and(|since| since >= SUCCESS) {
            self.patience = self.patience.min(LATER_TRIAL);
        }
        self.has_been_congested &= self.wanted < LAYERS || is_trial;
        if queued_nanos > CLEAR_NANOS {
            self.clear_since = None;
            return;
        }
        let clear_since = *self.clear_since.get_or_insert(now);
        if self.wanted < self.carried {
            self.wanted = self.carried;
            self.changed = Some((now, false));
            return;
        }
        let patience = if self.is_unlikely(Some(now)) { self.patience.max(UNLIKELY_TRIAL) } else { self.patience };
        let is_due = now.duration_since(clear_since) >= patience && since_change.is_none_or(|since| since >= patience);
        if is_due && self.wanted < LAYERS {
            self.wanted += 1;
            self.carried = self.wanted;
            self.changed = Some((now, true));
            self.clear_since = None;
        }
    }
}

/// Returns the quantile [`FASTEST_SHARE`] of durations; 0 for none.
fn fast_of(nanos: &mut [i64]) -> i64 {
    let at = (FASTEST_SHARE * nanos.len() as f64) as usize;
    if at < nanos.len() { *nanos.select_nth_unstable(at).1 } else { 0 }
}

#[cfg(test)]
#[path = "color_layers_tests.rs"]
mod tests;
