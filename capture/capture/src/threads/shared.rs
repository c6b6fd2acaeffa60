//! State shared by the threads of a rig, and the main loop of a camera's thread.

use std::{
    sync::{Arc, Condvar, Mutex},
    time::{Duration, Instant},
};

use crossbeam::channel::RecvTimeoutError;
use flyrig_types::{CameraId, Frame, Restarts, caught, wait_timeout};

use super::{
    course::Course,
    opener::Opening,
    pulse::Pulse,
    rate::RateMeter,
    stats::{CameraStats, Pacing},
};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::queue::LatestQueue;
use crate::source::CameraSource;
use crate::stage::Hand;
use crate::turns::Turns;
pub(super) use flyrig_types::lock;

/// Timeout of a source's call, after which its thread checks for a stop request.
const POLL: Duration = Duration::from_millis(200);
/// Pauses before a lost camera is tried again, doubling from the first to the last.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LAST_PAUSE: Duration = Duration::from_secs(2);
/// Longest pause between attempts to open a camera.
const LAST_OPEN_PAUSE: Duration = Duration::from_secs(5);
/// Duration of an opening after which it is reported, and reported again at each multiple.
const OPENING: Duration = Duration::from_secs(5);
/// Interval of the heartbeats of a waiting thread.
const TURN: Duration = Duration::from_millis(500);
/// Consecutive errors after which a source that fails instantly is throttled, so that it does not occupy a core.
const PATIENCE: u32 = 1000;

#[derive(Debug)]
pub(crate) struct ThreadsState {
    pub(super) queue: Arc<LatestQueue<Frame>>,
    /// Per slot: hand-over between a camera's thread and its stage; empty without stages.
    pub(super) hands: Vec<Hand>,
    pub(super) pacing: Pacing,
    pub(super) turns: Turns,
    pub(super) stats: Mutex<Vec<CameraStats>>,
    /// Per slot: heartbeats.
    pub(super) pulses: Vec<Pulses>,
    /// Wall time and capture time of the first frame of all, for pacing.
    pub(super) origin: Mutex<Option<(Instant, i64)>>,
    pub(super) stopped: Mutex<bool>,
    pub(super) stop: Condvar,
}

/// Heartbeats of the threads of one camera.
#[derive(Debug)]
pub(crate) struct Pulses {
    pub camera: Arc<Pulse>,
    pub stage: Arc<Pulse>,
    pub open: Arc<Pulse>,
}

impl Pulses {
    pub fn new(camera: &CameraId) -> Self {
        let pulse = |what: &str| Arc::new(Pulse::new(format!("{what} {camera}")));
        Self { camera: pulse("camera"), stage: pulse("stage"), open: pulse("open") }
    }
}

/// Origin of a camera's sources.
pub(super) enum Supply {
    /// Single source, until it fails for good.
    Once(Option<Box<dyn CameraSource>>),
    /// Sources from an opener, reopened as needed.
    Again(Opening),
}

/// Reason why a source is no longer read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// There are no more frames, or the queue is closed.
    Over,
    Failed,
}

impl ThreadsState {
    /// Returns the hand-over to a camera's stage.
    pub(crate) fn hand(&self, slot: usize) -> Option<&Hand> {
        self.hands.get(slot)
    }

    pub(crate) fn pulses(&self, slot: usize) -> &Pulses {
        &self.pulses[slot]
    }

    /// Runs a camera's thread until its camera ends.
    pub(super) fn run(&self, slot: usize, mut supply: Supply) {
        let (mut course, mut restarts) = (Course::default(), Restarts::default());
        loop {
            let source = match &mut supply {
                Supply::Once(source) => source.take(),
                Supply::Again(opening) => self.open(slot, opening),
            };
            let Some(mut source) = source else { break };
            lock(&self.stats)[slot].opened = true;
            let end = caught(|| self.read(slot, &mut *source, &mut course));
            {
                let mut stats = lock(&self.stats);
                (stats[slot].opened, stats[slot].rate) = (false, None);
            }
            // By itself: a source that is dropped while its own panic unwinds may panic again, which ends the process.
            let closed = caught(move || drop(source));
            if let Some(text) = end.as_ref().err().or(closed.as_ref().err()) {
                let camera = self.camera(slot);
                let then =
                    if matches!(supply, Supply::Once(_)) { "restart to use it again" } else { "opening it again" };
                let message = format!("its source failed inside: {text}; {then}");
                self.count(slot, CaptureError::new(&camera, CaptureErrorKind::Disconnected, message));
            }
            if end == Ok(End::Over) || matches!(supply, Supply::Once(_)) || self.is_stopped() {
                break;
            }
            course.restart(lock(&self.stats)[slot].health.clone());
            self.sleep_until(slot, restarts.after_failure(Instant::now()));
            if self.is_stopped() {
                break;
            }
            lock(&self.stats)[slot].restarts += 1;
        }
        self.pulses[slot].camera.rest();
        // What its stage still has to do comes first.
        match self.hands.get(slot) {
            Some(hand) => hand.close(),
            None => self.end(slot),
        }
    }

    /// Opens a camera, retrying as needed. `None` when the camera or the whole rig has ended.
    fn open(&self, slot: usize, opening: &Opening) -> Option<Box<dyn CameraSource>> {
        let mut pause = FIRST_PAUSE;
        while !self.is_stopped() {
            opening.requests.send(()).ok()?;
            match self.opened(slot, opening)? {
                Ok(source) => return Some(source),
                Err(error) => {
                    let is_over = error.kind == CaptureErrorKind::EndOfStream;
                    self.count(slot, error);
                    if is_over {
                        return None;
                    }
                }
            }
            self.sleep_until(slot, Instant::now() + pause);
            pause = (pause * 2).min(LAST_OPEN_PAUSE);
        }
        None
    }

    /// Waits for the camera's opener, but not past a stop request. An opening that hangs is reported and awaited: a
    /// second call would hang as well.
    fn opened(&self, slot: usize, opening: &Opening) -> Option<Result<Box<dyn CameraSource>, CaptureError>> {
        let mut late = Instant::now() + OPENING;
        loop {
            self.pulses[slot].camera.beat();
            match opening.results.recv_timeout(POLL) {
                Ok(result) => return Some(result),
                Err(RecvTimeoutError::Disconnected) => return None,
                Err(RecvTimeoutError::Timeout) if self.is_stopped() => return None,
                Err(RecvTimeoutError::Timeout) => {}
            }
            if Instant::now() >= late {
                let message = format!(
                    "was not opened within {} s and is waited for: its driver hangs; unplug it and plug it in again",
                    OPENING.as_secs()
                );
                self.count(slot, CaptureError::new(&self.camera(slot), CaptureErrorKind::Io, message));
                late += OPENING;
            }
        }
    }

    /// Marks a camera as ended after its last frame.
    pub(crate) fn end(&self, slot: usize) {
        self.turns.end(slot);
        let mut stats = lock(&self.stats);
        stats[slot].running = false;
        if stats.iter().all(|stats| !stats.running) {
            self.queue.close();
        }
    }

    pub(crate) fn camera(&self, slot: usize) -> CameraId {
        lock(&self.stats)[slot].camera.clone()
    }

    fn is_stopped(&self) -> bool {
        *lock(&self.stopped)
    }

    fn read(&self, slot: usize, source: &mut dyn CameraSource, course: &mut Course) -> End {
        let pulse = &self.pulses[slot].camera;
        let (mut pause, mut failures, mut rate) = (FIRST_PAUSE, 0, RateMeter::new());
        while !self.is_stopped() {
            pulse.beat();
            let result = source.next_frame(POLL);
            let health = course.health(source.health());
            let mode_fps = health.mode_fps();
            lock(&self.stats)[slot].health = health;
            let error = match result {
                Ok(mut frame) => {
                    (pause, failures) = (FIRST_PAUSE, 0);
                    let order_nanos = source.order_nanos(&frame);
                    course.number(&mut frame);
                    lock(&self.stats)[slot].rate = rate.add(&frame, mode_fps);
                    // Before its stage: a reader that runs ahead would overtake all frames but the last.
                    if self.pacing == Pacing::RealTime {
                        self.pace(slot, frame.capture_nanos);
                    }
                    let is_open = match self.hands.get(slot) {
                        Some(hand) => self.hand_over(slot, hand, frame, order_nanos),
                        None => self.deliver(slot, pulse, frame, order_nanos),
                    };
                    if is_open {
                        continue;
                    }
                    return End::Over;
                }
                Err(error) => error,
            };
            let kind = error.kind;
            if kind == CaptureErrorKind::EndOfStream {
                return End::Over;
            }
            // No frame yet is no error: who watches for silence looks at when the last frame came. But a camera that never
            // gave one says what it waits for.
            if kind == CaptureErrorKind::Timeout {
                let mut stats = lock(&self.stats);
                if stats[slot].frames == 0 {
                    stats[slot].last_error = Some(error);
                }
            } else {
                self.count(slot, error);
            }
            if !kind.is_recoverable() {
                return End::Failed;
            }
            if let (Pacing::Lossless, Some(nanos)) = (self.pacing, source.next_nanos()) {
                // The others go on without it, and it does not run ahead of them.
                pulse.rest();
                if !self.turns.wait(slot, nanos) {
                    return End::Over;
                }
                continue;
            }
            if matches!(kind, CaptureErrorKind::Disconnected | CaptureErrorKind::Io) {
                rate.reset();
                lock(&self.stats)[slot].rate = None;
            }
            failures += 1;
            // What is read without loss does not come back with the wall clock's time.
            let returns = self.pacing != Pacing::Lossless;
            if returns && matches!(kind, CaptureErrorKind::Disconnected | CaptureErrorKind::Io) {
                self.sleep_until(slot, Instant::now() + pause);
                pause = (pause * 2).min(LAST_PAUSE);
            } else if failures > PATIENCE {
                self.sleep_until(slot, Instant::now() + FIRST_PAUSE);
            }
        }
        End::Over
    }

    /// Passes a frame to the camera's stage; returns whether to continue.
    fn hand_over(&self, slot: usize, hand: &Hand, frame: Frame, order_nanos: i64) -> bool {
        if self.pacing == Pacing::Lossless {
            // Whoever takes the frames may take any time.
            self.pulses[slot].camera.rest();
            return hand.0.push_wait((frame, order_nanos)).is_ok();
        }
        let Ok(overtaken) = hand.0.push((frame, order_nanos)) else { return false };
        if overtaken.is_some() {
            lock(&self.stats)[slot].overtaken += 1;
        }
        true
    }

    /// Puts a frame into the queue; returns whether to continue. The pulse is that of the calling thread.
    pub(crate) fn deliver(&self, slot: usize, pulse: &Pulse, frame: Frame, order_nanos: i64) -> bool {
        if self.pacing == Pacing::Lossless {
            pulse.rest();
            if !self.turns.wait(slot, order_nanos) || self.queue.push_wait(frame).is_err() {
                return false;
            }
            lock(&self.stats)[slot].frames += 1;
            self.turns.done(slot, order_nanos);
            return true;
        }
        let Ok(oldest) = self.queue.push(frame) else { return false };
        let mut stats = lock(&self.stats);
        stats[slot].frames += 1;
        if let Some(oldest) = oldest
            && let Some(stats) = stats.iter_mut().find(|stats| stats.camera == oldest.camera)
        {
            stats.dropped += 1;
        }
        true
    }

    /// Sleeps until a frame is due; the first frame of all is due immediately, as are earlier ones.
    fn pace(&self, slot: usize, nanos: i64) {
        let (start, first) = *lock(&self.origin).get_or_insert_with(|| (Instant::now(), nanos));
        if nanos > first
            && let Some(due) = start.checked_add(Duration::from_nanos(nanos.abs_diff(first)))
        {
            self.sleep_until(slot, due);
        }
    }

    /// Sleeps in a camera's thread, but not past a stop request.
    fn sleep_until(&self, slot: usize, due: Instant) {
        let mut stopped = lock(&self.stopped);
        while !*stopped {
            self.pulses[slot].camera.beat();
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            stopped = wait_timeout(&self.stop, stopped, left.min(TURN));
        }
    }

    pub(crate) fn count_stage_restart(&self, slot: usize) {
        lock(&self.stats)[slot].stage_restarts += 1;
    }

    pub(crate) fn count(&self, slot: usize, error: CaptureError) {
        let mut stats = lock(&self.stats);
        let count = stats[slot].errors.entry(error.kind).or_default();
        *count += 1;
        // The 1st, 2nd, 4th ... of a kind: a camera that is gone all night must not fill the disk.
        if count.is_power_of_two() {
            tracing::warn!(kind = ?error.kind, count = *count, "{error}");
        }
        stats[slot].last_error = Some(error);
    }
}
