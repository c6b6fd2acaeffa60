//! Synchroniser: forms frame sets of one instant from free-running cameras.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
};

use flyrig_types::{CameraId, Frame, FrameSet, SetKind};
use serde::{Deserialize, Serialize};

use crate::arrivals::Arrivals;
use crate::settings::SyncSettings;

/// Most frames of a camera that wait for a frame set: a runaway clock must not exhaust the memory.
const MAX_PENDING: usize = 64;
/// Spread of the time offsets that allows one more waiting frame, nanoseconds: a period at 120 frames per second.
const PENDING_STEP: u64 = 8_000_000;

/// Window before the master's period is known, nanoseconds: half a period at 30 frames per second.
const FIRST_WINDOW: u64 = 16_666_667;
/// Shortest wait of a frame set for a camera of unknown delay, nanoseconds: three periods at 30 frames per second.
const LEAST_WAIT: u64 = 100_000_000;
/// Longest such wait: one odd interval of a camera that has just started must not stall the rig.
const MOST_WAIT: u64 = 1_000_000_000;
/// Intervals of a camera whose median is its period.
const INTERVALS: usize = 9;

/// Frames of one camera that joined no frame set.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DropCounts {
    /// Frames that arrived after their frame set was emitted.
    pub too_old: u64,
    /// Frames with the exact time of another frame of the camera.
    pub duplicate: u64,
    /// Frames that waited, but a nearer frame was used or no frame set came near enough.
    pub superseded: u64,
    /// Frames with a time far ahead of every camera's, which neither the camera's next frame nor another camera
    /// confirmed.
    pub wild: u64,
}

impl DropCounts {
    /// Returns the total of all kinds.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.too_old + self.duplicate + self.superseded + self.wild
    }
}

/// Counts of a [`Synchronizer`].
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SyncCounts {
    /// Frame sets with every camera.
    pub complete: u64,
    /// Frame sets that lack a camera.
    pub partial: u64,
    /// Frames that joined no frame set, per camera in rig order.
    pub dropped_frames: Vec<DropCounts>,
    /// Frames of cameras outside the rig.
    pub unknown_camera: u64,
}

/// Synchroniser that groups the frames nearest in time to those of a master camera.
///
/// A frame set is emitted as soon as nothing nearer can come (every camera that is not silent has delivered a frame at
/// or past its time) or when it has waited [`SyncSettings::max_wait_nanos`]; live, also once its missing frames would
/// have arrived ([`Self::give_up`]). A frame that claims to be farther than
/// that ahead of all others is held back until a second one confirms it: a single wrong timestamp must not move the
/// time of the whole rig. Time is the frames' own: identical frames pushed in the same order give identical frame sets.
/// A frame is used at most once, the times of frame sets increase strictly, and a frame set that follows another
/// camera's clock than the previous one lies more than the window after it. All cameras must share one clock; create a
/// new synchroniser when that clock restarts.
///
/// ```
/// use flyrig_sync::{SyncSettings, Synchronizer};
/// use flyrig_types::{CameraId, Frame, Image, PixelFormat};
///
/// let frame = |camera: &CameraId, sequence: u64, capture_nanos: i64| -> Result<Frame, Box<dyn std::error::Error>> {
///     let image = Image::new(1, 1, PixelFormat::Gray8, vec![0])?;
///     Ok(Frame { camera: camera.clone(), sequence, capture_nanos, exposure_nanos: None, image, mask: None })
/// };
/// let cameras: [CameraId; 2] = ["left".into(), "right".into()];
/// let mut synchronizer = Synchronizer::new(&cameras, &SyncSettings::default());
/// let mut sets = Vec::new();
/// for n in 0..10 {
///     let nanos = n as i64 * 33_333_333;
///     // The second camera runs 4 ms behind.
///     sets.extend(synchronizer.push(frame(&cameras[0], n, nanos)?));
///     sets.extend(synchronizer.push(frame(&cameras[1], n, nanos + 4_000_000)?));
/// }
/// sets.extend(synchronizer.flush());
/// assert_eq!(sets.len(), 10);
/// assert_eq!(synchronizer.counts().complete, 10);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Synchronizer {
    pub(crate) cameras: Vec<Camera>,
    /// Slots in the order in which their clocks lead: the master, then the rig's order.
    clock_order: Vec<usize>,
    pub(crate) window: u64,
    /// Whether the window is half of the master's period.
    follows_period: bool,
    max_wait: u64,
    /// Spread of the known time offsets, by which frames of one instant may arrive later, nanoseconds.
    spread: u64,
    /// Whether [`Self::max_wait`] follows the master's period.
    waits_periods: bool,
    /// Time of the first frame of all: cameras not seen yet count as silent since then.
    first_nanos: Option<i64>,
    last_set: Option<(i64, usize)>,
    sets: u64,
    counts: SyncCounts,
}

#[derive(Debug)]
pub(crate) struct Camera {
    pub id: CameraId,
    /// Time offset, subtracted from its timestamps, nanoseconds.
    pub lag: i64,
    /// Waiting frames, by time.
    pending: BTreeMap<i64, Arc<Frame>>,
    /// Frame far ahead of all others, not confirmed yet.
    suspect: Option<Arc<Frame>>,
    /// Time of the frame pushed last. Not the largest: one absurd time must not persist.
    pub latest: Option<i64>,
    /// Interval between the previous frame and that one, nanoseconds.
    interval: Option<u64>,
    /// Recent intervals, newest last.
    pub intervals: VecDeque<u64>,
    /// Per other camera, the frames since this one's last instant.
    missed: Vec<u64>,
    /// Time of the last frame that joined a frame set.
    used: Option<i64>,
    /// Distance of that frame from the frame set's time, and the slot whose clock the frame set followed.
    pub offset: Option<(usize, i64)>,
    /// Latencies of its frames, where they are live.
    pub arrivals: Arrivals,
}

impl Camera {
    /// Returns the frame period: the median of recent intervals, since a lost frame doubles one of them.
    pub fn period(&self) -> Option<u64> {
        let mut sorted = [0; INTERVALS];
        let sorted = &mut sorted[..self.intervals.len()];
        sorted.iter_mut().zip(&self.intervals).for_each(|(to, from)| *to = *from);
        sorted.sort_unstable();
        sorted.get(sorted.len() / 2).copied()
    }

    /// Returns the time of the waiting frame nearest to a time.
    pub fn nearest(&self, nanos: i64) -> Option<i64> {
        let before = self.pending.range(..=nanos).next_back().map(|(time, _)| *time);
        let after = self.pending.range(nanos..).next().map(|(time, _)| *time);
        before.into_iter().chain(after).min_by_key(|time| time.abs_diff(nanos))
    }
}

impl Synchronizer {
    /// Creates a synchroniser for the cameras of a rig, in its order. A master that is not among them is ignored with a
    /// warning, and the first camera leads.
    #[must_use]
    pub fn new(cameras: &[CameraId], settings: &SyncSettings) -> Self {
        let master = settings.master.as_ref().and_then(|master| {
            let slot = cameras.iter().position(|id| id == master);
            if slot.is_none() {
                tracing::warn!("sync master {master} is not a camera of the rig; the first camera leads");
            }
            slot
        });
        let mut clock_order: Vec<usize> = (0..cameras.len()).collect();
        if let Some(master) = master {
            clock_order.retain(|&slot| slot != master);
            clock_order.insert(0, master);
        }
        let lag = |id: &CameraId| settings.lags_nanos.get(id).copied().unwrap_or_default();
        let spread = match (cameras.iter().map(lag).max(), cameras.iter().map(lag).min()) {
            (Some(most), Some(least)) => most.abs_diff(least),
            _ => 0,
        };
        Self {
            cameras: cameras
                .iter()
                .map(|id| Camera {
                    id: id.clone(),
                    lag: lag(id),
                    pending: BTreeMap::new(),
                    suspect: None,
                    latest: None,
                    interval: None,
                    intervals: VecDeque::with_capacity(INTERVALS + 1),
                    missed: vec![0; cameras.len()],
                    used: None,
                    offset: None,
                    arrivals: Arrivals::default(),
                })
                .collect(),
            clock_order,
            window: settings.window_nanos.unwrap_or(FIRST_WINDOW),
            follows_period: settings.window_nanos.is_none(),
            max_wait: settings.max_wait_nanos.unwrap_or(LEAST_WAIT).saturating_add(spread),
            spread,
            waits_periods: settings.max_wait_nanos.is_none(),
            first_nanos: None,
            last_set: None,
            sets: 0,
            counts: SyncCounts { dropped_frames: vec![DropCounts::default(); cameras.len()], ..SyncCounts::default() },
        }
    }

    /// Adds a frame and returns the frame sets that it completes, in the order of time.
    pub fn push(&mut self, frame: Frame) -> Vec<FrameSet> {
        let Some(slot) = self.cameras.iter().position(|camera| camera.id == frame.camera) else {
            self.counts.unknown_camera += 1;
            return Vec::new();
        };
        let nanos = frame.capture_nanos.saturating_sub(self.cameras[slot].lag);
        let frame = Frame { capture_nanos: nanos, ..frame };
        // A slow camera's next frame is no surprise.
        let plausible = self.max_wait.max(self.cameras[slot].interval.unwrap_or(0).saturating_mul(4));
        let far_ahead = self.now().is_some_and(|now| nanos > now && nanos.abs_diff(now) > plausible);
        let near = |suspect: &Arc<Frame>| suspect.capture_nanos.abs_diff(nanos) <= plausible;
        let own = self.cameras[slot].suspect.as_ref().is_some_and(|suspect| suspect.capture_nanos < nanos);
        if !far_ahead {
            // Its clock is plausible again.
            let before = self.cameras[slot].suspect.take();
            self.counts.dropped_frames[slot].wild += u64::from(before.is_some());
        } else if own || self.suspects().any(near) {
            // The rig's time did jump, after a pause of all cameras for example.
            for other in 0..self.cameras.len() {
                if let Some(suspect) = self.cameras[other].suspect.take() {
                    self.accept(other, suspect);
                }
            }
        } else {
            let before = self.cameras[slot].suspect.replace(Arc::new(frame));
            self.counts.dropped_frames[slot].wild += u64::from(before.is_some());
            return Vec::new();
        }
        self.accept(slot, Arc::new(frame));
        self.drain(false)
    }

    fn suspects(&self) -> impl Iterator<Item = &Arc<Frame>> {
        self.cameras.iter().filter_map(|camera| camera.suspect.as_ref())
    }

    fn accept(&mut self, slot: usize, frame: Arc<Frame>) {
        let nanos = frame.capture_nanos;
        self.first_nanos.get_or_insert(nanos);
        for other in &mut self.cameras {
            // It belongs to the same instant and adds no information.
            let later = other.latest.is_none_or(|latest| nanos > latest && nanos.abs_diff(latest) > self.window);
            other.missed[slot] += u64::from(later);
        }
        self.cameras[slot].missed.fill(0);
        let outdated = self.last_set.is_some_and(|(set, _)| nanos < set && nanos.abs_diff(set) >= self.window);
        let camera = &mut self.cameras[slot];
        let dropped = &mut self.counts.dropped_frames[slot];
        camera.interval = camera.latest.map(|latest| latest.abs_diff(nanos));
        camera.latest = Some(nanos);
        camera.intervals.extend(camera.interval.filter(|interval| *interval > 0));
        if camera.intervals.len() > INTERVALS {
            camera.intervals.pop_front();
        }
        if let Some(period) = camera.period().filter(|_| self.clock_order.first() == Some(&slot)) {
            if self.follows_period {
                self.window = period / 2;
            }
            if self.waits_periods {
                self.max_wait = period.saturating_mul(3).clamp(LEAST_WAIT, MOST_WAIT).saturating_add(self.spread);
            }
        }
        if camera.used == Some(nanos) || camera.pending.contains_key(&nanos) {
            dropped.duplicate += 1;
        } else if outdated || camera.used.is_some_and(|used| nanos < used) {
            dropped.too_old += 1;
        } else {
            camera.pending.insert(nanos, frame);
            if camera.pending.len() as u64 > MAX_PENDING as u64 + self.spread / PENDING_STEP {
                camera.pending.pop_first();
                dropped.superseded += 1;
            }
        }
    }

    /// Returns the frame sets that were still waiting, at the end of a stream, and drops the frames that joined none.
    pub fn flush(&mut self) -> Vec<FrameSet> {
        let sets = self.drain(true);
        for (camera, dropped) in self.cameras.iter_mut().zip(&mut self.counts.dropped_frames) {
            dropped.superseded += camera.pending.len() as u64;
            camera.pending.clear();
            dropped.wild += u64::from(camera.suspect.take().is_some());
        }
        sets
    }

    /// Returns the counts so far.
    #[must_use]
    pub fn counts(&self) -> &SyncCounts {
        &self.counts
    }

    fn drain(&mut self, flush: bool) -> Vec<FrameSet> {
        let mut sets = Vec::new();
        while let Some((clock, nanos)) = self.next_tick() {
            if !(flush || self.is_again(clock, nanos) || self.is_certain(nanos)) {
                break;
            }
            sets.extend(self.take_tick(clock, nanos));
        }
        sets
    }

    /// Returns whether the instant of the last set is met again, as just after a change of clock.
    fn is_again(&self, clock: usize, nanos: i64) -> bool {
        self.last_set.is_some_and(|(last, by)| by != clock && nanos.abs_diff(last) <= self.window)
    }

    /// Emits the frame set of an instant, or drops the frame of one that is met again.
    pub(crate) fn take_tick(&mut self, clock: usize, nanos: i64) -> Option<FrameSet> {
        if self.is_again(clock, nanos) {
            self.cameras[clock].pending.remove(&nanos);
            self.counts.dropped_frames[clock].superseded += 1;
            return None;
        }
        Some(self.emit(clock, nanos))
    }

    /// Returns the time of the newest frame.
    fn now(&self) -> Option<i64> {
        self.cameras.iter().filter_map(|camera| camera.latest).max()
    }

    fn is_silent(&self, slot: usize) -> bool {
        let camera = &self.cameras[slot];
        let since = camera.latest.or(self.first_nanos);
        let late = matches!((self.now(), since), (Some(now), Some(since)) if now.abs_diff(since) > self.max_wait);
        // The first frame after a gap is no proof: at a slow or uneven rate the others' are about to come.
        late && camera.missed.iter().any(|&frames| frames > 1)
    }

    /// Returns the next frame set's time and the camera that sets it.
    pub(crate) fn next_tick(&self) -> Option<(usize, i64)> {
        for &slot in &self.clock_order {
            let after_last = |nanos: &&i64| self.last_set.is_none_or(|(last, _)| **nanos > last);
            if let Some(nanos) = self.cameras[slot].pending.keys().find(after_last) {
                return Some((slot, *nanos));
            }
            if !self.is_silent(slot) {
                return None;
            }
        }
        None
    }

    fn is_certain(&self, nanos: i64) -> bool {
        let waited = self.now().is_some_and(|now| now > nanos && now.abs_diff(nanos) >= self.max_wait);
        waited || (0..self.cameras.len()).all(|slot| self.has_passed(slot, nanos))
    }

    /// Returns whether no frame of a camera at or before an instant is awaited.
    pub(crate) fn has_passed(&self, slot: usize, nanos: i64) -> bool {
        let camera = &self.cameras[slot];
        camera.latest.is_some_and(|latest| latest >= nanos)
            || camera.pending.contains_key(&nanos)
            || self.is_silent(slot)
    }

    fn emit(&mut self, clock: usize, nanos: i64) -> FrameSet {
        let mut frames = Vec::with_capacity(self.cameras.len());
        for (slot, camera) in self.cameras.iter_mut().enumerate() {
            // Beside a slow master, a lost frame of a fast camera must not be made up for by the next one.
            let own = camera.period().filter(|_| self.follows_period);
            let window = self.window.min(own.map_or(u64::MAX, |period| period / 5 * 3));
            let expected = camera.offset.filter(|(by, _)| *by == clock).map(|(_, offset)| nanos.saturating_add(offset));
            let steady = expected.and_then(|expected| camera.nearest(expected)).filter(|time| {
                let near = |to: i64, most: u64| time.abs_diff(to) <= most;
                near(nanos, window.saturating_add(window / 2)) && expected.is_some_and(|at| near(at, window / 2))
            });
            let nearest = steady.or_else(|| camera.nearest(nanos).filter(|time| time.abs_diff(nanos) <= window));
            let nearest = if slot == clock { Some(nanos) } else { nearest };
            frames.push(nearest.and_then(|time| camera.pending.remove(&time)));
            if let Some(time) = nearest {
                camera.used = nearest;
                camera.offset = Some((clock, time.saturating_sub(nanos)));
            }
            // What no later set can use: frames before the used one, and frames a window behind.
            let before_purge = camera.pending.len();
            camera.pending.retain(|time, _| {
                nearest.is_none_or(|used| *time > used) && (*time >= nanos || time.abs_diff(nanos) < window)
            });
            self.counts.dropped_frames[slot].superseded += (before_purge - camera.pending.len()) as u64;
        }
        let set = FrameSet { index: self.sets, master_nanos: nanos, frames };
        match set.kind() {
            SetKind::Complete => self.counts.complete += 1,
            SetKind::Partial => self.counts.partial += 1,
        }
        self.sets += 1;
        self.last_set = Some((nanos, clock));
        set
    }
}

#[cfg(test)]
#[path = "sync_tests.rs"]
pub(crate) mod tests;
