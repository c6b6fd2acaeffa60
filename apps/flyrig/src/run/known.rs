//! Prior knowledge of the person: a saved one, or an avatar.

use anyhow::{Context as _, Result, bail};
use flyrig_body::{Outfit, Template};
use flyrig_fusion::{
    EstimatedPerception, GivenPerception, GivenPerson, Origin, PersonId, PersonMemory, SessionBuilder,
};
use flyrig_takes::{Calibration, KnownBody, SourceKind, TakeBody, known_body};

use crate::config::Config;

/// Knowledge of the person before the first image.
#[derive(Default)]
pub(super) struct PriorKnowledge {
    /// Colours to resume from.
    memory: Option<PersonMemory>,
    /// Body with its estimated shape.
    template: Option<Template>,
    outfit: Outfit,
    /// Whether the body is that of an avatar, which wears its clothes already.
    is_dressed: bool,
}

impl PriorKnowledge {
    /// Loads the person or the avatar that the configuration names; `template` is the body of its poses.
    pub fn load(config: &Config, template: &Template) -> Result<Self> {
        let mut known = Self { is_dressed: config.body.avatar_file().is_some(), ..Self::default() };
        let saved = config.body.person_file().filter(|path| path.exists()).map(PersonMemory::load).transpose()?;
        if let Some(memory) = saved {
            known.outfit = memory.outfit();
            known.template = Some(memory.template(template)?);
            known.memory = Some(memory);
            eprintln!("run: the person is resumed from {}", config.body.person.display());
        }
        if let Some(KnownBody { template: body, memory }) = known_body(&config.body, config.output.avatar)? {
            // Poses of a track, or of the body that the configuration names, must be poses of the avatar.
            if config.perception.pose == Origin::Given || !config.body.template.as_os_str().is_empty() {
                body.check_same_joints(template).context("body.avatar")?;
            }
            known.memory = memory.or(known.memory);
            known.template = Some(body);
            eprintln!("run: the person starts from the avatar {}", config.body.avatar.display());
        }
        Ok(known)
    }

    /// Adds the person and the perception that finds people: from the pose track, or from the images.
    pub fn add_to(
        self,
        builder: SessionBuilder,
        config: &Config,
        calibration: &Calibration,
        body: TakeBody,
    ) -> Result<SessionBuilder> {
        let (settings, Calibration { rig, plates }) = (&config.perception, calibration);
        let builder = match self.memory {
            Some(memory) => builder.person(PersonId::default(), memory),
            None => builder,
        };
        match (settings.pose, body.track) {
            (Origin::Given, Some(track)) => {
                let (person, repeat) = (PersonId::default(), config.source.kind == SourceKind::Sim);
                let template = self.template.unwrap_or(body.template);
                let given = GivenPerson { person, template, track, repeat };
                let perception = GivenPerception::new(rig, vec![given]).with_masks(settings, plates)?;
                Ok(builder.perception(if self.is_dressed { perception.dressed() } else { perception }))
            }
            (Origin::Given, None) => bail!("perception.pose is \"given\" but the template holds no animation"),
            (Origin::Estimated, _) => {
                let mut perception = EstimatedPerception::new(rig, &body.template, settings, plates)?;
                eprintln!("run: looking for people; each is measured for a moment, then drawn");
                if let Some(template) = &self.template {
                    perception.know_shape(template, self.outfit)?;
                }
                Ok(builder.perception(perception))
            }
        }
    }
}
