//! Wait of live frame sets for frames that are lost, in simulated time.

use flyrig_types::{CameraId, FrameSet};

use crate::{SyncSettings, Synchronizer, sync::tests::frame};

const MS: i64 = 1_000_000;
const PERIOD: i64 = 33_333_333;
const CAMERAS: [&str; 4] = ["a", "b", "c", "d"];

/// Generator of the same numbers on every machine, 0 to 1.
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Live rig of four cameras at 30 frames per second.
#[derive(Clone, Copy)]
struct Live {
    /// Capture times of the cameras after the first one's, nanoseconds.
    phases: [i64; 4],
    /// Fraction of frames that each camera loses.
    lost: [f64; 4],
    /// Largest random part of a frame's latency, nanoseconds.
    jitter: i64,
    /// Whether sets are given up on.
    gives_up: bool,
}

/// Outcome of a run.
struct Waits {
    /// Time from the arrival of a set's last frame to the set, nanoseconds, sorted.
    waits: Vec<i64>,
    /// Frames that arrived and joined no set.
    unused: u64,
}

impl Waits {
    fn p99(&self) -> i64 {
        self.waits[self.waits.len() * 99 / 100]
    }
}

impl Live {
    fn run(self, periods: i64) -> Waits {
        let mut random = Random(11);
        let mut arrivals = Vec::new();
        for n in 0..periods {
            for (slot, (phase, lost)) in self.phases.into_iter().zip(self.lost).enumerate() {
                let latency = 20 * MS + (random.unit() * self.jitter as f64) as i64;
                let captured = n * PERIOD + phase;
                // The first second is whole.
                if n < 30 || random.unit() >= lost {
                    arrivals.push((captured + latency, slot, captured));
                }
            }
        }
        arrivals.sort_unstable();
        let ids: Vec<CameraId> = CAMERAS.into_iter().map(CameraId::from).collect();
        let mut sync = Synchronizer::new(&ids, &SyncSettings::default());
        let mut waits = Vec::new();
        let came = |slot: usize, captured: i64| arrivals.iter().find(|(_, s, c)| (*s, *c) == (slot, captured));
        let mut note = |sets: Vec<FrameSet>, now: i64| {
            for set in sets {
                let frames = set.present().filter_map(|(slot, frame)| came(slot, frame.capture_nanos));
                let last = frames.map(|(arrival, ..)| *arrival).max().unwrap();
                waits.push(now - last);
            }
        };
        for &(arrival, slot, captured) in &arrivals {
            while let Some(deadline) = sync.next_deadline().filter(|at| self.gives_up && *at < arrival) {
                note(sync.give_up(deadline), deadline);
            }
            note(sync.push_at(frame(CAMERAS[slot], captured), arrival), arrival);
            if self.gives_up {
                note(sync.give_up(arrival), arrival);
            }
        }
        let unused = sync.counts().dropped_frames.iter().map(crate::DropCounts::total).sum();
        waits.sort_unstable();
        Waits { waits, unused }
    }
}

const PHASES: [[i64; 4]; 3] = [[0; 4], [0, 8 * MS, 16 * MS, 24 * MS], [0, -12 * MS, 5 * MS, 15 * MS]];

#[test]
fn ten_percent_loss_costs_less_than_a_period() {
    let ms = |nanos: i64| nanos as f64 / 1e6;
    for lost in [[0.0, 0.1, 0.0, 0.0], [0.1; 4]] {
        for phases in PHASES {
            let live = Live { phases, lost, jitter: 6 * MS, gives_up: true };
            let (with, without) = (live.run(3000), Live { gives_up: false, ..live }.run(3000));
            println!(
                "loss {lost:?}, phases {:?} ms: p99 of the wait {:.1} ms, without deadlines {:.1} ms; frames in no set {} and {}",
                phases.map(|phase| phase / MS),
                ms(with.p99()),
                ms(without.p99()),
                with.unused,
                without.unused
            );
            assert!(with.p99() <= PERIOD, "{:.1} ms", ms(with.p99()));
            // A deadline that came too early would leave frames without a set: at most one of a thousand.
            assert!(with.unused <= without.unused + 12, "{} of {}", with.unused, without.unused);
        }
    }
}

#[test]
fn a_camera_that_loses_every_other_frame_keeps_the_rest() {
    for phases in PHASES {
        let live = Live { phases, lost: [0.0, 0.5, 0.0, 0.0], jitter: 6 * MS, gives_up: true };
        let (with, without) = (live.run(3000), Live { gives_up: false, ..live }.run(3000));
        assert!(with.unused <= without.unused + 12, "{} of {}", with.unused, without.unused);
    }
}

#[test]
fn without_loss_every_set_is_as_whole_as_before() {
    for phases in PHASES {
        let live = Live { phases, lost: [0.0; 4], jitter: 12 * MS, gives_up: true };
        assert_eq!(live.run(1000).unused, Live { gives_up: false, ..live }.run(1000).unused);
    }
}

#[test]
fn frames_that_arrive_irregularly_are_awaited_by_their_own_times_alone() {
    let mut sync = Synchronizer::new(&["a".into(), "b".into()], &SyncSettings::default());
    for n in 0..40 {
        // The second camera's frames take ever longer, as from a source that is slower than its times say.
        sync.push_at(frame("a", n * PERIOD), n * PERIOD);
        sync.push_at(frame("b", n * PERIOD), n * PERIOD + n * 20 * MS);
    }
    sync.push_at(frame("a", 40 * PERIOD), 40 * PERIOD);
    assert_eq!(sync.next_deadline(), None);
    assert!(sync.give_up(i64::MAX).is_empty());
}

#[test]
fn absurd_times_do_no_harm() {
    let mut sync = Synchronizer::new(&["a".into(), "b".into()], &SyncSettings::default());
    for (n, nanos) in [0, i64::MAX, i64::MIN, 5, -1].into_iter().cycle().take(200).enumerate() {
        sync.push_at(frame(CAMERAS[n % 2], nanos), if n % 3 == 0 { i64::MIN } else { i64::MAX });
        let _ = (sync.next_deadline(), sync.give_up(nanos));
    }
}
