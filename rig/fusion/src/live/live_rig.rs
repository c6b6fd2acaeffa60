//! A live rig: cameras, session and publisher, step by step, going on after faults.

use std::{
    collections::{BTreeMap, VecDeque},
    time::{Duration, Instant},
};

use flyrig_calib::WatchState;
use flyrig_types::{FrameSet, PersonId, Restarts, ThreadHealth, ThreadWatch, caught};

use crate::{
    Correction, FusionError, Health, Intake, LivePublisher, LiveViews, Outcome, PersonMemory, RigWatch, Session,
    WatchEvent,
    age::{AGE, Ages},
    check_threads,
    perceiver::Perceived,
    resident_mib,
};

/// Name of the thread that calls [`LiveRig::step`], in health and errors.
const PIPELINE: &str = "pipeline";
/// Name of the thread that observes the next set.
const PERCEPTION: &str = "perception";

/// How often what was learnt about the people is read back, to survive the loss of the graphics device.
const SNAPSHOT_EVERY: Duration = Duration::from_secs(10);
/// More device faults within [`FAULT_WINDOW`] end the rig: rebuilding does not help.
const MOST_FAULTS: usize = 5;
const FAULT_WINDOW: Duration = Duration::from_secs(60);
/// Pauses between attempts to open the device again, doubling from the first; after as many attempts the rig ends.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const ATTEMPTS: u32 = 5;

/// A set that was taken in.
#[derive(Debug)]
pub struct LiveStep {
    /// The set.
    pub set: FrameSet,
    /// Its result.
    pub outcome: Outcome,
    /// A camera that was found moved, or back in its place.
    pub watched: Option<WatchEvent>,
}

/// Result of a call that may fail or panic; the text is the panic's.
type Attempt<T> = Result<Result<T, FusionError>, String>;

/// Cameras in, people out, for as long as the cameras give frames.
pub struct LiveRig {
    /// The people.
    pub session: Session,
    /// The cameras.
    pub intake: Intake,
    /// The next set, observed while the one before it was reconstructed.
    ahead: Option<(FrameSet, Attempt<Perceived>)>,
    publisher: Option<LivePublisher>,
    views: LiveViews,
    splats: bool,
    ages: Option<Ages>,
    watch: Option<RigWatch>,
    started: Instant,
    frames: u64,
    held: u64,
    recovery: Recovery,
    /// Threads of others that are checked in every step.
    watched: Vec<ThreadWatch>,
    pipeline: ThreadHealth,
    restarts: Restarts,
}

/// State that survives the loss of the device.
#[derive(Debug, Default)]
struct Recovery {
    memories: BTreeMap<PersonId, PersonMemory>,
    taken: Option<Instant>,
    /// Times of the last faults.
    faults: VecDeque<Instant>,
    rebuilt: u64,
}

impl LiveRig {
    /// Joins cameras, session and views; nothing is published without a publisher.
    #[must_use]
    pub fn new(session: Session, intake: Intake, views: LiveViews, publisher: Option<LivePublisher>) -> Self {
        if let Some(publisher) = &publisher {
            publisher.publisher().set_max_view_pixels(session.max_view_pixels());
        }
        let (frames, held, recovery, watched, restarts) = Default::default();
        Self {
            session,
            intake,
            ahead: None,
            publisher,
            views,
            splats: true,
            ages: None,
            watch: None,
            started: Instant::now(),
            frames,
            held,
            recovery,
            watched,
            pipeline: ThreadHealth { name: PIPELINE.to_owned(), ..ThreadHealth::default() },
            restarts,
        }
    }

    /// Adds threads of the cameras' side to those whose restarts are reported and whose failure ends the rig.
    #[must_use]
    pub fn with_threads(self, watched: Vec<ThreadWatch>) -> Self {
        Self { watched, ..self }
    }

    /// Chooses whether the Gaussians are published as well.
    #[must_use]
    pub fn with_splats(self, splats: bool) -> Self {
        Self { splats, ..self }
    }

    /// Measures how old sets are when they have been published, as a stage: for cameras that go on meanwhile.
    #[must_use]
    pub fn with_ages(self) -> Self {
        Self { ages: Some(Ages::new()), ..self }
    }

    /// Watches whether the cameras stay where they are.
    #[must_use]
    pub fn with_watch(self, watch: RigWatch) -> Self {
        Self { watch: Some(watch), ..self }
    }

    /// Waits for a set, takes it in and publishes the views that are watched. Returns `None` when no set came in time. The
    /// rig's own views turn with `turn_time`, or with the time since the start.
    ///
    /// Where another set waits already, its people are observed in a thread of its own meanwhile, so that a step takes as
    /// long as the longer of the two. Results do not depend on it: perception never waits for a reconstruction.
    ///
    /// A graphics device that is lost, out of memory or rejects a command is opened again, and the people are resumed from
    /// the last snapshot. After a panic everything is built again in the same way, as often as [`Restarts`] lets it at once.
    ///
    /// # Errors
    /// Faults from which the rig cannot recover: it must end. [`FusionError::ThreadFailed`] for a thread that panicked too
    /// often.
    pub fn step(&mut self, timeout: Duration, turn_time: Option<Duration>) -> Result<Option<LiveStep>, FusionError> {
        check_threads(self.other_threads())?;
        let (set, perceived, start) = match self.ahead.take() {
            Some((set, perceived)) => {
                self.session.budget.next_set();
                (set, perceived, Instant::now())
            }
            None => {
                let set = match caught(|| self.intake.next_set(timeout)) {
                    Ok(Some(set)) => set,
                    Ok(None) => return Ok(None),
                    Err(panic) => return self.restart(panic).map(|()| None),
                };
                self.ages.iter_mut().for_each(|ages| ages.arrived(set.master_nanos));
                let start = Instant::now();
                self.session.budget.next_set();
                let perceived = caught(|| self.session.perceive(&set));
                (set, perceived, start)
            }
        };
        self.frames += 1;
        let outcome = match perceived {
            Ok(Ok(perceived)) => self.take_in_and_look_ahead(&set, perceived, turn_time),
            Ok(Err(error)) => Ok(Err(error)),
            Err(panic) => Err(panic),
        };
        self.session.budget.spend(start.elapsed());
        let (outcome, watched) = match outcome {
            Ok(Ok(outcome)) => (outcome, self.watch.as_mut().and_then(|watch| watch.look(&set))),
            Ok(Err(fault)) if fault.is_device_fault() => {
                self.recover(fault)?;
                (Outcome::Held("the graphics device was opened again".to_owned()), None)
            }
            Ok(Err(error)) => return Err(error),
            Err(panic) => {
                let reason = format!("the pipeline was restarted after a panic: {panic}");
                self.restart(panic)?;
                (Outcome::Held(reason), None)
            }
        };
        if let Some(event) = &watched {
            tracing::warn!("{event}");
            if let Some(Correction { slot, camera, plate }) = &event.corrected {
                self.session.move_camera(*slot, camera, plate.as_ref())?;
                if let Some(publisher) = &self.publisher {
                    publisher.publisher().set_calibration(self.session.rig())?;
                }
            }
        }
        Ok(Some(LiveStep { set, outcome, watched }))
    }

    /// Takes in a set; where the next one waits already, its people are observed meanwhile.
    fn take_in_and_look_ahead(
        &mut self,
        set: &FrameSet,
        perceived: Perceived,
        turn_time: Option<Duration>,
    ) -> Attempt<Outcome> {
        let next = caught(|| self.intake.next_set(Duration::ZERO))?;
        let Some(next) = next else { return caught(|| self.take_in(set, perceived, turn_time)) };
        self.ages.iter_mut().for_each(|ages| ages.arrived(next.master_nanos));
        if self.session.may_rest(&next) {
            let outcome = caught(|| self.take_in(set, perceived, turn_time));
            self.ahead = Some((next, Ok(Ok(Perceived::Still))));
            return outcome;
        }
        let mut perceiver = self.session.lend_perceiver();
        let (outcome, observed) = std::thread::scope(|scope| {
            let look = || caught(|| perceiver.perceive(&next));
            let thread = std::thread::Builder::new().name(PERCEPTION.to_owned()).spawn_scoped(scope, look);
            let outcome = caught(|| self.take_in(set, perceived, turn_time));
            let joined = thread.map(|thread| thread.join().unwrap_or_else(|_| Err("perception panicked".to_owned())));
            (outcome, joined)
        });
        // Without another thread the set is observed in this one.
        let observed = observed.unwrap_or_else(|_| caught(|| perceiver.perceive(&next)));
        self.session.return_perceiver(perceiver);
        self.ahead = Some((next, observed));
        outcome
    }

    fn take_in(
        &mut self,
        set: &FrameSet,
        perceived: Perceived,
        turn_time: Option<Duration>,
    ) -> Result<Outcome, FusionError> {
        let outcome = self.session.reconstruct(set, perceived)?;
        if let Outcome::Held(reason) = &outcome {
            self.held += 1;
            // The 1st, 2nd, 4th ...: a room that is empty all night must not fill the disk.
            if self.held.is_power_of_two() {
                tracing::warn!(set = set.index, held = self.held, %reason, "frame set not used");
            }
        }
        if let Some(publisher) = &mut self.publisher {
            let turn_time = turn_time.unwrap_or_else(|| self.started.elapsed());
            self.views.publish(&mut self.session, publisher, set, turn_time)?;
            if self.splats && publisher.publisher().has_splat_subscribers() {
                publisher.publish_splats(&self.session, set)?;
            }
            if publisher.publisher().has_person_subscribers() {
                publisher.publish_people(&self.session, set)?;
            }
            if let Some(age) = self.ages.as_ref().and_then(|ages| ages.of(set.master_nanos)) {
                self.session.stages.add(AGE, age);
            }
            let clock_offset_nanos = self.ages.as_ref().and_then(Ages::clock_offset_nanos);
            let drops = self.intake.drops();
            publisher.publish_stats(&self.session, set, self.frames, clock_offset_nanos, &drops);
        }
        if self.recovery.taken.is_none_or(|at| at.elapsed() >= SNAPSHOT_EVERY) && self.session.has_people() {
            self.snapshot()?;
        }
        Ok(outcome)
    }

    /// Whether the cameras have ended and every set was taken in.
    #[must_use]
    pub fn ended(&self) -> bool {
        self.ahead.is_none() && self.intake.ended()
    }

    /// Reads back what was learnt about everybody.
    ///
    /// # Errors
    /// [`FusionError::Gpu`].
    pub fn snapshot(&mut self) -> Result<&BTreeMap<PersonId, PersonMemory>, FusionError> {
        for subject in self.session.subjects().iter().filter(|subject| subject.pose().is_some()) {
            self.recovery.memories.insert(subject.id(), self.session.memory(subject.id())?);
        }
        self.recovery.taken = Some(Instant::now());
        Ok(&self.recovery.memories)
    }

    /// Opens the graphics device again and resumes the people.
    fn recover(&mut self, fault: FusionError) -> Result<(), FusionError> {
        let now = Instant::now();
        let faults = &mut self.recovery.faults;
        faults.push_back(now);
        faults.retain(|at| now.duration_since(*at) < FAULT_WINDOW);
        if faults.len() > MOST_FAULTS {
            tracing::error!("{} faults of the graphics device within a minute; giving up", faults.len());
            return Err(fault);
        }
        tracing::error!("{fault}; opening the graphics device again");
        let mut pause = FIRST_PAUSE;
        for attempt in 1..=ATTEMPTS {
            let gpu = self.session.gpu().reopen();
            let rebuilt =
                gpu.map_err(FusionError::from).and_then(|gpu| self.session.rebuild(&gpu, &self.recovery.memories));
            match rebuilt {
                Ok(()) => {
                    self.recovery.rebuilt += 1;
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

    /// Builds the session anew after a panic: what it left behind may be anything.
    fn restart(&mut self, panic: String) -> Result<(), FusionError> {
        tracing::error!("the pipeline panicked: {panic}");
        let failed = |panic: String| FusionError::ThreadFailed { name: PIPELINE.to_owned(), panic };
        let due = self.restarts.after_failure(Instant::now());
        self.pipeline.panic = Some(panic.clone());
        self.pipeline.has_failed = self.restarts.are_exhausted();
        if self.pipeline.has_failed {
            return Err(failed(panic));
        }
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let rebuilt = caught(|| {
            let gpu = self.session.gpu().reopen()?;
            self.session.rebuild(&gpu, &self.recovery.memories)
        });
        rebuilt.map_err(failed)??;
        self.pipeline.restarts += 1;
        Ok(())
    }

    /// Returns the health of all threads but the one that calls [`Self::step`].
    fn other_threads(&self) -> impl Iterator<Item = ThreadHealth> {
        let publishing = self.publisher.iter().flat_map(LivePublisher::threads);
        publishing.chain(self.watched.iter().map(ThreadWatch::health))
    }

    /// The publisher, where there is one.
    #[must_use]
    pub fn publisher(&self) -> Option<&LivePublisher> {
        self.publisher.as_ref()
    }

    /// Sets that were taken in.
    #[must_use]
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// How often the graphics device was opened again.
    #[must_use]
    pub fn rebuilt(&self) -> u64 {
        self.recovery.rebuilt
    }

    /// Reports the health of cameras, sets, stages and memory.
    #[must_use]
    pub fn health(&self) -> Health {
        let mut health = self.intake.health();
        for (slot, camera) in health.cameras.iter_mut().enumerate() {
            camera.watch = self.watch.as_ref().map_or(WatchState::Unknown, |watch| watch.state(slot));
        }
        Health {
            stages: self.session.stages.summary(),
            resident_mib: resident_mib(),
            device_faults: self.recovery.rebuilt,
            budget: self.session.budget.stats(),
            threads: std::iter::once(self.pipeline.clone()).chain(self.other_threads()).collect(),
            ..health
        }
    }

    /// Counts everything that was lost, by place.
    #[must_use]
    pub fn drops(&self) -> Vec<(String, u64)> {
        let mut drops = self.intake.drops();
        drops.extend(self.publisher.iter().flat_map(LivePublisher::drops));
        drops
    }

    /// Stops the cameras, sends what waits and ends the transport session; returns the session.
    ///
    /// # Errors
    /// [`FusionError::Transport`].
    pub fn finish(self) -> Result<Session, FusionError> {
        drop(self.intake);
        if let Some(publisher) = self.publisher {
            publisher.finish()?;
        }
        Ok(self.session)
    }
}
