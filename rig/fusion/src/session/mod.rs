//! Session: frame sets in, people as Gaussians and views out.
//!
//! [`Session::process`] runs two halves that share no state. Perception ([`perceiver`]) turns a frame set into one observation per
//! person; the reconstruction hands each observation to its [`Subject`]. Perception never reads a reconstruction, so
//! [`crate::LiveRig`] runs the perception of the next frame set beside the reconstruction of this one, with equal results.
//!
//! A person who is not found keeps the last state, and the loss is counted. Perception keeps what it knows of a person (landmarks, texture,
//! clothes, hands); a new shape number makes the session build the person's subject again. Once a session has seen each image size, it
//! creates no GPU object (`tests/steady_state.rs`).
//!
//! [`newcomers`] prepares the subjects of people who arrive: in place, or in threads beside the session. [`view_renderer`] renders all people
//! into one view. With a budget, [`budget`] chooses the level of effort, and [`stillness`] leaves frame sets out while nothing moves.

pub(crate) mod budget;
mod builder;
mod newcomers;
pub(crate) mod outcome;
pub(crate) mod perceiver;
mod stillness;
pub(crate) mod view_renderer;

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use flyrig_gpu::GpuContext;
use flyrig_renderer::{Gaussians, RenderTarget, Splat};
use flyrig_transport::LearningStats;
use flyrig_types::{Camera, Frame, FrameSet, Image, PersonId, Pose, RenderedView, Rig, caught};

use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    learner::person_learner::PersonLearner,
    perception::observation::{Perception, PersonObservation, SeenPerson, ViewObservation},
    settings::{effort::Effort, session::SessionSettings},
    subject::{
        inputs::InputView,
        memory::PersonMemory,
        person::{Observed, Subject},
        stream_frame::PersonFrame,
        track_watch::Remedy,
    },
};

pub use budget::Budget;
pub use builder::SessionBuilder;
pub use outcome::{Counts, Outcome};

use newcomers::Newcomers;
use perceiver::{Newcomer, Perceived, Perceiver};
use stillness::Stillness;
use view_renderer::ViewRenderer;

/// Live reconstruction of any number of people from one rig.
///
/// Built by [`SessionBuilder`]. `flyrig run`, `eval`, `demo`, `train` and `flyrig-bench` all use it.
pub struct Session {
    gpu: GpuContext,
    rig: Rig,
    settings: SessionSettings,
    perceiver: Perceiver,
    subjects: Vec<Subject>,
    view_renderer: ViewRenderer,
    /// Memories of people who are not subjects yet.
    saved: BTreeMap<PersonId, PersonMemory>,
    newcomers: Newcomers,
    /// Learner of the first person, with `body.learn`.
    learner: Option<PersonLearner>,
    /// Time since which a person is seen who cannot be shown yet.
    measuring_since: Option<Instant>,
    keep_observations: bool,
    shape_held: bool,
    stillness: Stillness,
    /// Budget of time. Programs that draw views of a frame set add their time ([`Budget::spend`]).
    pub budget: Budget,
    /// Run times of all stages so far.
    pub stages: StageTimes,
    /// Counts of updates and faults so far.
    pub counts: Counts,
}

impl Session {
    /// Returns the input cameras.
    #[must_use]
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// Returns the device that everything runs on.
    #[must_use]
    pub fn gpu(&self) -> &GpuContext {
        &self.gpu
    }

    /// Returns the people, in the order in which they were first known.
    #[must_use]
    pub fn subjects(&self) -> &[Subject] {
        &self.subjects
    }

    /// Returns one person; `None` where the session does not know it.
    #[must_use]
    pub fn subject(&self, person: PersonId) -> Option<&Subject> {
        self.subjects.iter().find(|subject| subject.id() == person)
    }

    /// Returns the progress of learning; `None` without `body.learn`.
    #[must_use]
    pub fn learning(&self) -> Option<LearningStats> {
        self.learner.as_ref().map(|learner| learner.progress(self.subjects.first()))
    }

    /// Returns for how long a person has been seen who cannot be shown yet, because the shape is being measured; `None` while there is
    /// no such person.
    #[must_use]
    pub fn measuring(&self) -> Option<Duration> {
        self.measuring_since.map(|since| since.elapsed())
    }

    /// Returns whether any person has been posed yet.
    #[must_use]
    pub fn has_people(&self) -> bool {
        self.subjects.iter().any(|subject| subject.pose().is_some())
    }

    /// Returns how the first person contradicts the rig's up direction ([`crate::Upright::fault`]); `None` where they agree.
    #[must_use]
    pub fn upright_fault(&self) -> Option<String> {
        self.subjects.first().and_then(|subject| subject.upright().fault(self.rig.world_up))
    }

    /// Replaces perception from the next frame set on.
    pub fn set_perception(&mut self, perception: impl Perception + 'static) {
        self.perceiver = Perceiver::new(Box::new(perception));
    }

    /// Keeps the observations of each view from the next frame set on, for [`Self::observed`].
    ///
    /// # Errors
    /// [`FusionError::Gpu`] when the adapter has no room for them.
    pub fn keep_observations(&mut self) -> Result<(), FusionError> {
        self.keep_observations = true;
        self.subjects.iter_mut().try_for_each(|subject| subject.keep_observations(&self.gpu))
    }

    /// Suspends the deformation, or lets it go on. Meanwhile colours keep settling on the surface as it is.
    pub fn hold_shape(&mut self, hold: bool) {
        self.shape_held = hold;
        self.subjects.iter_mut().for_each(|subject| subject.hold_shape(hold));
    }

    /// Chooses whether every image is explained with the pose of its own capture time, or with that of its frame set.
    pub fn set_per_view_time(&mut self, per_view_time: bool) {
        self.settings.tracking.per_view_time = per_view_time;
    }

    /// Processes one frame set. A person who is not found keeps the last state.
    ///
    /// # Errors
    /// Only errors from which later frame sets cannot recover. After one that [is a device fault](FusionError::is_device_fault), call
    /// [`Self::rebuild`].
    pub fn process(&mut self, set: &FrameSet) -> Result<Outcome, FusionError> {
        let start = Instant::now();
        self.budget.next_set();
        let outcome = self.perceive(set).and_then(|perceived| self.reconstruct(set, perceived));
        self.budget.spend(start.elapsed());
        outcome
    }

    /// Observes the people in a frame set, for [`Self::reconstruct`].
    pub(crate) fn perceive(&mut self, set: &FrameSet) -> Result<Perceived, FusionError> {
        if self.can_skip(set) {
            return Ok(Perceived::Still);
        }
        self.ready_perceiver();
        self.perceiver.perceive(set)
    }

    /// Returns whether a frame set can be left out because nothing moves. Needs a budget.
    pub(crate) fn can_skip(&mut self, set: &FrameSet) -> bool {
        self.budget.fps().is_some() && self.stillness.can_skip(set, self.has_people())
    }

    /// Measures the shapes of all people again from the next frame sets on, for a body that does not fit. A person whose shape comes out
    /// differently is learnt anew, colours included. Returns whether shapes are measured at all: not where they are given, nor by a
    /// single camera.
    pub fn measure_again(&mut self) -> bool {
        self.perceiver.measure_again()
    }

    /// Lends perception out, ready for the next frame set. Until it is returned, this session finds no person.
    pub(crate) fn lend_perceiver(&mut self) -> Perceiver {
        self.ready_perceiver();
        std::mem::take(&mut self.perceiver)
    }

    /// Hands effort and known people to perception.
    fn ready_perceiver(&mut self) {
        let known = self.subjects.iter().map(|subject| (subject.id(), subject.shape_number)).collect();
        self.perceiver.ready(self.budget.effort(), known);
    }

    /// Takes perception back.
    pub(crate) fn return_perceiver(&mut self, perceiver: Perceiver) {
        self.perceiver = perceiver;
    }

    /// Updates the people from the result of [`Self::perceive`] for the same frame set. Does not use perception.
    pub(crate) fn reconstruct(&mut self, set: &FrameSet, perceived: Perceived) -> Result<Outcome, FusionError> {
        let start = Instant::now();
        let Perceived::People { observations, newcomers, is_measuring, effort, stages, took } = perceived else {
            self.budget.leave_out();
            self.stages.count("sets left out, nothing moved", 1);
            return Ok(Outcome::Still);
        };
        self.stages.merge(&stages);
        let before = self.gpu.traffic();
        let outcome = self.update_people(set, observations, newcomers, effort);
        let since = self.measuring_since.unwrap_or(start);
        self.measuring_since = (is_measuring || self.newcomers.are_preparing()).then_some(since);
        self.stages.count_traffic(self.gpu.traffic().since(before));
        self.stillness.ingested(set.master_nanos, took + start.elapsed());
        outcome
    }

    fn update_people(
        &mut self,
        set: &FrameSet,
        observations: Vec<PersonObservation>,
        newcomers: Vec<Newcomer>,
        effort: Effort,
    ) -> Result<Outcome, FusionError> {
        self.gpu.check()?;
        self.add_people(newcomers)?;
        let mut outcome = Outcome::Held("no person is known".to_owned());
        for observation in observations {
            match observation {
                PersonObservation::Lost { person, reason } => {
                    self.counts.lost += 1;
                    if let Some(subject) = self.subjects.iter_mut().find(|subject| subject.id() == person) {
                        subject.track.watch.leave(set.master_nanos);
                    }
                    if outcome != Outcome::Updated {
                        outcome = Outcome::Held(reason);
                    }
                }
                PersonObservation::Seen(seen)
                    if self.newcomers.is_preparing(seen.person) && self.subject(seen.person).is_none() =>
                {
                    if outcome != Outcome::Updated {
                        outcome = Outcome::Held(format!("person {} is being prepared", seen.person));
                    }
                }
                PersonObservation::Seen(seen) => {
                    self.update(set, &seen, effort)?;
                    outcome = Outcome::Updated;
                }
            }
        }
        Ok(outcome)
    }

    /// Moves a camera from the next frame set on. `plate` is the empty scene as the camera sees it now, where one is known. A slot that
    /// does not exist changes nothing.
    ///
    /// # Errors
    /// [`FusionError::Track`] for a plate of another size.
    pub fn move_camera(&mut self, slot: usize, camera: &Camera, plate: Option<&Image>) -> Result<(), FusionError> {
        self.perceiver.move_camera(slot, camera, plate)?;
        if let Some(known) = self.rig.cameras.get_mut(slot) {
            known.clone_from(camera);
        }
        Ok(())
    }

    /// Prepares people who arrive in threads of their own from now on, and lets perception measure them there, so that no frame set waits
    /// for them. Results then depend on the speed of the machine.
    pub fn use_threads(&mut self) {
        self.newcomers.use_threads();
        self.perceiver.use_threads();
        self.learner.iter_mut().for_each(PersonLearner::use_threads);
    }

    /// Chooses how many steps of learning follow a frame set where they are not done in a thread.
    pub fn set_learning_steps(&mut self, steps: u32) {
        self.learner.iter_mut().for_each(|learner| learner.steps_per_set = steps);
    }

    /// Creates subjects for people who have none yet, and for those whose shape has changed.
    fn add_people(&mut self, people: Vec<Newcomer>) -> Result<(), FusionError> {
        for newcomer in people {
            let (id, outfit) = (newcomer.person, newcomer.outfit);
            let place = self.subjects.iter().position(|subject| subject.id() == id);
            if place.is_some_and(|place| self.subjects[place].shape_number == newcomer.shape) {
                continue;
            }
            let avatar = self.saved.get(&id).and_then(|memory| memory.avatar.clone());
            let with = (&self.rig, &self.settings);
            let subject = self.newcomers.subject(newcomer, avatar.as_ref(), &self.gpu, with)?;
            let Some(mut subject) = subject else { continue };
            if self.keep_observations {
                subject.keep_observations(&self.gpu)?;
            }
            subject.hold_shape(self.shape_held);
            // Colours and deformation belong to one surface: clothes may be found later.
            if self.saved.get(&id).is_some_and(|memory| memory.outfit() == outfit)
                && let Some(memory) = self.saved.remove(&id)
            {
                subject.restore(&self.gpu, &memory)?;
            }
            match place {
                Some(place) => self.subjects[place] = subject,
                None => self.subjects.push(subject),
            }
        }
        Ok(())
    }

    /// Updates one person from a frame set.
    fn update(&mut self, set: &FrameSet, seen: &SeenPerson, effort: Effort) -> Result<(), FusionError> {
        let is_first = self.subjects.first().is_some_and(|subject| subject.id() == seen.person);
        let Some(subject) = self.subjects.iter_mut().find(|subject| subject.id() == seen.person) else {
            return Err(FusionError::NoSuchPerson(seen.person));
        };
        if let Some(learner) = self.learner.as_mut().filter(|_| is_first) {
            learner.hold(effort != Effort::FULL);
            learner.advance(subject, &self.gpu, &mut self.stages)?;
        }
        let pose = &seen.pose;
        subject.track.curve.push(set.master_nanos, pose);
        subject.check_up(pose, self.rig.world_up);
        let per_view_time = self.settings.tracking.per_view_time;
        let poses = view_poses(set, seen, per_view_time, |nanos| subject.track.curve.at(nanos));
        let (slots, views) = input_views(set, seen, &poses, &self.rig, &mut self.counts);
        if views.is_empty() {
            subject.track.watch.leave(set.master_nanos);
        } else {
            match subject.track.watch.arrive(set.master_nanos, pose) {
                Remedy::Forget => {
                    if let Some(learner) = self.learner.as_mut().filter(|_| is_first) {
                        learner.forget();
                        subject.return_to_start(&self.gpu)?;
                        subject.prepare_stream()?;
                    }
                    subject.forget(&self.gpu)?;
                }
                Remedy::Restart => subject.restart(),
                Remedy::None => {}
            }
        }
        if subject.track.viewed != slots {
            subject.track.viewed = slots;
            subject.views_changed();
        }
        subject.track.confidence = seen.confidence;
        self.view_renderer.people_changed();
        subject.update(&self.gpu, &mut self.view_renderer.rasterizer, pose, &views, effort, &mut self.stages)?;
        if subject.is_new() {
            // Gets all the work at whatever level.
            self.budget.leave_out();
        }
        if !views.is_empty() {
            let ids = views.iter().map(|view| view.camera.id.clone());
            let agreement = ids.zip(subject.agreement()).filter_map(|(id, quality)| Some((id, quality?)));
            subject.track.watch.assess(agreement);
        }
        if let Some(learner) = self.learner.as_mut().filter(|_| is_first) {
            learner.see(
                subject,
                (set.master_nanos, pose, &views),
                &self.gpu,
                (&self.rig, &self.settings),
                &mut self.stages,
            )?;
        }
        self.counts.poisoned += u64::from(subject.deform_report().is_some_and(|report| report.poisoned));
        subject.track.last_pose = Some(seen.pose.clone());
        self.counts.updated += 1;
        Ok(())
    }

    /// Renders all people as `camera` would see them now: sRGB with straight alpha.
    ///
    /// # Errors
    /// [`FusionError::Gpu`]; a view that is too large for the adapter leaves the session as it was.
    pub fn render(&mut self, camera: &Camera) -> Result<RenderedView, FusionError> {
        if !self.view_renderer.is_timed_by_adapter() {
            // Else the time of the updates under way would be that of the view.
            self.gpu.wait()?;
        }
        self.subjects.iter_mut().for_each(|subject| subject.collect_times(&mut self.stages));
        let posed = |subject: &&Subject| subject.pose().is_some();
        let mut people: Vec<Gaussians<'_>> = self.subjects.iter().filter(posed).map(Subject::drawn).collect();
        if people.is_empty() {
            // Before the first pose: as the surfaces were made.
            people = self.subjects.iter().map(Subject::drawn).collect();
        }
        if people.is_empty() {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            return Ok(RenderedView { width, height, rgba: vec![0; 4 * width as usize * height as usize] });
        }
        let before = self.gpu.traffic();
        let view = self.view_renderer.render(&self.gpu, &people, camera, &mut self.stages);
        self.stages.count_traffic(self.gpu.traffic().since(before));
        view
    }

    /// Renders all people as [`Self::render`] does. After a panic the parts that draw are built anew, so that the session is as it was.
    ///
    /// # Errors
    /// Those of [`Self::render`], and [`FusionError::View`] after a panic.
    pub(crate) fn render_or_catch(
        &mut self,
        render: impl FnOnce(&mut Self) -> Result<RenderedView, FusionError>,
    ) -> Result<RenderedView, FusionError> {
        caught(|| render(self)).unwrap_or_else(|panic| {
            self.view_renderer = ViewRenderer::new(&self.gpu, self.settings.body.gaussians)?;
            Err(FusionError::View(panic))
        })
    }

    /// Returns the size of the largest view that the adapter can hold, pixels.
    #[must_use]
    pub fn max_view_pixels(&self) -> u64 {
        RenderTarget::max_pixels(&self.gpu)
    }

    /// Reads back a person's Gaussians as of the last frame set.
    ///
    /// # Errors
    /// [`FusionError::NoSuchPerson`], [`FusionError::Gpu`].
    pub fn splats(&self, person: PersonId) -> Result<Vec<Splat>, FusionError> {
        self.known(person)?.splats(&self.gpu)
    }

    /// Reads back a person's colours for the person stream, with its motion in this frame set; `None` before its first pose.
    ///
    /// # Errors
    /// [`FusionError::NoSuchPerson`] and [`FusionError::Gpu`].
    pub fn person_frame(&self, person: PersonId, set: &FrameSet) -> Result<Option<PersonFrame>, FusionError> {
        self.known(person)?.person_frame(&self.gpu, set.index, set.master_nanos)
    }

    /// Reads back what a person's last update observed. Needs [`Self::keep_observations`].
    ///
    /// # Errors
    /// [`FusionError::NoSuchPerson`], [`FusionError::Gpu`].
    pub fn observed(&self, person: PersonId) -> Result<Observed, FusionError> {
        self.known(person)?.observed(&self.gpu)
    }

    /// Returns the cameras whose images a person's last update used, in the order of [`Subject::input`].
    #[must_use]
    pub fn viewed(&self, person: PersonId) -> Vec<Camera> {
        let slots = self.subject(person).map_or(&[][..], |subject| &subject.track.viewed);
        slots.iter().filter_map(|&slot| self.rig.cameras.get(slot).cloned()).collect()
    }

    /// Reads back a person's memory, to resume from it in another session.
    ///
    /// # Errors
    /// [`FusionError::NoSuchPerson`], [`FusionError::Gpu`].
    pub fn memory(&self, person: PersonId) -> Result<PersonMemory, FusionError> {
        self.known(person)?.memory(&self.gpu)
    }

    /// Builds everything again on another device and resumes the people from `memories`; people without a memory start anew. Poses,
    /// quality, counts and run times are kept. After an error the session is as it was.
    ///
    /// # Errors
    /// [`FusionError`] when the new device fails as well.
    pub fn rebuild(
        &mut self,
        gpu: &GpuContext,
        memories: &BTreeMap<PersonId, PersonMemory>,
    ) -> Result<(), FusionError> {
        let gpu = gpu.fastest();
        let view_renderer = ViewRenderer::new(&gpu, self.settings.body.gaussians)?;
        let mut subjects = Vec::new();
        for old in &self.subjects {
            let (body, outfit) = (old.body().clone(), old.outfit());
            let avatar = old.avatar().cloned();
            let with = (&self.rig, &self.settings);
            let mut subject = Subject::new(&gpu, old.id(), (body, outfit), avatar.as_ref(), with)?;
            if self.keep_observations {
                subject.keep_observations(&gpu)?;
            }
            if let Some(memory) = memories.get(&old.id()).filter(|memory| memory.outfit() == outfit) {
                subject.restore(&gpu, memory)?;
            }
            subject.take_over(old);
            subjects.push(subject);
        }
        self.newcomers.clear();
        self.learner.iter_mut().for_each(PersonLearner::begin_again);
        (self.gpu, self.view_renderer, self.subjects) = (gpu, view_renderer, subjects);
        Ok(())
    }

    fn known(&self, person: PersonId) -> Result<&Subject, FusionError> {
        self.subject(person).ok_or(FusionError::NoSuchPerson(person))
    }
}

/// Returns the pose at each image's own time, where it differs from the frame set's: the observed one, else that of `curve`.
fn view_poses(
    set: &FrameSet,
    seen: &SeenPerson,
    per_view_time: bool,
    curve: impl Fn(i64) -> Option<Pose>,
) -> Vec<Option<Pose>> {
    let pose = |(view, (_, frame)): (&ViewObservation, (usize, &Arc<Frame>))| {
        if !per_view_time || frame.capture_nanos == set.master_nanos {
            return None;
        }
        view.pose.clone().or_else(|| curve(frame.capture_nanos)).filter(Pose::is_valid)
    };
    seen.views.iter().zip(set.present()).map(pose).collect()
}

/// Returns the views with a mask of the person, and their slots. Counts and logs the others.
fn input_views<'a>(
    set: &'a FrameSet,
    seen: &'a SeenPerson,
    poses: &'a [Option<Pose>],
    rig: &'a Rig,
    counts: &mut Counts,
) -> (Vec<usize>, Vec<InputView<'a>>) {
    let (mut slots, mut views) = (Vec::new(), Vec::new());
    for (((slot, frame), view), pose) in set.present().zip(&seen.views).zip(poses) {
        let mask = view.mask.as_ref().filter(|mask| mask.area_px() > 0);
        if let Some((mask, camera)) = mask.zip(rig.cameras.get(slot)) {
            slots.push(slot);
            let others = view.others.as_ref();
            let (image, edge_colors) = (&frame.image, view.edge_colors.as_slice());
            views.push(InputView { camera, image, mask, edge_colors, others, pose: pose.as_ref() });
            continue;
        }
        counts.without_mask += 1;
        // The 1st, 2nd, 4th ...: a camera that sees no person all night must not fill the disk.
        if counts.without_mask.is_power_of_two() {
            let (camera, count) = (&frame.camera, counts.without_mask);
            tracing::warn!(set = set.index, %camera, count, "no person in the mask; going on without this view");
        }
    }
    (slots, views)
}
