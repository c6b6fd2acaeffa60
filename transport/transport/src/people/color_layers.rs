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
mod tests {
    use super::*;
    use crate::people::wake_lag::Ticks;

    fn begun(now: Instant) -> ColorLayers {
        let mut layers = ColorLayers::new(now);
        layers.begin();
        layers
    }

    /// Sizes of a motion and of each layer, bytes.
    const BYTES: [usize; LAYERS + 1] = [4_000, 1_700, 4_000, 13_000];

    /// Line that carries `carries` layers: with more of them a queue fills up to half a second, and empties at the same pace.
    struct Line {
        now: Instant,
        layers: ColorLayers,
        carries: usize,
        queue_nanos: i64,
        /// Number of layers with which each motion in flight was sent.
        in_flight: VecDeque<usize>,
        /// Longest pauses between two turns of the thread that ingests messages and of the one that only waits; zero where they run at
        /// once.
        pauses: [Duration; 2],
        turns: [Instant; 2],
        ticks: Ticks,
        /// State of a generator of pauses.
        random: u64,
        /// Sizes relative to [`BYTES`].
        busy: f64,
    }

    impl Line {
        fn new(carries: usize) -> Self {
            let now = Instant::now();
            let (pauses, turns, ticks) = ([Duration::ZERO; 2], [now; 2], Ticks::new(now));
            let in_flight = VecDeque::from([1; 4]);
            Self {
                now,
                layers: begun(now),
                carries,
                queue_nanos: 0,
                in_flight,
                pauses,
                turns,
                ticks,
                random: 1,
                busy: 1.0,
            }
        }

        /// Returns the first turn of a thread from `at` on.
        fn turn(&mut self, thread: usize, at: Instant) -> Instant {
            while self.turns[thread] < at {
                if self.pauses[thread].is_zero() {
                    self.turns[thread] = at;
                    break;
                }
                self.random =
                    self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let share = (self.random >> 33) as f64 / f64::from(1u32 << 31);
                let pause = self.pauses[thread].as_secs_f64() * (0.1 + 0.9 * share);
                self.turns[thread] += flyrig_types::saturating_secs(pause);
            }
            self.turns[thread]
        }

        /// Runs for `secs` at 30 motions per second; returns the fraction of late motions, and of time with each number of layers.
        fn run(&mut self, secs: usize) -> (f64, [f64; LAYERS + 1]) {
            let (mut late, mut counts) = (0, [0; LAYERS + 1]);
            self.ticks = Ticks::new(self.now);
            for _ in 0..30 * secs {
                self.now += Duration::from_nanos(33_333_333);
                self.in_flight.push_back(self.layers.wanted());
                let sent = self.in_flight.pop_front().unwrap();
                let step = if sent > self.carries { 20_000_000 } else { -20_000_000 };
                self.queue_nanos = (self.queue_nanos + step).clamp(0, 500_000_000);
                late += usize::from(self.queue_nanos > 100_000_000);
                for (kind, bytes) in BYTES.iter().enumerate().take(sent + 1) {
                    self.layers.count(kind.checked_sub(1), (*bytes as f64 * self.busy) as usize);
                }
                let taken = self.turn(0, self.now);
                let woken = self.turn(1, self.now);
                self.ticks.run(woken, |by| self.layers.woke_late(by));
                let waited = taken.duration_since(self.now).as_nanos() as i64;
                // A clock that is an hour ahead.
                self.layers.motion(taken, 1, 3_600_000_000_000 + 50_000_000 + self.queue_nanos + waited, 0);
                counts[self.layers.wanted()] += 1;
            }
            let share = |count: usize| count as f64 / (30 * secs) as f64;
            (share(late), counts.map(share))
        }
    }

    #[test]
    fn a_fast_line_has_all_layers_soon() {
        let mut line = Line::new(LAYERS);
        line.run(3);
        assert_eq!(line.layers.wanted(), LAYERS);
        let (late, shares) = line.run(600);
        assert!(late <= 0.0 && shares[LAYERS] >= 1.0, "{late} {shares:?}");
    }

    #[test]
    fn a_slow_line_has_those_it_carries_and_others_are_tried_ever_less_often() {
        for carries in 0..LAYERS {
            let mut line = Line::new(carries);
            line.run(120);
            let (late, shares) = line.run(1200);
            assert!(shares[carries] > 0.95, "{carries}: {shares:?}");
            assert!(late < 0.01, "{carries}: {late}");
        }
    }

    #[test]
    fn an_overloaded_computer_takes_its_own_lateness_for_no_slow_line() {
        for pauses in [[100, 100], [400, 400], [1000, 1000], [2000, 2000], [400, 200]] {
            let mut line = Line::new(LAYERS);
            line.run(20);
            line.pauses = pauses.map(Duration::from_millis);
            let (_, shares) = line.run(600);
            assert!(shares[LAYERS] > 0.9, "{pauses:?}: {shares:?}");
            line.pauses = [Duration::ZERO; 2];
            line.run(20);
            assert_eq!(line.layers.wanted(), LAYERS, "{pauses:?}");
        }
        // Without the measured scheduling delays, the line seems slow.
        let mut line = Line::new(LAYERS);
        line.run(20);
        line.pauses = [Duration::from_millis(1000), Duration::ZERO];
        let (_, shares) = line.run(600);
        assert!(shares[LAYERS] < 0.3, "{shares:?}");
    }

    #[test]
    fn an_overloaded_computer_begins_with_colours() {
        let mut line = Line::new(LAYERS);
        line.pauses = [Duration::from_millis(700); 2];
        line.run(60);
        assert_eq!(line.layers.wanted(), LAYERS);
    }

    #[test]
    fn a_slow_line_shows_on_an_overloaded_computer_too() {
        let mut line = Line::new(1);
        line.pauses = [Duration::from_millis(300); 2];
        line.run(120);
        let (late, shares) = line.run(1200);
        assert!(shares[0] + shares[1] > 0.9 && late < 0.1, "{late} {shares:?}");
    }

    #[test]
    fn missing_motion_is_no_congestion_where_threads_run_late() {
        let start = Instant::now();
        for (lag_millis, expected) in [(0, 0), (200, LAYERS)] {
            let mut layers = begun(start);
            for i in 0..600u32 {
                (0..3).for_each(|_| layers.woke_late(Duration::from_millis(lag_millis)));
                layers.motion(start + i * Duration::from_millis(66), 1, 10_000_000, 1);
            }
            assert!(layers.wanted().abs_diff(expected) <= 1, "{lag_millis}: {}", layers.wanted());
        }
    }

    #[test]
    fn lags_without_motion_are_bounded() {
        let now = Instant::now();
        let mut layers = begun(now);
        (0..100_000).for_each(|_| layers.woke_late(Duration::MAX));
        assert!(layers.lags.len() <= MOST_LAGS);
        (0..1000).for_each(|i| layers.motion(now + i * Duration::from_millis(33), 1, i64::MIN, u64::MAX));
        assert!(layers.lags.is_empty());
    }

    #[test]
    fn a_line_that_becomes_slow_or_fast_is_followed() {
        let mut line = Line::new(LAYERS);
        line.run(20);
        line.carries = 1;
        let (late, _) = line.run(10);
        assert!(late < 0.35 && line.layers.wanted() <= 1, "{late} {}", line.layers.wanted());
        line.carries = LAYERS;
        line.run(300);
        assert_eq!(line.layers.wanted(), LAYERS);
    }

    #[test]
    fn missing_motion_is_congestion_but_a_little_is_not() {
        let start = Instant::now();
        for (missed_of_four, expected) in [(1, LAYERS), (4, 0)] {
            let mut layers = begun(start);
            for i in 0..300u32 {
                let missed = u64::from(i % 4 < missed_of_four);
                layers.motion(start + i * Duration::from_millis(66), 1, 10_000_000, missed);
            }
            assert!(layers.wanted().abs_diff(expected) <= 1, "{missed_of_four}: {}", layers.wanted());
        }
    }

    #[test]
    fn a_template_fills_the_line_without_a_judgement() {
        let mut line = Line::new(LAYERS);
        line.run(10);
        line.layers.fetch_begins(line.now);
        line.carries = 0;
        line.run(5);
        line.layers.fetch_ends(line.now, 0);
        line.carries = LAYERS;
        line.run(5);
        assert_eq!(line.layers.wanted(), LAYERS);
    }

    /// Fetches a template of 1.2 MB at a rate, bytes per second.
    fn fetch(line: &mut Line, bytes_per_sec: f64) {
        line.layers.fetch_begins(line.now);
        line.now += flyrig_types::saturating_secs(1.2e6 / bytes_per_sec);
        line.layers.fetch_ends(line.now, 1_200_000);
        line.run(1);
    }

    #[test]
    fn a_layer_that_the_template_showed_not_to_fit_is_not_tried_at_once() {
        let mut line = Line::new(2);
        fetch(&mut line, 330e3);
        let (late, shares) = line.run(45);
        assert!(late <= 0.0 && shares[2] > 0.7 && shares[3] <= 0.0, "{late} {shares:?}");
        // The line may have become faster.
        line.carries = LAYERS;
        line.run(60);
        assert_eq!(line.layers.wanted(), LAYERS);
    }

    #[test]
    fn a_layer_is_not_tried_in_a_quiet_moment() {
        let mut line = Line::new(2);
        fetch(&mut line, 330e3);
        for _ in 0..20 {
            line.busy = 1.0;
            line.run(2);
            // Not even all layers would be too many for the line now.
            line.busy = 0.4;
            let (late, shares) = line.run(1);
            assert!(late <= 0.0 && shares[3] <= 0.0, "{late} {shares:?}");
        }
    }

    #[test]
    fn a_fast_template_delays_no_layer_and_a_small_one_shows_nothing() {
        for (rate, bytes) in [(1.2e6, 1_200_000), (1e3, 1_000)] {
            let mut line = Line::new(LAYERS);
            line.layers.fetch_begins(line.now);
            line.layers.fetch_begins(line.now);
            line.now += flyrig_types::saturating_secs(bytes as f64 / rate);
            line.layers.fetch_ends(line.now, 0);
            line.layers.fetch_ends(line.now, bytes);
            line.run(5);
            assert_eq!(line.layers.wanted(), LAYERS, "{rate}");
        }
    }

    #[test]
    fn a_slow_rig_is_no_slow_line_and_gets_all_layers_at_once() {
        // Two motions within half a minute, on a line of 3 Mbit/s and on a fast one.
        for (rate, at_once) in [(375e3, false), (20e6, true)] {
            let now = Instant::now();
            let mut layers = ColorLayers::new(now);
            layers.motion(now, 1, 0, 0);
            layers.fetch_begins(now);
            let arrived = now + flyrig_types::saturating_secs(1.2e6 / rate);
            layers.fetch_ends(arrived, 1_200_000);
            layers.begin();
            assert_eq!(layers.wanted() == LAYERS, at_once, "{rate}");
            assert!(layers.is_rig_slow() && !layers.is_line_slow());
            layers.motion(arrived + Duration::from_secs(5), 1, 0, 0);
            assert_eq!(layers.wanted(), LAYERS, "{rate}");
            assert!(layers.is_rig_slow() && !layers.is_line_slow());
        }
        // Without a measurement, missing layers are nobody's fault.
        let mut layers = begun(Instant::now());
        layers.motion(Instant::now() + Duration::from_secs(10), 1, 0, 0);
        assert!(layers.wanted() < LAYERS && !layers.is_line_slow());
        let mut line = Line::new(1);
        line.run(120);
        assert!(line.layers.is_line_slow() && !line.layers.is_rig_slow());
        line.carries = LAYERS;
        line.run(600);
        assert!(!line.layers.is_line_slow());
    }

    #[test]
    fn what_is_missed_in_a_pause_does_not_count() {
        let mut line = Line::new(LAYERS);
        for _ in 0..5 {
            line.run(10);
            line.now += Duration::from_secs(3);
            line.layers.motion(line.now, 1, 3_600_050_000_000, 90);
        }
        line.run(1);
        assert_eq!(line.layers.wanted(), LAYERS);
    }

    #[test]
    fn nothing_counts_before_colors_begin() {
        let now = Instant::now();
        let mut layers = ColorLayers::new(now);
        (0..100).for_each(|i| layers.motion(now + i * Duration::from_millis(33), 1, 0, 9));
        assert_eq!(layers.wanted(), 0);
        layers.begin();
        layers.begin();
        assert_eq!(layers.wanted(), 1);
    }

    #[test]
    fn clocks_that_are_set_cost_at_most_seconds() {
        let mut line = Line::new(LAYERS);
        line.run(10);
        // A clock jumps ten seconds ahead, far back, and to the ends of its range.
        for latency in [3_610_000_000_000, -5_000_000_000, i64::MIN, i64::MAX, 0] {
            for _ in 0..30 {
                line.now += Duration::from_millis(33);
                line.layers.motion(line.now, 1, latency, if latency == 0 { u64::MAX } else { 0 });
            }
        }
        line.run(300);
        assert_eq!(line.layers.wanted(), LAYERS);
    }
}
