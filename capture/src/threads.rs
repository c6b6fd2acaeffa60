//! One thread a camera, all into one queue.

use std::{
    any::Any,
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread::{Builder, JoinHandle},
    time::{Duration, Instant},
};

use flyrig_types::{CameraId, Frame};

use crate::{
    CameraSource, CaptureError, CaptureErrorKind, FrameStage, LatestQueue, SourceHealth, stage::Hand, turns::Turns,
};

/// How long a source may wait for a frame before its thread looks whether it shall stop.
const POLL: Duration = Duration::from_millis(200);
/// Pauses before a camera that is gone is asked again: doubling from the first to the last.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LAST_PAUSE: Duration = Duration::from_secs(2);
/// Errors in a row after which a source that fails at once is slowed, lest it takes a core.
const PATIENCE: u32 = 1000;

/// When frames go into the queue, and what happens when it is full.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Pacing {
    /// As the sources give them; the oldest is dropped. For live cameras.
    #[default]
    AsDelivered,
    /// At the pace of their capture times; the oldest is dropped. For a recording played as live.
    RealTime,
    /// As fast as they are taken out, nothing is dropped, and in the order of capture over all
    /// cameras, so that every run is the same. For evaluation.
    Lossless,
}

/// Settings of [`CaptureThreads`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThreadsConfig {
    /// Frames of all cameras together that wait in the queue.
    pub queue_capacity: usize,
    /// See [`Pacing`].
    pub pacing: Pacing,
}

impl Default for ThreadsConfig {
    fn default() -> Self {
        Self { queue_capacity: 16, pacing: Pacing::default() }
    }
}

/// What one camera's thread has done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraStats {
    /// Which camera.
    pub camera: CameraId,
    /// Frames put into the queue.
    pub frames: u64,
    /// Frames of this camera that were dropped out of the full queue.
    pub dropped: u64,
    /// Frames that newer ones overtook before the camera's stage (see [`FrameStage`]) came to them.
    pub overtaken: u64,
    /// Errors by kind; the end of a recording is none.
    pub errors: BTreeMap<CaptureErrorKind, u64>,
    /// The error that came last.
    pub last_error: Option<CaptureError>,
    /// What the source says of itself.
    pub health: SourceHealth,
    /// Whether the thread still reads.
    pub running: bool,
}

/// Reads every source in a thread of its own, named after its camera, into one queue.
///
/// A thread goes on after errors that may pass, with growing pauses while a camera is gone; a panic
/// inside a source ends that camera alone, as `Disconnected`. The queue closes when all threads
/// have ended. Dropping this stops the threads and waits for them.
///
/// With a [`FrameStage`] each camera has a second thread for it, so that a slow or damaged picture holds up neither the
/// driver's buffers nor another camera.
#[derive(Debug)]
pub struct CaptureThreads {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
pub(crate) struct Shared {
    queue: Arc<LatestQueue<Frame>>,
    /// By slot, between a camera's thread and its stage's; empty without stages.
    hands: Vec<Hand>,
    pacing: Pacing,
    turns: Turns,
    stats: Mutex<Vec<CameraStats>>,
    /// Wall time and capture time of the first frame of all, for pacing.
    origin: Mutex<Option<(Instant, i64)>>,
    stopped: Mutex<bool>,
    stop: Condvar,
}

impl CaptureThreads {
    /// Starts the threads.
    ///
    /// # Errors
    /// `Unsupported` when two sources have one name, `Io` when the system gives no thread.
    pub fn start(sources: Vec<Box<dyn CameraSource>>, config: ThreadsConfig) -> Result<Self, CaptureError> {
        Self::start_all(sources, Vec::new(), config)
    }

    /// The same, with a stage behind every source; each runs in a thread of its own.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn start_staged(
        sources: Vec<Box<dyn CameraSource>>,
        stage: impl Fn(&CameraId) -> Box<dyn FrameStage>,
        config: ThreadsConfig,
    ) -> Result<Self, CaptureError> {
        let stages = sources.iter().map(|source| stage(source.camera())).collect();
        Self::start_all(sources, stages, config)
    }

    fn start_all(
        sources: Vec<Box<dyn CameraSource>>,
        stages: Vec<Box<dyn FrameStage>>,
        config: ThreadsConfig,
    ) -> Result<Self, CaptureError> {
        let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
        for (i, camera) in cameras.iter().enumerate() {
            if cameras[..i].contains(camera) {
                let message = "is given twice; every source needs a name of its own";
                return Err(CaptureError::new(camera, CaptureErrorKind::Unsupported, message));
            }
        }
        let stats = |camera: &CameraId| CameraStats {
            camera: camera.clone(),
            frames: 0,
            dropped: 0,
            overtaken: 0,
            errors: BTreeMap::new(),
            last_error: None,
            health: SourceHealth::default(),
            running: true,
        };
        let shared = Arc::new(Shared {
            queue: Arc::new(LatestQueue::new(config.queue_capacity)),
            hands: stages.iter().map(|_| Hand::new()).collect(),
            pacing: config.pacing,
            turns: Turns::new(cameras.len()),
            stats: Mutex::new(cameras.iter().map(stats).collect()),
            origin: Mutex::new(None),
            stopped: Mutex::new(false),
            stop: Condvar::new(),
        });
        if cameras.is_empty() {
            shared.queue.close();
        }
        // From here on an early return drops this and stops what has started.
        let mut this = Self { shared, threads: Vec::with_capacity(2 * cameras.len()) };
        for (slot, stage) in stages.into_iter().enumerate() {
            let shared = Arc::clone(&this.shared);
            this.spawn("stage", &cameras[slot], move || shared.run_stage(slot, stage))?;
        }
        for (slot, source) in sources.into_iter().enumerate() {
            let shared = Arc::clone(&this.shared);
            this.spawn("camera", &cameras[slot], move || shared.run(slot, source))?;
        }
        Ok(this)
    }

    fn spawn(
        &mut self,
        what: &str,
        camera: &CameraId,
        work: impl FnOnce() + Send + 'static,
    ) -> Result<(), CaptureError> {
        let thread = Builder::new()
            .name(format!("{what} {camera}"))
            .spawn(work)
            .map_err(|error| CaptureError::new(camera, CaptureErrorKind::Io, format!("no thread: {error}")))?;
        self.threads.push(thread);
        Ok(())
    }

    /// Where the frames are; closed and empty after the last one.
    #[must_use]
    pub fn queue(&self) -> &Arc<LatestQueue<Frame>> {
        &self.shared.queue
    }

    /// A copy of the counts, in the order of the sources.
    #[must_use]
    pub fn stats(&self) -> Vec<CameraStats> {
        lock(&self.shared.stats).clone()
    }
}

impl Drop for CaptureThreads {
    fn drop(&mut self) {
        *lock(&self.shared.stopped) = true;
        self.shared.stop.notify_all();
        self.shared.queue.close();
        self.shared.hands.iter().for_each(Hand::close);
        self.shared.turns.close();
        for thread in self.threads.drain(..) {
            // A panic was caught and counted inside the thread.
            let _ = thread.join();
        }
    }
}

/// What is behind our locks is whole at every step.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn panic_text(panic: &(dyn Any + Send)) -> &str {
    panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("?")
}

impl Shared {
    /// The hand-over to a camera's stage.
    pub(crate) fn hand(&self, slot: usize) -> Option<&Hand> {
        self.hands.get(slot)
    }

    fn run(&self, slot: usize, source: Box<dyn CameraSource>) {
        // The source moves in, so that a panic in its Drop is caught too; it is never used again.
        let read = AssertUnwindSafe(move || self.read(slot, source));
        if let Err(panic) = catch_unwind(read) {
            let camera = self.camera(slot);
            let message = format!("its source failed inside: {}; restart to use it again", panic_text(&*panic));
            self.count(slot, CaptureError::new(&camera, CaptureErrorKind::Disconnected, message));
        }
        // What its stage still has to do comes first.
        match self.hands.get(slot) {
            Some(hand) => hand.close(),
            None => self.end(slot),
        }
    }

    /// The last frame of a camera is delivered.
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

    fn read(&self, slot: usize, mut source: Box<dyn CameraSource>) {
        let (mut pause, mut failures) = (FIRST_PAUSE, 0);
        while !*lock(&self.stopped) {
            let result = source.next_frame(POLL);
            lock(&self.stats)[slot].health = source.health();
            let error = match result {
                Ok(frame) => {
                    (pause, failures) = (FIRST_PAUSE, 0);
                    let order_nanos = source.order_nanos(&frame);
                    // Before its stage: a reader that runs ahead would overtake all frames but the last.
                    if self.pacing == Pacing::RealTime {
                        self.pace(frame.capture_nanos);
                    }
                    let is_open = match self.hands.get(slot) {
                        Some(hand) => self.hand_over(slot, hand, frame, order_nanos),
                        None => self.deliver(slot, frame, order_nanos),
                    };
                    if is_open {
                        continue;
                    }
                    return;
                }
                Err(error) => error,
            };
            let kind = error.kind;
            if kind == CaptureErrorKind::EndOfStream {
                return;
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
                return;
            }
            failures += 1;
            // What is read without loss does not come back with the wall clock's time.
            let returns = self.pacing != Pacing::Lossless;
            if returns && matches!(kind, CaptureErrorKind::Disconnected | CaptureErrorKind::Io) {
                self.sleep_until(Instant::now() + pause);
                pause = (pause * 2).min(LAST_PAUSE);
            } else if failures > PATIENCE {
                self.sleep_until(Instant::now() + FIRST_PAUSE);
            }
        }
    }

    /// To the camera's stage; whether to go on.
    fn hand_over(&self, slot: usize, hand: &Hand, frame: Frame, order_nanos: i64) -> bool {
        if self.pacing == Pacing::Lossless {
            return hand.0.push_wait((frame, order_nanos)).is_ok();
        }
        let Ok(overtaken) = hand.0.push((frame, order_nanos)) else { return false };
        if overtaken.is_some() {
            lock(&self.stats)[slot].overtaken += 1;
        }
        true
    }

    /// Whether to go on.
    pub(crate) fn deliver(&self, slot: usize, frame: Frame, order_nanos: i64) -> bool {
        if self.pacing == Pacing::Lossless {
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

    /// Sleeps until a frame is due; the first frame of all is due at once, earlier ones too.
    fn pace(&self, nanos: i64) {
        let (start, first) = *lock(&self.origin).get_or_insert_with(|| (Instant::now(), nanos));
        if nanos > first
            && let Some(due) = start.checked_add(Duration::from_nanos(nanos.abs_diff(first)))
        {
            self.sleep_until(due);
        }
    }

    /// Sleeps, but not through a stop.
    fn sleep_until(&self, due: Instant) {
        let mut stopped = lock(&self.stopped);
        while !*stopped {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            stopped = self.stop.wait_timeout(stopped, left).unwrap_or_else(PoisonError::into_inner).0;
        }
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
