//! Perception of one frame set as a job that can run beside the reconstruction of the frame set before it.

use std::time::{Duration, Instant};

use flyrig_body::{Outfit, Template};
use flyrig_types::{Camera, FrameSet, Image, PersonId};

use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    perception::observation::{KnownPerson, Perception, PersonObservation},
    settings::effort::Effort,
};

/// Result of perception for one frame set.
pub(crate) enum Perceived {
    /// Nothing moved, so the frame set is left out.
    Still,
    /// People were observed.
    People {
        /// One element per known person.
        observations: Vec<PersonObservation>,
        /// People whom the session did not know when perception began, or knew in another shape.
        newcomers: Vec<Newcomer>,
        /// Whether a person is seen whose shape is not known yet.
        is_measuring: bool,
        /// Work that the frame set gets.
        effort: Effort,
        /// Run times of perception's stages.
        stages: StageTimes,
        /// Run time of perception.
        took: Duration,
    },
}

/// Person who is new to the session, or has a new shape.
pub(crate) struct Newcomer {
    pub person: PersonId,
    pub shape: u32,
    pub template: Template,
    pub outfit: Outfit,
}

/// [`Perception`] with the state of the session that the next frame set needs.
pub(crate) struct Perceiver {
    perception: Box<dyn Perception>,
    effort: Effort,
    /// People of the session, with the numbers of their shapes.
    known: Vec<(PersonId, u32)>,
}

impl Perceiver {
    pub fn new(perception: Box<dyn Perception>) -> Self {
        Self { perception, effort: Effort::FULL, known: Vec::new() }
    }

    /// Chooses the work for the next frame set, and states the people whom the session knows.
    pub fn ready(&mut self, effort: Effort, known: Vec<(PersonId, u32)>) {
        (self.effort, self.known) = (effort, known);
    }

    /// Calls [`Perception::measure_again`].
    pub fn measure_again(&mut self) -> bool {
        self.perception.measure_again()
    }

    /// Calls [`Perception::move_camera`].
    pub fn move_camera(&mut self, slot: usize, camera: &Camera, plate: Option<&Image>) -> Result<(), FusionError> {
        self.perception.move_camera(slot, camera, plate)
    }

    /// Calls [`Perception::use_threads`].
    pub fn use_threads(&mut self) {
        self.perception.use_threads();
    }

    /// Observes all people in a frame set.
    ///
    /// # Errors
    /// Those of [`Perception::observe`].
    pub fn perceive(&mut self, set: &FrameSet) -> Result<Perceived, FusionError> {
        let (start, mut stages) = (Instant::now(), StageTimes::default());
        self.perception.set_effort(self.effort);
        let observations = self.perception.observe(set, &mut stages)?;
        let newcomers = self.newcomers(&self.known);
        let (is_measuring, effort) = (self.perception.is_measuring(), self.effort);
        Ok(Perceived::People { observations, newcomers, is_measuring, effort, stages, took: start.elapsed() })
    }

    /// Returns the people whom perception knows but who are not among `known` in this shape.
    pub fn newcomers(&self, known: &[(PersonId, u32)]) -> Vec<Newcomer> {
        let people = self.perception.people().into_iter();
        let is_new = |found: &KnownPerson<'_>| !known.contains(&(found.person, found.shape));
        let newcomer = |KnownPerson { person, shape, template, outfit }| {
            let template = template.clone();
            Newcomer { person, shape, template, outfit }
        };
        people.filter(is_new).map(newcomer).collect()
    }
}

impl Default for Perceiver {
    fn default() -> Self {
        Self::new(Box::new(Nobody))
    }
}

/// Perception that finds no person.
struct Nobody;

impl Perception for Nobody {
    fn people(&self) -> Vec<KnownPerson<'_>> {
        Vec::new()
    }

    fn observe(&mut self, _: &FrameSet, _: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError> {
        Ok(Vec::new())
    }
}
