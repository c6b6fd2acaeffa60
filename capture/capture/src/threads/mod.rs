//! Threads of the cameras, one per camera, all into one queue.

mod course;
mod opener;
mod pulse;
mod rate;
mod run_stage;
mod shared;
mod stats;

use std::{
    collections::BTreeMap,
    sync::{Arc, Condvar, Mutex},
    thread::{Builder, JoinHandle},
    time::{Duration, Instant},
};

use flyrig_types::{CameraId, Frame};

pub use self::opener::SourceOpener;
pub use self::rate::FrameRate;
pub use self::stats::{CameraStats, Pacing, ThreadsConfig};
use self::{
    opener::{How, Opening},
    pulse::Pulse,
    shared::{Pulses, Supply, ThreadsState, lock},
};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::queue::LatestQueue;
use crate::source::{CameraSource, SourceHealth};
use crate::stage::{FrameStage, Hand, Stage, StageMaker};
use crate::turns::Turns;

/// Time that dropping allows threads inside foreign code before it abandons them.
const CLOSING: Duration = Duration::from_secs(15);
/// Polling interval of that wait.
const LOOK: Duration = Duration::from_millis(2);

/// Threads that read every source, each named after its camera, into one queue.
///
/// A thread continues after recoverable errors, with growing pauses while a camera is gone. A source that fails for
/// good or panics (`Disconnected`) ends that camera only; if it came from a [`SourceOpener`] with a function, it is
/// reopened: five times immediately, then once per minute. The queue closes when all threads have ended. Dropping stops
/// the threads and waits for them; a thread that does not return from a source's or stage's call within 15 seconds is
/// abandoned.
///
/// With a [`FrameStage`] each camera has a second thread, so that a slow or damaged image blocks neither the driver's
/// buffers nor another camera.
#[derive(Debug)]
pub struct CaptureThreads {
    shared: Arc<ThreadsState>,
    threads: Vec<JoinHandle<()>>,
}

impl CaptureThreads {
    /// Starts a thread for each source.
    ///
    /// # Errors
    /// `Unsupported` when two sources have the same name, `Io` when the system cannot start a thread.
    pub fn start(sources: Vec<Box<dyn CameraSource>>, config: ThreadsConfig) -> Result<Self, CaptureError> {
        Self::start_all(sources.into_iter().map(SourceOpener::ready).collect(), Vec::new(), config)
    }

    /// Starts as [`Self::start`], with a stage behind every source, each in a thread of its own.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn start_staged(
        sources: Vec<Box<dyn CameraSource>>,
        stage: impl Fn(&CameraId) -> Box<dyn FrameStage>,
        config: ThreadsConfig,
    ) -> Result<Self, CaptureError> {
        let stages = sources.iter().map(|source| Stage { stage: stage(source.camera()), maker: None }).collect();
        Self::start_all(sources.into_iter().map(SourceOpener::ready).collect(), stages, config)
    }

    /// Starts the threads before the cameras are open. Each camera is opened in a thread of its own (`open NAME`),
    /// retried with pauses of up to 5 s, and joins once it is open; until then its [`CameraStats`] hold the last error.
    ///
    /// Only live cameras are awaited: with any pacing but [`Pacing::AsDelivered`] all sources are opened first, one
    /// after the other, and none is reopened, since a recording would start over.
    ///
    /// # Errors
    /// As [`Self::start`]; where the sources are opened first, also the first of their errors.
    pub fn start_opening(openers: Vec<SourceOpener>, config: ThreadsConfig) -> Result<Self, CaptureError> {
        Self::start_all(openers, Vec::new(), config)
    }

    /// Starts as [`Self::start_opening`], with a stage behind every source; a stage that panics is created anew.
    ///
    /// # Errors
    /// As [`Self::start_opening`].
    pub fn start_opening_staged(
        openers: Vec<SourceOpener>,
        stage: impl Fn(&CameraId) -> Box<dyn FrameStage> + Send + Sync + 'static,
        config: ThreadsConfig,
    ) -> Result<Self, CaptureError> {
        let maker: StageMaker = Arc::new(stage);
        let made = |opener: &SourceOpener| Stage { stage: maker(opener.camera()), maker: Some(Arc::clone(&maker)) };
        let stages = openers.iter().map(made).collect();
        Self::start_all(openers, stages, config)
    }

    fn start_all(openers: Vec<SourceOpener>, stages: Vec<Stage>, config: ThreadsConfig) -> Result<Self, CaptureError> {
        let cameras: Vec<CameraId> = openers.iter().map(|opener| opener.camera().clone()).collect();
        for (i, camera) in cameras.iter().enumerate() {
            if cameras[..i].contains(camera) {
                let message = "is given twice; every source needs a name of its own";
                return Err(CaptureError::new(camera, CaptureErrorKind::Unsupported, message));
            }
        }
        let openers = if config.pacing == Pacing::AsDelivered {
            openers
        } else {
            let now = |opener: SourceOpener| opener.open_now().map(SourceOpener::ready);
            openers.into_iter().map(now).collect::<Result<_, _>>()?
        };
        let stats = |camera: &CameraId| CameraStats {
            camera: camera.clone(),
            frames: 0,
            dropped: 0,
            overtaken: 0,
            errors: BTreeMap::new(),
            last_error: None,
            health: SourceHealth::default(),
            rate: None,
            restarts: 0,
            stage_restarts: 0,
            opened: false,
            running: true,
        };
        let shared = Arc::new(ThreadsState {
            queue: Arc::new(LatestQueue::new(config.queue_capacity)),
            hands: stages.iter().map(|_| Hand::new()).collect(),
            pacing: config.pacing,
            turns: Turns::new(cameras.len()),
            stats: Mutex::new(cameras.iter().map(stats).collect()),
            pulses: cameras.iter().map(Pulses::new).collect(),
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
        for (slot, opener) in openers.into_iter().enumerate() {
            let shared = Arc::clone(&this.shared);
            let supply = match opener.how {
                How::Ready(source) => Supply::Once(Some(source)),
                How::Factory(open) => {
                    Supply::Again(Opening::start(&cameras[slot], open, Arc::clone(&shared.pulses[slot].open))?)
                }
            };
            this.spawn("camera", &cameras[slot], move || shared.run(slot, supply))?;
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

    /// Returns the queue of frames; closed and empty after the last one.
    #[must_use]
    pub fn queue(&self) -> &Arc<LatestQueue<Frame>> {
        &self.shared.queue
    }

    /// Returns a copy of the counts, in the order of the sources.
    #[must_use]
    pub fn stats(&self) -> Vec<CameraStats> {
        lock(&self.shared.stats).clone()
    }

    /// Returns the busy threads by name (`camera NAME`, `stage NAME`, `open NAME`), with the time since each began its
    /// last turn. A turn is one call of a source, a stage or an opener. Threads that have ended, or wait for a lossless
    /// reader, are omitted.
    #[must_use]
    pub fn activity(&self) -> Vec<(String, Duration)> {
        self.quiet().map(|(pulse, quiet)| (pulse.name().to_owned(), quiet)).collect()
    }

    /// Returns the names of threads whose last turn began longer ago than this. The threads of a healthy camera and
    /// stage take several turns per second, also while the camera is gone; opening may take seconds.
    #[must_use]
    pub fn stuck(&self, longer_than: Duration) -> Vec<String> {
        let stuck = self.quiet().filter(|(_, quiet)| *quiet > longer_than);
        stuck.map(|(pulse, _)| pulse.name().to_owned()).collect()
    }

    fn quiet(&self) -> impl Iterator<Item = (&Pulse, Duration)> {
        let pulses = self.shared.pulses.iter().flat_map(|of| [&*of.camera, &*of.stage, &*of.open]);
        pulses.filter_map(|pulse| pulse.quiet().map(|quiet| (pulse, quiet)))
    }
}

impl Drop for CaptureThreads {
    fn drop(&mut self) {
        *lock(&self.shared.stopped) = true;
        self.shared.stop.notify_all();
        self.shared.queue.close();
        self.shared.hands.iter().for_each(Hand::close);
        self.shared.turns.close();
        let deadline = Instant::now() + CLOSING;
        for thread in self.threads.drain(..) {
            while !thread.is_finished() && Instant::now() < deadline {
                std::thread::sleep(LOOK);
            }
            if thread.is_finished() {
                // A panic was caught and counted inside the thread.
                let _ = thread.join();
            } else {
                let name = thread.thread().name().unwrap_or_default().to_owned();
                tracing::error!("thread {name:?} hangs in its driver and is left behind; unplug its camera");
            }
        }
    }
}
