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
        Self { now, layers: begun(now), carries, queue_nanos: 0, in_flight, pauses, turns, ticks, random: 1, busy: 1.0 }
    }

    /// Returns the first turn of a thread from `at` on.
    fn turn(&mut self, thread: usize, at: Instant) -> Instant {
        while self.turns[thread] < at {
            if self.pauses[thread].is_zero() {
                self.turns[thread] = at;
                break;
            }
            self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
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
