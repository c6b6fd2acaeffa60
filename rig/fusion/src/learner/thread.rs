//! Thread that a workshop works in, beside the rig.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use flyrig_types::{caught, deadline_after, saturating_secs};

use super::{
    key_sets::KeySet,
    workshop::{Beginning, Verdict, Workshop},
};
use crate::{error::FusionError, health::release_free_memory};

/// Name of the thread.
const NAME: &str = "learner";
/// Key sets that wait for the thread.
const WAITING: usize = 4;
/// Share of the processors that the thread takes.
const SHARE: f64 = 0.2;
/// Share of the time in which the thread keeps a graphics adapter busy.
const ADAPTER_SHARE: f64 = 0.2;
/// Time from one look at the queue to the next while there is nothing to do, or while work is held.
const IDLE: Duration = Duration::from_millis(100);

/// Thread with its queues. It ends when this value is dropped.
#[derive(Debug)]
pub(super) struct LearnerThread {
    sets: Option<SyncSender<KeySet>>,
    verdicts: Option<Receiver<Result<Verdict, String>>>,
    /// Whether the thread waits, so that the rig gets everything.
    held: Arc<AtomicBool>,
    /// Whether the thread ends as soon as it can.
    stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl LearnerThread {
    /// Starts the thread.
    pub fn start(beginning: Beginning) -> Result<Self, FusionError> {
        let (sets, waiting) = sync_channel(WAITING);
        let (found, verdicts) = sync_channel(WAITING);
        let held = Arc::new(AtomicBool::new(false));
        let is_held = Arc::clone(&held);
        let stopped = Arc::clone(&beginning.stopped);
        let work = move || {
            let result = caught(|| work(beginning, &waiting, &found, &is_held));
            let failure = match result {
                Ok(Ok(())) => return,
                Ok(Err(error)) => error.to_string(),
                Err(panic) => format!("panic: {panic}"),
            };
            drop(found.send(Err(failure)));
        };
        let thread = std::thread::Builder::new().name(NAME.to_owned()).spawn(work);
        let thread = thread.map_err(|source| FusionError::Thread { name: NAME, source })?;
        Ok(Self { sets: Some(sets), verdicts: Some(verdicts), held, stopped, thread: Some(thread) })
    }

    /// Hands a key set over. Returns whether there was room for it.
    pub fn add(&self, set: KeySet) -> bool {
        self.sets.as_ref().is_some_and(|sets| !matches!(sets.try_send(set), Err(TrySendError::Full(_))))
    }

    /// Lets the thread wait, or go on.
    pub fn hold(&self, hold: bool) {
        self.held.store(hold, Ordering::Relaxed);
    }

    /// Returns the next result; a text for a thread that has failed.
    pub fn verdict(&self) -> Option<Result<Verdict, String>> {
        self.verdicts.as_ref()?.try_recv().ok()
    }
}

impl Drop for LearnerThread {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        // A thread that waits at a full queue ends as well.
        (self.sets, self.verdicts) = (None, None);
        if let Some(thread) = self.thread.take() {
            // Its panics are caught inside.
            drop(thread.join());
        }
    }
}

/// Works until the queue is closed.
fn work(
    beginning: Beginning,
    waiting: &Receiver<KeySet>,
    found: &SyncSender<Result<Verdict, String>>,
    is_held: &AtomicBool,
) -> Result<(), FusionError> {
    let cores = std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64);
    let threads = (SHARE * cores).floor().max(1.0);
    let on_processor = beginning.gpu.is_on_processor() || beginning.gpu.is_software();
    let share = if on_processor { (SHARE * cores / threads).min(1.0) } else { ADAPTER_SHARE };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads as usize).thread_name(|_| NAME.to_owned()).build();
    let pool = pool.map_err(|error| FusionError::ThreadFailed { name: NAME.to_owned(), panic: error.to_string() })?;
    let mut workshop = pool.install(|| Workshop::new(beginning))?;
    // End of the pause after the last piece of work; a key set that comes meanwhile does not extend it.
    let mut rested = Instant::now();
    loop {
        let is_idle = !workshop.is_busy() || is_held.load(Ordering::Relaxed);
        let pause = rested.saturating_duration_since(Instant::now());
        match waiting.recv_timeout(if is_idle { IDLE } else { pause }) {
            Ok(set) => {
                workshop.add(set);
                continue;
            }
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
            Err(RecvTimeoutError::Timeout) if is_idle => continue,
            Err(RecvTimeoutError::Timeout) => {}
        }
        let start = Instant::now();
        if let Some(verdict) = pool.install(|| workshop.work())? {
            // The fit and the comparison have ended.
            release_free_memory();
            if found.send(Ok(verdict)).is_err() {
                return Ok(());
            }
        }
        rested = deadline_after(saturating_secs(start.elapsed().as_secs_f64() * (1.0 / share - 1.0)));
    }
}
