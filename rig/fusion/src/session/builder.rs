//! Construction of a session.

use std::collections::BTreeMap;

use flyrig_gpu::GpuContext;
use flyrig_types::{PersonId, Rig};

use super::{
    Session, budget::Budget, newcomers::Newcomers, outcome::Counts, perceiver::Perceiver, stillness::Stillness,
    view_renderer::ViewRenderer,
};
use crate::{
    error::FusionError, health::stage_times::StageTimes, learner::person_learner::PersonLearner,
    perception::observation::Perception, settings::session::SessionSettings, subject::memory::PersonMemory,
};

/// Builder of a [`Session`].
///
/// # Example
/// ```no_run
/// use flyrig_fusion::{
///     EstimatedPerception, SessionBuilder, SessionSettings,
///     body::{ShapeParams, default_template},
///     gpu::{AdapterChoice, GpuContext},
/// };
///
/// # fn build(rig: flyrig_fusion::types::Rig) -> Result<(), Box<dyn std::error::Error>> {
/// let settings = SessionSettings::default();
/// let plates: Vec<_> = rig.cameras.iter().map(|_| None).collect();
/// let body = default_template(&ShapeParams::default())?;
/// let perception = EstimatedPerception::new(&rig, &body, &settings.perception, &plates)?;
/// let gpu = GpuContext::fastest_of(&AdapterChoice::Best)?;
/// let session = SessionBuilder::new(gpu, rig).settings(settings).perception(perception).build()?;
/// assert!(!session.has_people(), "no person was seen yet");
/// # Ok(())
/// # }
/// ```
pub struct SessionBuilder {
    gpu: GpuContext,
    rig: Rig,
    settings: SessionSettings,
    perception: Option<Box<dyn Perception>>,
    saved: BTreeMap<PersonId, PersonMemory>,
}

impl SessionBuilder {
    /// Starts from a device and the input cameras, which are in the order of the frame sets' slots.
    #[must_use]
    pub fn new(gpu: GpuContext, rig: Rig) -> Self {
        Self { gpu, rig, settings: SessionSettings::default(), perception: None, saved: BTreeMap::new() }
    }

    /// Replaces the default settings.
    #[must_use]
    pub fn settings(self, settings: SessionSettings) -> Self {
        Self { settings, ..self }
    }

    /// Chooses how people are found. Without perception, no person ever is.
    #[must_use]
    pub fn perception(self, perception: impl Perception + 'static) -> Self {
        Self { perception: Some(Box::new(perception)), ..self }
    }

    /// Resumes a person from the memory of an earlier session.
    #[must_use]
    pub fn person(mut self, id: PersonId, memory: PersonMemory) -> Self {
        self.saved.insert(id, memory);
        self
    }

    /// Samples the surfaces of the people known so far and prepares the GPU. Takes a few seconds.
    ///
    /// # Errors
    /// [`FusionError`] names the setting, template or saved person that cannot be used, or the request that the GPU rejects.
    pub fn build(self) -> Result<Session, FusionError> {
        self.settings.validate()?;
        let gpu = self.gpu.fastest();
        let learner = self.settings.body.learn.then(PersonLearner::new);
        let mut session = Session {
            view_renderer: ViewRenderer::new(&gpu, self.settings.body.gaussians)?,
            gpu,
            budget: Budget::new(self.settings.budget),
            stillness: Stillness::default(),
            rig: self.rig,
            settings: self.settings,
            perceiver: self.perception.map(Perceiver::new).unwrap_or_default(),
            subjects: Vec::new(),
            saved: self.saved,
            newcomers: Newcomers::default(),
            learner,
            measuring_since: None,
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
