//! Colour layers while wall clocks are set: those of the rig and of the viewer are the test's own.

use super::*;
use crate::header::empty_header;

const SECOND: i64 = 1_000_000_000;
const STEPS: [i64; 8] =
    [SECOND / 10, -SECOND / 10, SECOND / 2, -SECOND / 2, 10 * SECOND, -10 * SECOND, 3600 * SECOND, -3600 * SECOND];

/// Viewer that receives the motion of a rig over a line without queues.
struct Line {
    inbox: Inbox,
    start: Moment,
    /// Time since the start, nanoseconds.
    nanos: i64,
    sequence: u64,
    /// Identity of the rig's computer since its boot, and its monotonic clock at the start; 0 for a program that does not send it.
    rig: (u64, i64),
    /// Steps of the wall clocks of rig and viewer so far, nanoseconds.
    steps: [i64; 2],
}

impl Line {
    fn new(rig: (u64, i64)) -> Self {
        let inbox = Inbox::new("viewer-me".to_owned(), 1 << 20);
        inbox.begin_colors();
        let start = Moment { instant: Instant::now(), monotonic_nanos: 5 * SECOND, unix_nanos: 1 << 60 };
        Self { inbox, start, nanos: 0, sequence: 0, rig, steps: [0; 2] }
    }

    /// Receives 30 motions per second; returns the smallest number of layers that was wanted meanwhile.
    fn run(&mut self, secs: i64) -> usize {
        let mut least = usize::MAX;
        for _ in 0..30 * secs {
            self.nanos += SECOND / 30;
            self.sequence += 1;
            let (host, clock_nanos) = self.rig;
            let header = Header {
                kind: MessageKind::Motion,
                sequence: self.sequence,
                publish_unix_nanos: (1 << 60) + self.nanos + self.steps[0],
                publish_nanos: if clock_nanos == 0 { 0 } else { clock_nanos + self.nanos },
                host,
                ..empty_header()
            };
            let late = 20_000_000;
            let now = Moment {
                instant: self.start.instant + Duration::from_nanos(self.nanos.unsigned_abs()),
                monotonic_nanos: self.start.monotonic_nanos + self.nanos + late,
                unix_nanos: self.start.unix_nanos + self.nanos + late + self.steps[1],
            };
            let key = format!("flyrig/v1/r/{}", keys::motion_label(0));
            self.inbox.accept(&key, &header.encode(), 1, || Bytes::from_static(b"x"), now).unwrap();
            least = least.min(self.inbox.color_layers());
        }
        least
    }
}

#[test]
fn wall_clocks_that_are_set_cost_no_layer() {
    for end in [0, 1] {
        // On another computer, and on this one.
        for host in [77, host::host_id()] {
            let mut line = Line::new((host, 3 * SECOND));
            line.run(10);
            for step in STEPS {
                line.steps[end] += step;
                let least = line.run(5);
                assert_eq!(least, flyrig_stream::LAYERS, "step {step} ns at end {end}");
            }
        }
    }
}

#[test]
fn a_rig_whose_computer_was_started_again_costs_no_layer() {
    let mut line = Line::new((77, 90_000 * SECOND));
    line.run(10);
    // Its monotonic clock begins anew, at another computer too.
    for rig in [(78, SECOND), (79, 500_000 * SECOND)] {
        line.rig = rig;
        assert_eq!(line.run(10), flyrig_stream::LAYERS, "{rig:?}");
    }
}

#[test]
fn an_older_rig_is_timed_by_wall_clocks() {
    let mut line = Line::new((77, 0));
    line.run(10);
    assert_eq!(line.run(10), flyrig_stream::LAYERS);
    line.steps[1] += SECOND;
    assert!(line.run(5) < flyrig_stream::LAYERS, "nothing else tells a step from a queue");
}
