//! A session: frame sets in, people as Gaussians and views out.

use std::{collections::BTreeMap, sync::Arc, time::Instant};

use flyrig_gpu::GpuContext;
use flyrig_renderer::{GaussianBuffers, Splat};
use flyrig_types::{Camera, Frame, FrameSet, Image, PersonId, Pose, RenderedView, Rig};

use crate::{
    Budget, Effort, FusionError, Observation, Perception, PersonFrame, PersonMemory, Remedy, SeenPerson,
    SessionSettings, StageTimes, Subject, ViewObservation,
    drawing::Drawing,
    newcomers::Newcomers,
    perceiver::{Newcomer, Perceived, Perceiver},
    stillness::Stillness,
    subject::{InputView, Observed},
};

/// Result of one frame set.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// At least one person was posed and coloured.
    Updated,
    /// Nothing moved in any image since everybody was updated: left out to save time, which only a budget does.
    Still,
    /// Nobody was updated, for this reason.
    Held(String),
}

/// Counts of the faults that a session went on after, over all people.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Updates of people.
    pub updated: u64,
    /// People without a usable pose in a set.
    pub lost: u64,
    /// Images without a mask of a person, or with an empty one.
    pub without_mask: u64,
    /// Updates whose deformation was dropped because a number was not finite.
    pub poisoned: u64,
}

/// Builds a [`Session`].
pub struct SessionBuilder {
    gpu: GpuContext,
    rig: Rig,
    settings: SessionSettings,
    perception: Option<Box<dyn Perception>>,
    saved: BTreeMap<PersonId, PersonMemory>,
}

impl SessionBuilder {
    /// Starts from a device and the input cameras, in the order of the frame sets' slots.
    #[must_use]
    pub fn new(gpu: GpuContext, rig: Rig) -> Self {
        Self { gpu, rig, settings: SessionSettings::default(), perception: None, saved: BTreeMap::new() }
    }

    /// Chooses the settings; the defaults otherwise.
    #[must_use]
    pub fn settings(self, settings: SessionSettings) -> Self {
        Self { settings, ..self }
    }

    /// Chooses how people are found. Without, nobody ever is.
    #[must_use]
    pub fn perception(self, perception: impl Perception + 'static) -> Self {
        Self { perception: Some(Box::new(perception)), ..self }
    }

    /// Resumes a person from what an earlier session has learnt.
    #[must_use]
    pub fn person(mut self, id: PersonId, memory: PersonMemory) -> Self {
        self.saved.insert(id, memory);
        self
    }

    /// Samples the surfaces of the people known so far and prepares the GPU. Takes a few seconds.
    ///
    /// # Errors
    /// [`FusionError`] names the setting, template or saved person that cannot be used, or what the GPU refuses.
    pub fn build(self) -> Result<Session, FusionError> {
        self.settings.validate()?;
        let gpu = self.gpu.fastest();
        let mut session = Session {
            drawing: Drawing::new(&gpu, self.settings.body.gaussians)?,
            gpu,
            budget: Budget::new(self.settings.budget),
            stillness: Stillness::default(),
            rig: self.rig,
            settings: self.settings,
            perceiver: self.perception.map(Perceiver::new).unwrap_or_default(),
            subjects: Vec::new(),
            saved: self.saved,
            newcomers: Newcomers::default(),
            keep_observations: false,
            shape_held: false,
            stages: StageTimes::default(),
            counts: Counts::default(),
        };
        let people = session.perceiver.newcomers(&[]);
        session.add_people(people)?;
        Ok(session)
    }
}

/// The live reconstruction of any number of people from one rig.
pub struct Session {
    gpu: GpuContext,
    rig: Rig,
    settings: SessionSettings,
    perceiver: Perceiver,
    subjects: Vec<Subject>,
    drawing: Drawing,
    /// Of people who are not subjects yet.
    saved: BTreeMap<PersonId, PersonMemory>,
    newcomers: Newcomers,
    keep_observations: bool,
    shape_held: bool,
    stillness: Stillness,
    /// Budget of time; whoever draws views of a set adds their time ([`Budget::spend`]).
    pub budget: Budget,
    /// Run times of every stage so far.
    pub stages: StageTimes,
    /// Counts so far.
    pub counts: Counts,
}

impl Session {
    /// The input cameras.
    #[must_use]
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The device that everything runs on.
    #[must_use]
    pub fn gpu(&self) -> &GpuContext {
        &self.gpu
    }

    /// The people, in the order in which they were first known.
    #[must_use]
    pub fn subjects(&self) -> &[Subject] {
        &self.subjects
    }

    /// One person.
    #[must_use]
    pub fn subject(&self, person: PersonId) -> Option<&Subject> {
        self.subjects.iter().find(|subject| subject.id() == person)
    }

    /// Whether anybody has been posed yet.
    #[must_use]
    pub fn has_people(&self) -> bool {
        self.subjects.iter().any(|subject| subject.last_pose.is_some())
    }

    /// Finds people in another way from now on.
    pub fn set_perception(&mut self, perception: impl Perception + 'static) {
        self.perceiver = Perceiver::new(Box::new(perception));
    }

    /// Keeps the observations of each view from the next set on, for [`Self::observed`].
    ///
    /// # Errors
    /// [`FusionError::Gpu`] when the adapter has no room for them.
    pub fn keep_observations(&mut self) -> Result<(), FusionError> {
        self.keep_observations = true;
        self.subjects.iter_mut().try_for_each(|subject| subject.keep_observations(&self.gpu))
    }

    /// Suspends the deformation: colours go on settling on the surface as it is.
    pub fn hold_shape(&mut self, hold: bool) {
        self.shape_held = hold;
        self.subjects.iter_mut().for_each(|subject| subject.shape_held = hold);
    }

    /// Explains every image with the pose of its own capture time, or of its set's.
    pub fn set_per_view_time(&mut self, per_view_time: bool) {
        self.settings.tracking.per_view_time = per_view_time;
    }

    /// Takes in one frame set. A person who is not found keeps the last state.
    ///
    /// # Errors
    /// Only errors from which later sets cannot recover. After one that [is a device fault](FusionError::is_device_fault), call
    /// [`Self::rebuild`].
    pub fn process(&mut self, set: &FrameSet) -> Result<Outcome, FusionError> {
        let start = Instant::now();
        self.budget.next_set();
        let outcome = self.perceive(set).and_then(|perceived| self.reconstruct(set, perceived));
        self.budget.spend(start.elapsed());
        outcome
    }

    /// Observes the people in a set, for [`Self::reconstruct`].
    pub(crate) fn perceive(&mut self, set: &FrameSet) -> Result<Perceived, FusionError> {
        if self.may_rest(set) {
            return Ok(Perceived::Still);
        }
        self.ready_perceiver();
        self.perceiver.perceive(set)
    }

    /// Returns whether a set may be left out because nothing moves, which only a budget allows.
    pub(crate) fn may_rest(&mut self, set: &FrameSet) -> bool {
        self.budget.fps().is_some() && self.stillness.may_rest(set, self.has_people())
    }

    /// Measures everybody's shape again from the next sets on, for a body that does not fit. A person whose shape comes out
    /// differently is learnt anew, colours included. Returns whether shapes are measured at all: not where they are given,
    /// nor by a single camera.
    pub fn measure_again(&mut self) -> bool {
        self.perceiver.measure_again()
    }

    /// Lends perception out, ready for the next set; until it is returned this session finds nobody.
    pub(crate) fn lend_perceiver(&mut self) -> Perceiver {
        self.ready_perceiver();
        std::mem::take(&mut self.perceiver)
    }

    fn ready_perceiver(&mut self) {
        let known = self.subjects.iter().map(|subject| (subject.id(), subject.shape)).collect();
        self.perceiver.ready(self.budget.effort(), known);
    }

    /// Takes perception back.
    pub(crate) fn return_perceiver(&mut self, perceiver: Perceiver) {
        self.perceiver = perceiver;
    }

    /// Updates the people from what [`Self::perceive`] found in the same set. Does not use perception.
    pub(crate) fn reconstruct(&mut self, set: &FrameSet, perceived: Perceived) -> Result<Outcome, FusionError> {
        let start = Instant::now();
        let Perceived::People { observations, newcomers, effort, stages, took } = perceived else {
            self.budget.leave_out();
            self.stages.count("sets left out, nothing moved", 1);
            return Ok(Outcome::Still);
        };
        self.stages.merge(&stages);
        let before = self.gpu.traffic();
        let outcome = self.update_people(set, observations, newcomers, effort);
        self.stages.count_traffic(self.gpu.traffic().since(before));
        self.stillness.taken_in(set.master_nanos, took + start.elapsed());
        outcome
    }

    fn update_people(
        &mut self,
        set: &FrameSet,
        observations: Vec<Observation>,
        newcomers: Vec<Newcomer>,
        effort: Effort,
    ) -> Result<Outcome, FusionError> {
        self.gpu.check()?;
        self.add_people(newcomers)?;
        let mut outcome = Outcome::Held("nobody is known".to_owned());
        for observation in observations {
            match observation {
                Observation::Lost { person, reason } => {
                    self.counts.lost += 1;
                    if let Some(subject) = self.subjects.iter_mut().find(|subject| subject.id() == person) {
                        subject.watch.away(set.master_nanos);
                    }
                    if outcome != Outcome::Updated {
                        outcome = Outcome::Held(reason);
                    }
                }
                Observation::Seen(seen)
                    if self.newcomers.is_preparing(seen.person) && self.subject(seen.person).is_none() =>
                {
                    if outcome != Outcome::Updated {
                        outcome = Outcome::Held(format!("person {} is being prepared", seen.person));
                    }
                }
                Observation::Seen(seen) => {
                    self.update(set, &seen, effort)?;
                    outcome = Outcome::Updated;
                }
            }
        }
        Ok(outcome)
    }

    /// A camera stands elsewhere from the next set on; `plate` is the empty scene as it sees it now, where one is known. A slot that
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

    /// Prepares people who arrive in threads of their own from now on, and lets perception measure them there, so that nobody
    /// waits meanwhile. Results then depend on the speed of the machine.
    pub fn work_beside(&mut self) {
        self.newcomers.work_beside();
        self.perceiver.work_beside();
    }

    /// Makes subjects of people who are none yet, and of those whose shape is another now.
    fn add_people(&mut self, people: Vec<Newcomer>) -> Result<(), FusionError> {
        for newcomer in people {
            let (id, outfit) = (newcomer.person, newcomer.outfit);
            let place = self.subjects.iter().position(|subject| subject.id() == id);
            if place.is_some_and(|place| self.subjects[place].shape == newcomer.shape) {
                continue;
            }
            let subject = self.newcomers.subject(newcomer, &self.gpu, &self.rig, &self.settings)?;
            let Some(mut subject) = subject else { continue };
            if self.keep_observations {
                subject.keep_observations(&self.gpu)?;
            }
            subject.shape_held = self.shape_held;
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

    /// Takes in one person of a set.
    fn update(&mut self, set: &FrameSet, seen: &SeenPerson, effort: Effort) -> Result<(), FusionError> {
        let Some(subject) = self.subjects.iter_mut().find(|subject| subject.id() == seen.person) else {
            return Err(FusionError::NoSuchPerson(seen.person));
        };
        let pose = &seen.pose;
        subject.curve.push(set.master_nanos, pose);
        let pose_of = |(view, (_, frame)): (&ViewObservation, (usize, &Arc<Frame>))| {
            if !self.settings.tracking.per_view_time || frame.capture_nanos == set.master_nanos {
                return None;
            }
            view.pose.clone().or_else(|| subject.curve.at(frame.capture_nanos)).filter(Pose::is_valid)
        };
        let poses: Vec<Option<Pose>> = seen.views.iter().zip(set.present()).map(pose_of).collect();
        let (mut slots, mut views) = (Vec::new(), Vec::new());
        for (((slot, frame), view), pose) in set.present().zip(&seen.views).zip(&poses) {
            let mask = view.mask.as_ref().filter(|mask| mask.area_px() > 0);
            if let Some((mask, camera)) = mask.zip(self.rig.cameras.get(slot)) {
                slots.push(slot);
                let others = view.others.as_ref();
                let (image, edge_colors) = (&frame.image, view.edge_colors.as_slice());
                views.push(InputView { camera, image, mask, edge_colors, others, pose: pose.as_ref() });
                continue;
            }
            self.counts.without_mask += 1;
            // The 1st, 2nd, 4th ...: a camera that sees nobody all night must not fill the disk.
            if self.counts.without_mask.is_power_of_two() {
                let (camera, count) = (&frame.camera, self.counts.without_mask);
                tracing::warn!(set = set.index, %camera, count, "no person in the mask; going on without this view");
            }
        }
        if views.is_empty() {
            subject.watch.away(set.master_nanos);
        } else {
            match subject.watch.arrive(set.master_nanos, pose) {
                Remedy::Forget => subject.forget(&self.gpu)?,
                Remedy::Restart => subject.restart(),
                Remedy::None => {}
            }
        }
        if subject.viewed != slots {
            subject.viewed = slots;
            subject.views_changed();
        }
        subject.confidence = seen.confidence;
        self.drawing.people_changed();
        subject.update(&self.gpu, &mut self.drawing.rasterizer, pose, &views, effort, &mut self.stages)?;
        if subject.is_new() {
            // Gets all the work at whatever level.
            self.budget.leave_out();
        }
        if !views.is_empty() {
            let ids = views.iter().map(|view| view.camera.id.clone());
            let judged = ids.zip(subject.agreement()).filter_map(|(id, quality)| Some((id, quality?)));
            subject.watch.judge(judged);
        }
        self.counts.poisoned += u64::from(subject.deform_report().is_some_and(|report| report.poisoned));
        subject.last_pose = Some(seen.pose.clone());
        self.counts.updated += 1;
        Ok(())
    }

    /// Draws everybody as `camera` would see them now.
    ///
    /// # Errors
    /// [`FusionError::Gpu`]; a view that is too large for the adapter leaves the session as it was.
    pub fn render(&mut self, camera: &Camera) -> Result<RenderedView, FusionError> {
        if !self.drawing.is_timed_by_adapter() {
            // Else the time of the updates under way would be that of the view.
            self.gpu.wait()?;
        }
        self.subjects.iter_mut().for_each(|subject| subject.collect_times(&mut self.stages));
        let posed = |subject: &&Subject| subject.last_pose.is_some();
        let mut people: Vec<&GaussianBuffers> = self.subjects.iter().filter(posed).map(Subject::gaussians).collect();
        if people.is_empty() {
            // Before the first pose: as the surfaces were made.
            people = self.subjects.iter().map(Subject::gaussians).collect();
        }
        if people.is_empty() {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            return Ok(RenderedView { width, height, rgba: vec![0; 4 * width as usize * height as usize] });
        }
        let before = self.gpu.traffic();
        let view = self.drawing.render(&self.gpu, &people, camera, &mut self.stages);
        self.stages.count_traffic(self.gpu.traffic().since(before));
        view
    }

    /// Largest view that the adapter can hold, pixels.
    #[must_use]
    pub fn max_view_pixels(&self) -> u64 {
        flyrig_renderer::RenderTarget::max_pixels(&self.gpu)
    }

    /// Reads a person's Gaussians back, as they were drawn last.
    ///
    /// # Errors
    /// [`FusionError::NoSuchPerson`], [`FusionError::Gpu`].
    pub fn splats(&self, person: PersonId) -> Result<Vec<Splat>, FusionError> {
        self.known(person)?.splats(&self.gpu)
    }

    /// Reads a person's colours back for the person stream, with its motion at this set; None before its first pose.
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

    /// Cameras whose images a person's last update took in, in the order of [`Subject::input`].
    #[must_use]
    pub fn viewed(&self, person: PersonId) -> Vec<Camera> {
        let slots = self.subject(person).map_or(&[][..], |subject| &subject.viewed);
        slots.iter().filter_map(|&slot| self.rig.cameras.get(slot).cloned()).collect()
    }

    /// Reads back what was learnt about a person, to resume from it in another session.
    ///
    /// # Errors
    /// [`FusionError::NoSuchPerson`], [`FusionError::Gpu`].
    pub fn memory(&self, person: PersonId) -> Result<PersonMemory, FusionError> {
        self.known(person)?.memory(&self.gpu)
    }

    /// Builds everything anew on another device and resumes the people from `memories`; those without one start afresh.
    /// Poses, quality, counts and run times are kept. After an error the session is as it was.
    ///
    /// # Errors
    /// [`FusionError`] when the new device fails as well.
    pub fn rebuild(
        &mut self,
        gpu: &GpuContext,
        memories: &BTreeMap<PersonId, PersonMemory>,
    ) -> Result<(), FusionError> {
        let gpu = gpu.fastest();
        let drawing = Drawing::new(&gpu, self.settings.body.gaussians)?;
        let mut subjects = Vec::new();
        for old in &self.subjects {
            let (shape, outfit) = old.shape_and_outfit();
            let mut subject = Subject::new(&gpu, old.id(), (shape, outfit), &self.rig, &self.settings)?;
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
        (self.gpu, self.drawing, self.subjects) = (gpu, drawing, subjects);
        Ok(())
    }

    fn known(&self, person: PersonId) -> Result<&Subject, FusionError> {
        self.subject(person).ok_or(FusionError::NoSuchPerson(person))
    }
}
