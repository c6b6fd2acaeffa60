//! Frames that will not come: a live frame set waits for a camera until its frame would have arrived.
//!
//! Frames' own times alone prove a loss with the camera's next frame, a period later, or two where that one is lost too. Cameras whose
//! frames arrive as regularly as they are stamped are awaited for less.

use flyrig_types::{Frame, FrameSet};

use crate::sync::{Camera, Synchronizer};

impl Camera {
    /// Returns the period at which the camera captures, also where most of its frames are lost; those intervals are whole periods.
    fn own_period(&self) -> Option<u64> {
        let (usual, least) = (self.period()?, *self.intervals.iter().min()?);
        Some(if usual / 3 > least / 2 { least } else { usual })
    }
}

impl Synchronizer {
    /// Adds a live frame that has arrived at this time, nanoseconds of a clock that is never set, as [`Self::push`] does.
    pub fn push_at(&mut self, frame: Frame, now_nanos: i64) -> Vec<FrameSet> {
        if let Some(camera) = self.cameras.iter_mut().find(|camera| camera.id == frame.camera) {
            camera.arrivals.add(now_nanos.saturating_sub(frame.capture_nanos.saturating_sub(camera.lag)));
        }
        self.push(frame)
    }

    /// Returns the time by the clock of [`Self::push_at`] at which [`Self::give_up`] returns the next frame set; `None` where only a frame
    /// can complete it.
    #[must_use]
    pub fn next_deadline(&self) -> Option<i64> {
        let (clock, nanos) = self.next_tick()?;
        let lacking = (0..self.cameras.len()).filter(|slot| !self.has_passed(*slot, nanos));
        lacking.map(|slot| self.deadline(slot, clock, nanos)).try_fold(i64::MIN, |all, one| Some(all.max(one?)))
    }

    /// Returns the frame sets whose missing frames would have arrived by now. Call it while no frame waits to be pushed.
    pub fn give_up(&mut self, now_nanos: i64) -> Vec<FrameSet> {
        let mut sets = Vec::new();
        while self.next_deadline().is_some_and(|deadline| deadline <= now_nanos) {
            let Some((clock, nanos)) = self.next_tick() else { break };
            sets.extend(self.take_tick(clock, nanos));
        }
        sets
    }

    /// Returns when a camera's frame for an instant should have arrived; `None` where that is not known.
    fn deadline(&self, slot: usize, clock: usize, nanos: i64) -> Option<i64> {
        let camera = self.cameras.get(slot)?;
        let (period, latest) = (camera.own_period()?, camera.latest?);
        let longest = camera.arrivals.longest(period)?;
        let (period, margin) = (i64::try_from(period).ok()?, i64::try_from(period / 4).ok()?);
        let offset = camera.offset.filter(|(by, _)| *by == clock).map_or(0, |(_, offset)| offset);
        let aim = nanos.saturating_add(offset);
        let has_it = camera.nearest(aim).is_some_and(|time| time.abs_diff(aim) <= margin.unsigned_abs());
        // The frame after the last that comes nearest to the aim: those between may be lost as well.
        let periods = aim.saturating_sub(latest).saturating_add(period / 2).div_euclid(period.max(1)).max(1);
        let expected = latest.saturating_add(periods.saturating_mul(period));
        let is_far = expected.abs_diff(nanos) > self.window.saturating_add(self.window / 2);
        if has_it || is_far { Some(i64::MIN) } else { Some(expected.saturating_add(longest).saturating_add(margin)) }
    }
}
