//! Recovery of a live rig from the loss of its graphics device and from panics.
//!
//! Every ten seconds the [`PersonMemory`] of each person is read back. A device that is lost, out of memory or rejects a command is opened
//! again, and the session is rebuilt from the last memories; so it is after a panic, as often as [`Restarts`] allows. More than five device
//! faults within a minute, or a sixth panic at once, end the rig.

use std::{
    collections::{BTreeMap, VecDeque},
    time::{Duration, Instant},
};

use flyrig_types::{PersonId, Restarts, ThreadHealth, caught};

use crate::{error::FusionError, session::Session, subject::memory::PersonMemory};

/// Name of the thread that calls [`crate::LiveRig::step`], in health and errors.
const PIPELINE: &str = "pipeline";
/// Time from one snapshot of the people to the next.
const SNAPSHOT_EVERY: Duration = Duration::from_secs(10);
/// Largest number of device faults within [`FAULT_WINDOW`]; after more, rebuilding does not help.
const MOST_FAULTS: usize = 5;
/// Time over which device faults are counted.
const FAULT_WINDOW: Duration = Duration::from_secs(60);
/// Pause before the second attempt to open the device again; it doubles with every attempt.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// Number of attempts to open the device again.
const ATTEMPTS: u32 = 5;

/// State that survives the loss of the device and panics of the pipeline.
#[derive(Debug)]
pub(super) struct Recovery {
    memories: BTreeMap<PersonId, PersonMemory>,
    /// Time of the last snapshot.
    taken: Option<Instant>,
    /// Times of the last device faults.
    faults: VecDeque<Instant>,
    rebuilt: u64,
    pipeline: ThreadHealth,
    restarts: Restarts,
}

impl Recovery {
    pub fn new() -> Self {
        let (memories, taken, faults, rebuilt, restarts) = Default::default();
        let pipeline = ThreadHealth { name: PIPELINE.to_owned(), ..ThreadHealth::default() };
        Self { memories, taken, faults, rebuilt, pipeline, restarts }
    }

    /// Returns how often the graphics device was opened again after a fault.
    pub fn rebuilt(&self) -> u64 {
        self.rebuilt
    }

    /// Returns the health of the thread that runs the pipeline.
    pub fn pipeline(&self) -> &ThreadHealth {
        &self.pipeline
    }

    /// Returns whether it is time for the next snapshot.
    pub fn is_snapshot_due(&self) -> bool {
        self.taken.is_none_or(|at| at.elapsed() >= SNAPSHOT_EVERY)
    }

    /// Reads back the memories of all people who have been posed.
    pub fn snapshot(&mut self, session: &Session) -> Result<&BTreeMap<PersonId, PersonMemory>, FusionError> {
        for subject in session.subjects().iter().filter(|subject| subject.pose().is_some()) {
            self.memories.insert(subject.id(), session.memory(subject.id())?);
        }
        self.taken = Some(Instant::now());
        Ok(&self.memories)
    }

    /// Opens the graphics device again and resumes the people.
    pub fn reopen_device(&mut self, session: &mut Session, fault: FusionError) -> Result<(), FusionError> {
        let now = Instant::now();
        self.faults.push_back(now);
        self.faults.retain(|at| now.duration_since(*at) < FAULT_WINDOW);
        if self.faults.len() > MOST_FAULTS {
            tracing::error!("{} faults of the graphics device within a minute; giving up", self.faults.len());
            return Err(fault);
        }
        tracing::error!("{fault}; opening the graphics device again");
        let mut pause = FIRST_PAUSE;
        for attempt in 1..=ATTEMPTS {
            match self.rebuild(session) {
                Ok(()) => {
                    self.rebuilt += 1;
                    tracing::warn!("the graphics device works again after {:.1} s", now.elapsed().as_secs_f64());
                    return Ok(());
                }
                Err(error) if attempt < ATTEMPTS => {
                    tracing::warn!("{error}; attempt {} of {ATTEMPTS} follows", attempt + 1);
                    std::thread::sleep(pause);
                    pause *= 2;
                }
                Err(error) => return Err(error),
            }
        }
        Err(fault)
    }

    /// Builds the session again after a panic, which may have left it in any state.
    pub fn restart(&mut self, session: &mut Session, panic: String) -> Result<(), FusionError> {
        tracing::error!("the pipeline panicked: {panic}");
        let failed = |panic: String| FusionError::ThreadFailed { name: PIPELINE.to_owned(), panic };
        let due = self.restarts.after_failure(Instant::now());
        self.pipeline.panic = Some(panic.clone());
        self.pipeline.has_failed = self.restarts.are_exhausted();
        if self.pipeline.has_failed {
            return Err(failed(panic));
        }
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        caught(|| self.rebuild(session)).map_err(failed)??;
        self.pipeline.restarts += 1;
        Ok(())
    }

    /// Rebuilds the session on a newly opened device.
    fn rebuild(&self, session: &mut Session) -> Result<(), FusionError> {
        let gpu = session.gpu().reopen()?;
        session.rebuild(&gpu, &self.memories)
    }
}
