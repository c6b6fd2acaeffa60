//! Learning of a session's first person.

use std::sync::Arc;

use flyrig_fit::TrainingView;
use flyrig_gpu::GpuContext;
use flyrig_transport::LearningStats;
use flyrig_types::{Camera, ColorMatch, PersonId, Pose, Rig};

use super::{
    key_sets::{KeySet, KeySetChooser, KeyView},
    thread::LearnerThread,
    workshop::{Beginning, Change, Verdict, Workshop},
};
use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    settings::session::SessionSettings,
    subject::{
        inputs::InputView,
        person::Subject,
        track_watch::{TrackState, TrackWatch},
    },
};

/// Least tracking quality of a key set.
const GOOD_QUALITY: f64 = 0.6;
/// Coverage by other people from which an image is no key view.
const OTHERS_COVER: u8 = 8;
/// Steps of fitting per frame set where the learner works in place.
const STEPS_PER_SET: u32 = 4;
/// Frame sets over which a new version replaces the one before.
const BLENDED_SETS: u32 = 10;
/// Names of counts.
const KEY_SETS_COUNT: &str = "key sets to learn from";
const ROUNDS_COUNT: &str = "rounds of learning";
const VERSIONS_COUNT: &str = "versions of the person adopted";
const DROPPED_COUNT: &str = "versions of the person dropped";

/// Learner of one person.
#[derive(Debug)]
pub(crate) struct PersonLearner {
    /// Whether the work is done in a thread beside the session.
    beside: bool,
    /// Steps of fitting per frame set, where it is done in place.
    pub steps_per_set: u32,
    /// Person and number of the shape that are learnt.
    of: Option<(PersonId, u32)>,
    chooser: KeySetChooser,
    place: Place,
    progress: LearningStats,
}

/// Place of the work.
#[derive(Debug)]
enum Place {
    /// Nobody is learnt yet.
    Nowhere,
    /// In the session's thread.
    Here(Box<Workshop>),
    /// In a thread of its own.
    Beside(LearnerThread),
    /// Ended by an error.
    Failed,
}

impl PersonLearner {
    /// Starts without a person.
    pub fn new() -> Self {
        Self {
            beside: false,
            steps_per_set: STEPS_PER_SET,
            of: None,
            chooser: KeySetChooser::default(),
            place: Place::Nowhere,
            progress: LearningStats::default(),
        }
    }

    /// Returns the progress. A person who was saved is version 1.
    pub fn progress(&self, subject: Option<&Subject>) -> LearningStats {
        let is_avatar = subject.is_some_and(|subject| subject.avatar().is_some());
        let version = if is_avatar { self.progress.version.max(1) } else { 0 };
        LearningStats { version, key_sets: self.chooser.count() as u32, ..self.progress }
    }

    /// Learns in a thread of its own from now on. Which frame set shows a new version first then depends on the machine.
    pub fn use_threads(&mut self) {
        self.beside = true;
    }

    /// Forgets the person: another one may come.
    pub fn forget(&mut self) {
        (self.progress.version, self.progress.gain) = (0, None);
        self.begin_again();
    }

    /// Begins again with the person as it is: the device was lost.
    pub fn begin_again(&mut self) {
        (self.of, self.place) = (None, Place::Nowhere);
        self.chooser.clear();
    }

    /// Lets a thread wait, so that the session gets all processors, or go on.
    pub fn hold(&self, hold: bool) {
        if let Place::Beside(thread) = &self.place {
            thread.hold(hold);
        }
    }

    /// Keeps an updated person's frame set if it shows something new and was tracked well.
    pub fn see(
        &mut self,
        subject: &Subject,
        (nanos, pose, views): (i64, &Pose, &[InputView<'_>]),
        gpu: &GpuContext,
        (rig, settings): (&Rig, &SessionSettings),
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        let of = (subject.id(), subject.shape_number);
        if self.of.is_some_and(|known| known != of) {
            self.forget();
        }
        if matches!(self.place, Place::Failed) || !is_tracked_well(subject.watch()) || subject.is_new() {
            return Ok(());
        }
        let hidden = |view: &InputView<'_>| {
            view.others.is_some_and(|others| others.coverage().iter().any(|cover| *cover >= OTHERS_COVER))
        };
        if views.is_empty() || views.iter().any(hidden) {
            return Ok(());
        }
        let Some(base) = subject.base().cloned() else { return Ok(()) };
        let Some(choice) = self.chooser.choose(&subject.template().skeleton, pose, nanos) else { return Ok(()) };
        let views: Vec<KeyView> = views.iter().enumerate().filter_map(|(i, view)| key_view(i, view, subject)).collect();
        if matches!(self.place, Place::Nowhere) {
            let beginning = Beginning {
                gpu: gpu.clone(),
                rig: rig.clone(),
                settings: settings.clone(),
                template: subject.template().clone(),
                undressed: subject.undressed().cloned(),
                base,
                in_use: subject.avatar().cloned(),
                stopped: Arc::default(),
            };
            self.place = if self.beside {
                Place::Beside(LearnerThread::start(beginning)?)
            } else {
                Place::Here(Box::new(Workshop::new(beginning)?))
            };
            self.of = Some(of);
        }
        let set = KeySet { choice, pose: pose.clone(), translations: subject.node_translations().to_vec(), views };
        let added = match &mut self.place {
            Place::Here(workshop) => {
                workshop.add(set);
                true
            }
            Place::Beside(thread) => thread.add(set),
            Place::Nowhere | Place::Failed => false,
        };
        if !added {
            self.chooser.missed(choice);
        }
        stages.count(KEY_SETS_COUNT, u64::from(added));
        Ok(())
    }

    /// Works in place, or collects what a thread has found, and applies it to the person.
    pub fn advance(
        &mut self,
        subject: &mut Subject,
        gpu: &GpuContext,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        let (mut verdicts, mut problem) = (Vec::new(), None);
        match &mut self.place {
            Place::Here(workshop) => {
                for _ in 0..self.steps_per_set {
                    if !workshop.is_busy() || problem.is_some() {
                        break;
                    }
                    match stages.time("learning", || workshop.work()) {
                        Ok(verdict) => verdicts.extend(verdict),
                        Err(error) if error.is_device_fault() => return Err(error),
                        Err(error) => problem = Some(error.to_string()),
                    }
                }
            }
            Place::Beside(thread) => {
                while let Some(verdict) = thread.verdict() {
                    match verdict {
                        Ok(verdict) => verdicts.push(verdict),
                        Err(text) => problem = Some(text),
                    }
                }
            }
            Place::Nowhere | Place::Failed => {}
        }
        if let Some(problem) = problem {
            tracing::warn!("the person is not learnt any more: {problem}");
            self.place = Place::Failed;
        }
        if self.of != Some((subject.id(), subject.shape_number)) {
            return Ok(());
        }
        for verdict in verdicts {
            self.apply(verdict, subject, gpu, stages)?;
            if self.of.is_none() {
                // Later ones are of the version that was dropped.
                break;
            }
        }
        Ok(())
    }

    fn apply(
        &mut self,
        verdict: Verdict,
        subject: &mut Subject,
        gpu: &GpuContext,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        let Verdict { change, round, fitted, errors: [before, after], took } = verdict;
        stages.count(ROUNDS_COUNT, 1);
        self.progress.rounds += 1;
        self.progress.seconds += took.as_secs_f64();
        let person = subject.id();
        match change {
            Change::Keep => tracing::info!(%person, round, fitted, before, after, "the learnt person is no better"),
            Change::Prove => tracing::info!(%person, round, fitted, before, after, "the person can be learnt"),
            Change::Adopt { avatar, stream } => {
                tracing::info!(%person, round, fitted, before, after, "the learnt person is adopted");
                stages.count(VERSIONS_COUNT, 1);
                self.progress.version = self.progress(Some(subject)).version + 1;
                self.progress.gain = Some(1.0 - after / before).filter(|gain| gain.is_finite());
                stages.time("adoption", || subject.become_avatar(gpu, &avatar, BLENDED_SETS))?;
                subject.set_stream(&stream);
            }
            Change::Drop => {
                tracing::warn!(%person, round, before, after, "the person looks otherwise than was learnt, and is learnt anew");
                stages.count(DROPPED_COUNT, 1);
                subject.return_to_surface(gpu)?;
                subject.prepare_stream()?;
                self.forget();
            }
        }
        Ok(())
    }
}

fn is_tracked_well(watch: &TrackWatch) -> bool {
    watch.state() == TrackState::Steady && watch.quality().is_some_and(|quality| quality >= GOOD_QUALITY)
}

/// Crops the image of a view to the person.
fn key_view(i: usize, view: &InputView<'_>, subject: &Subject) -> Option<KeyView> {
    // Its colours are corrected already.
    let camera = Camera { color: ColorMatch::NONE, ..view.camera.clone() };
    let crop = TrainingView::cut(0, &camera, subject.input(i))?;
    Some(KeyView { crop, pose: view.pose.cloned() })
}
