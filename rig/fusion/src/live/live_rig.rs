//! Live rig: cameras, session and publisher, one step at a time.
//!
//! Where the next frame set waits already, a thread named "perception" observes its people while the reconstruction and publishing of the
//! frame set before run. Recovery from faults is in [`super::recovery`].

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use flyrig_calib::WatchState;
use flyrig_types::{FrameSet, PersonId, ThreadHealth, ThreadWatch, caught};

use super::{
    ages::{AGE, Ages},
    recovery::Recovery,
    rig_watch::{Correction, RigWatch, WatchEvent},
};
use crate::{
    error::FusionError,
    health::{
        process::resident_mib,
        snapshot::{Health, check_threads},
    },
    intake::cameras::Intake,
    publish::{live_publisher::LivePublisher, live_views::LiveViews},
    session::{Session, outcome::Outcome, perceiver::Perceived},
    subject::memory::PersonMemory,
};

/// Name of the thread that observes the next frame set.
const PERCEPTION: &str = "perception";

/// Frame set that was processed.
#[derive(Debug)]
pub struct LiveStep {
    /// Frame set.
    pub set: FrameSet,
    /// Result of the frame set.
    pub outcome: Outcome,
    /// Event of a camera that was moved, or put back.
    pub watched: Option<WatchEvent>,
}

/// Result of a call that may fail or panic; the text is the panic's.
type Attempt<T> = Result<Result<T, FusionError>, String>;

/// Cameras in, people out, for as long as the cameras deliver frames.
///
/// # Example
/// ```no_run
/// use std::time::Duration;
/// use flyrig_fusion::{Intake, LiveRig, LiveViews, OutputSettings, Session};
///
/// # fn follow(session: Session, intake: Intake) -> Result<(), flyrig_fusion::FusionError> {
/// let mut rig = LiveRig::new(session, intake, LiveViews::new(&OutputSettings::default()), None);
/// while !rig.ended() {
///     if let Some(step) = rig.step(Duration::from_millis(200), None)? {
///         println!("frame set {}: {:?}", step.set.index, step.outcome);
///     }
/// }
/// # Ok(())
/// # }
/// ```
pub struct LiveRig {
    /// People.
    pub session: Session,
    /// Cameras.
    pub intake: Intake,
    /// Next frame set, observed while the one before it was reconstructed.
    ahead: Option<(FrameSet, Attempt<Perceived>)>,
    publisher: Option<LivePublisher>,
    views: LiveViews,
    splats: bool,
    ages: Option<Ages>,
    watch: Option<RigWatch>,
    started: Instant,
    /// Frame sets that were processed.
    frames: u64,
    /// Frame sets in which no person was updated.
    held: u64,
    recovery: Recovery,
    /// Threads of other crates that are checked in every step.
    watched: Vec<ThreadWatch>,
}

impl LiveRig {
    /// Joins cameras, session and views; nothing is published without a publisher.
    #[must_use]
    pub fn new(session: Session, intake: Intake, views: LiveViews, publisher: Option<LivePublisher>) -> Self {
        if let Some(publisher) = &publisher {
            publisher.publisher().set_max_view_pixels(session.max_view_pixels());
        }
        let (frames, held, watched) = Default::default();
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
            recovery: Recovery::new(),
            watched,
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

    /// Measures the age of frame sets when they have been published, as a stage. For cameras that deliver in real time.
    #[must_use]
    pub fn with_ages(self) -> Self {
        Self { ages: Some(Ages::new()), ..self }
    }

    /// Watches whether the cameras stay where they are.
    #[must_use]
    pub fn with_watch(self, watch: RigWatch) -> Self {
        Self { watch: Some(watch), ..self }
    }

    /// Waits for a frame set, processes it and publishes the views that are watched. Returns `None` when no frame set came in time. The
    /// rig's own views turn with `turn_time`, or with the time since the start.
    ///
    /// Where another frame set waits already, its people are observed in a thread of its own meanwhile, so that a step takes as long as the
    /// longer of the two. Results do not depend on it, since perception never reads a reconstruction.
    ///
    /// A graphics device that is lost, out of memory or rejects a command is opened again, and the people are resumed from
    /// the last snapshot. After a panic everything is built again in the same way, as often as [`flyrig_types::Restarts`] allows.
    ///
    /// # Errors
    /// Faults from which the rig cannot recover, so that it must end. [`FusionError::ThreadFailed`] for a thread that panicked too
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
                    Err(panic) => return self.recovery.restart(&mut self.session, panic).map(|()| None),
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
            Ok(Ok(perceived)) => self.ingest_and_look_ahead(&set, perceived, turn_time),
            Ok(Err(error)) => Ok(Err(error)),
            Err(panic) => Err(panic),
        };
        self.session.budget.spend(start.elapsed());
        let (outcome, watched) = match outcome {
            Ok(Ok(outcome)) => (outcome, self.watch.as_mut().and_then(|watch| watch.check(&set))),
            Ok(Err(fault)) if fault.is_device_fault() => {
                self.recovery.reopen_device(&mut self.session, fault)?;
                (Outcome::Held("the graphics device was opened again".to_owned()), None)
            }
            Ok(Err(error)) => return Err(error),
            Err(panic) => {
                let reason = format!("the pipeline was restarted after a panic: {panic}");
                self.recovery.restart(&mut self.session, panic)?;
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

    /// Ingests a frame set. Where the next one waits already, its people are observed meanwhile.
    fn ingest_and_look_ahead(
        &mut self,
        set: &FrameSet,
        perceived: Perceived,
        turn_time: Option<Duration>,
    ) -> Attempt<Outcome> {
        let next = caught(|| self.intake.next_set(Duration::ZERO))?;
        let Some(next) = next else { return caught(|| self.ingest(set, perceived, turn_time)) };
        self.ages.iter_mut().for_each(|ages| ages.arrived(next.master_nanos));
        if self.session.can_skip(&next) {
            let outcome = caught(|| self.ingest(set, perceived, turn_time));
            self.ahead = Some((next, Ok(Ok(Perceived::Still))));
            return outcome;
        }
        let mut perceiver = self.session.lend_perceiver();
        let (outcome, observed) = std::thread::scope(|scope| {
            let look = || caught(|| perceiver.perceive(&next));
            let thread = std::thread::Builder::new().name(PERCEPTION.to_owned()).spawn_scoped(scope, look);
            let outcome = caught(|| self.ingest(set, perceived, turn_time));
            let joined = thread.map(|thread| thread.join().unwrap_or_else(|_| Err("perception panicked".to_owned())));
            (outcome, joined)
        });
        // Without another thread, the frame set is observed in this one.
        let observed = observed.unwrap_or_else(|_| caught(|| perceiver.perceive(&next)));
        self.session.return_perceiver(perceiver);
        self.ahead = Some((next, observed));
        outcome
    }

    /// Reconstructs and publishes a frame set.
    fn ingest(
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
        self.publish(set, turn_time)?;
        if self.recovery.is_snapshot_due() && self.session.has_people() {
            self.snapshot()?;
        }
        Ok(outcome)
    }

    /// Publishes views, Gaussians, people and statistics, each where a viewer subscribes to it.
    fn publish(&mut self, set: &FrameSet, turn_time: Option<Duration>) -> Result<(), FusionError> {
        let Some(publisher) = &mut self.publisher else { return Ok(()) };
        let turn_time = turn_time.unwrap_or_else(|| self.started.elapsed());
        self.views.publish(&mut self.session, publisher, set, turn_time)?;
        if self.splats && publisher.publisher().has_splat_subscribers() {
            publisher.publish_splats(&self.session, set)?;
        }
        if publisher.wants_people() {
            publisher.publish_people(&self.session, set)?;
        }
        if let Some(age) = self.ages.as_ref().and_then(|ages| ages.of(set.master_nanos)) {
            self.session.stages.add(AGE, age);
        }
        let clock_offset_nanos = self.ages.as_ref().and_then(Ages::clock_offset_nanos);
        let drops = self.intake.drops();
        publisher.publish_stats(&self.session, set, self.frames, clock_offset_nanos, &drops);
        Ok(())
    }

    /// Returns whether the cameras have ended and every frame set was processed.
    #[must_use]
    pub fn ended(&self) -> bool {
        self.ahead.is_none() && self.intake.ended()
    }

    /// Reads back the memories of all people.
    ///
    /// # Errors
    /// [`FusionError::Gpu`].
    pub fn snapshot(&mut self) -> Result<&BTreeMap<PersonId, PersonMemory>, FusionError> {
        self.recovery.snapshot(&self.session)
    }

    /// Returns the health of all threads but the one that calls [`Self::step`].
    fn other_threads(&self) -> impl Iterator<Item = ThreadHealth> {
        let publishing = self.publisher.iter().flat_map(LivePublisher::threads);
        publishing.chain(self.watched.iter().map(ThreadWatch::health))
    }

    /// Returns the publisher, where there is one.
    #[must_use]
    pub fn publisher(&self) -> Option<&LivePublisher> {
        self.publisher.as_ref()
    }

    /// Returns the number of frame sets that were processed.
    #[must_use]
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Returns how often the graphics device was opened again.
    #[must_use]
    pub fn rebuilt(&self) -> u64 {
        self.recovery.rebuilt()
    }

    /// Reports the health of cameras, threads, frame sets, stages and memory.
    #[must_use]
    pub fn health(&self) -> Health {
        let mut health = self.intake.health();
        for (slot, camera) in health.cameras.iter_mut().enumerate() {
            camera.watch = self.watch.as_ref().map_or(WatchState::Unknown, |watch| watch.state(slot));
        }
        Health {
            stages: self.session.stages.summary(),
            resident_mib: resident_mib(),
            device_faults: self.recovery.rebuilt(),
            budget: self.session.budget.stats(),
            learning: self.session.learning(),
            threads: std::iter::once(self.recovery.pipeline().clone()).chain(self.other_threads()).collect(),
            ..health
        }
    }

    /// Counts frames, frame sets and views that were lost, by place.
    #[must_use]
    pub fn drops(&self) -> Vec<(String, u64)> {
        let mut drops = self.intake.drops();
        drops.extend(self.publisher.iter().flat_map(LivePublisher::drops));
        drops
    }

    /// Stops the cameras, sends what waits, ends the transport session, and returns the session.
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
