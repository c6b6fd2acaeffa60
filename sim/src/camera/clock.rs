//! Clock of the simulated cameras, which decides the next instant.

use std::sync::{Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use flyrig_types::{lock, wait_timeout};

/// Fraction of the time spent rendering, at most: a pause follows each instant, since real cameras leave the machine to
/// the reconstruction.
const DRAWING_PART: u32 = 2;

/// Progress of simulated time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SimTime {
    /// One frame interval per call of each source, regardless of the wall clock: every instant is simulated.
    Exact,
    /// Wall clock. Where rendering is slower than the frame rate, all cameras skip whole instants, as a slower rig
    /// would.
    Real,
}

/// Clock that assigns instants to the sources of one simulator in [`SimTime::Real`].
#[derive(Debug)]
pub(crate) struct RealClock {
    interval: Duration,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug)]
struct State {
    /// Wall time of instant 0.
    origin: Option<Instant>,
    /// Instant being taken; `None` before the first.
    index: Option<u64>,
    /// Wall time of its begin.
    began: Option<Instant>,
    /// End of the pause after it, once all cameras have delivered it.
    rest_until: Option<Instant>,
    cameras: Vec<Progress>,
    skipped: u64,
}

#[derive(Debug, Clone, Default)]
struct Progress {
    /// Last instant taken.
    last: Option<u64>,
    /// Whether its frame is still to be delivered.
    busy: bool,
    /// Whether the camera is gone, for good or for a while, so that the others do not wait for it.
    away: bool,
}

impl RealClock {
    pub(crate) fn new(cameras: usize, fps: f64) -> Self {
        Self {
            interval: flyrig_types::saturating_secs(1.0 / fps),
            state: Mutex::new(State {
                origin: None,
                index: None,
                began: None,
                rest_until: None,
                cameras: vec![Progress::default(); cameras],
                skipped: 0,
            }),
            changed: Condvar::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Returns the next instant for the camera in `slot`: the one that the others are taking if it lacks that,
    /// otherwise a new one once all have delivered the last and it is due. `None` when that is not within `timeout`.
    pub(crate) fn next(&self, slot: usize, timeout: Duration) -> Option<u64> {
        let deadline = flyrig_types::deadline_after(timeout);
        let mut state = self.lock();
        state.cameras[slot].away = false;
        // To have taken it is not enough: a camera that is still waiting for its image would fall behind the others.
        state.cameras[slot].busy = false;
        self.changed.notify_all();
        loop {
            if state.index.is_some() && state.cameras[slot].last != state.index {
                let index = state.index;
                state.cameras[slot] = Progress { last: index, busy: true, away: false };
                return index;
            }
            let now = Instant::now();
            let mut until = deadline;
            if state.cameras.iter().all(|camera| camera.away || (!camera.busy && camera.last == state.index)) {
                let origin = *state.origin.get_or_insert(now);
                let next = state.index.map_or(0, |index| index + 1);
                let current = (now.duration_since(origin).as_secs_f64() / self.interval.as_secs_f64()) as u64;
                let rested = state.rest_until(now);
                if current >= next && now >= rested {
                    state.begin(current, current - next, now);
                    continue;
                }
                let due = origin + flyrig_types::saturating_secs(self.interval.as_secs_f64() * next as f64);
                until = until.min(rested.max(due));
            }
            if now >= deadline {
                return None;
            }
            let wait = until.saturating_duration_since(now);
            state = wait_timeout(&self.changed, state, wait);
        }
    }

    /// Excludes the camera until it asks again.
    pub(crate) fn leave(&self, slot: usize) {
        self.lock().cameras[slot].away = true;
        self.changed.notify_all();
    }
}

impl State {
    /// Returns the end of the pause after the instant that all have delivered.
    fn rest_until(&mut self, now: Instant) -> Instant {
        let Some(began) = self.began else { return now };
        *self.rest_until.get_or_insert_with(|| began + now.duration_since(began) * DRAWING_PART)
    }

    fn begin(&mut self, index: u64, skipped: u64, now: Instant) {
        self.index = Some(index);
        (self.began, self.rest_until) = (Some(now), None);
        let before = self.skipped;
        self.skipped += skipped;
        // The 1st, 2nd, 4th ...: a rig that runs all night must not fill the disk.
        if before.checked_ilog2() != self.skipped.checked_ilog2() {
            tracing::warn!(
                skipped = self.skipped,
                "this machine cannot render the simulated cameras at their rate; instants are skipped. Lower sim.fps or the \
                 images' size, or set source.real_time = false to get every instant"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::ZERO;
    const LONG: Duration = Duration::from_secs(20);

    /// Returns a clock whose instants are all due.
    fn late(cameras: usize) -> RealClock {
        let clock = RealClock::new(cameras, 1000.0);
        clock.lock().origin = Instant::now().checked_sub(Duration::from_secs(5));
        clock
    }

    #[test]
    fn all_cameras_take_the_same_instants_and_late_ones_are_skipped_together() {
        let clock = late(3);
        let first = clock.next(0, NOW).unwrap();
        assert!(first >= 5000, "5 s late at 1000 a second, but the instant is {first}");
        // Camera 0 gets no second instant before the others have the first.
        assert_eq!(clock.next(0, Duration::from_millis(5)), None);
        assert_eq!(clock.next(2, NOW), Some(first));
        assert_eq!(clock.next(0, NOW), None);
        assert_eq!(clock.next(1, NOW), Some(first));
        assert_eq!(clock.next(1, NOW), None, "camera 2 has not delivered the first");
        let second = clock.next(2, LONG).unwrap();
        assert!(second > first);
        assert_eq!((clock.next(0, NOW), clock.next(1, NOW)), (Some(second), Some(second)));
        assert!(clock.lock().skipped >= 5000);
    }

    #[test]
    fn nobody_waits_for_a_camera_that_is_away_and_it_joins_in_when_it_returns() {
        let clock = late(2);
        let first = clock.next(0, NOW).unwrap();
        clock.leave(1);
        let second = clock.next(0, LONG).unwrap();
        assert!(second > first);
        assert_eq!(clock.next(1, NOW), Some(second));
        // One that leaves with an instant does not get it twice, not even when it is alone.
        clock.leave(0);
        clock.leave(1);
        assert!(clock.next(1, LONG).unwrap() > second);
    }

    #[test]
    fn drawing_leaves_half_of_the_time_to_others() {
        let clock = late(1);
        let start = Instant::now();
        clock.next(0, LONG).unwrap();
        std::thread::sleep(Duration::from_millis(10));
        let drawn = start.elapsed();
        assert!(drawn >= Duration::from_millis(10));
        clock.next(0, LONG).unwrap();
        assert!(start.elapsed() >= Duration::from_millis(20), "{:?}", start.elapsed());
    }

    #[test]
    fn an_instant_is_not_given_before_it_is_due() {
        let clock = RealClock::new(1, 0.1);
        assert_eq!(clock.next(0, NOW), Some(0));
        assert_eq!(clock.next(0, Duration::from_millis(1)), None);
        assert_eq!(clock.lock().skipped, 0);
    }
}
