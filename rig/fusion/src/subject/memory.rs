//! Learnt shape, deformation and colours of a person.
//!
//! A memory can be saved and given to the [`crate::SessionBuilder`] of a later program, or made of an avatar
//! ([`PersonMemory::of_avatar`]). A session resumes from it after a restart of the program or the loss of the graphics device: [`crate::LiveRig`] reads it back every
//! ten seconds. Files of it are in [`super::memory_file`].

use std::sync::Arc;

use flyrig_avatar::Avatar;
use flyrig_body::{Joint, Outfit, Skeleton, Template};
use flyrig_stfa::FeatureMemory;
use flyrig_stream::EncodedTemplate;
use glam::{DVec3, Vec3};

use crate::error::FusionError;

/// Learnt shape, deformation and colours of one person.
///
/// # Example
/// ```
/// use std::sync::Arc;
///
/// use flyrig_avatar::Avatar;
/// use flyrig_body::{ShapeParams, default_template, sample_surface};
/// use flyrig_fusion::PersonMemory;
/// use flyrig_renderer::HarmonicOrder;
///
/// // A person who is known before the first image, as an avatar: grey.
/// let body = default_template(&ShapeParams::default())?;
/// let avatar = Avatar::new(&body, &sample_surface(&body, 2000, 1)?, None, &[], HarmonicOrder::Zero)?;
/// let memory = PersonMemory::of_avatar(Arc::new(avatar));
/// assert_eq!(memory.template(&body)?.positions, body.positions);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct PersonMemory {
    /// Canonical positions of the template's vertices, metres.
    pub(super) positions: Vec<Vec3>,
    /// Canonical normals of the template's vertices.
    pub(super) normals: Vec<Vec3>,
    pub(super) joints: Vec<Joint>,
    pub(super) outfit: Outfit,
    /// Canonical translation of each node of the deformation graph, metres; empty where the body is only skinned.
    pub(crate) translations: Vec<DVec3>,
    /// Accumulated linear RGB of each Gaussian, and its weight.
    pub(crate) memory: Vec<[f32; 4]>,
    /// Linear RGB of each Gaussian, and its opacity.
    pub(crate) colors: Vec<[f32; 4]>,
    /// Features that learned appearance has accumulated on the processor.
    pub(crate) networks: Option<NetworkMemory>,
    /// Whether the person starts from this memory after every long absence, and not only once.
    pub(crate) is_start: bool,
    /// Avatar that viewers draw from poses alone, in place of the surface and the colours that are streamed.
    pub(crate) stream: Option<Arc<EncodedTemplate>>,
    /// Avatar whose Gaussians the person is made of.
    pub(crate) avatar: Option<Arc<Avatar>>,
}

/// Features that the networks of learned appearance have accumulated.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct NetworkMemory {
    /// Digest of the networks' weights; the features mean nothing to other networks.
    pub digest: u64,
    pub memory: FeatureMemory,
}

impl PersonMemory {
    /// Collects what is known about a person; `template` is the body without clothes.
    pub(crate) fn new(
        (template, outfit): (&Template, Outfit),
        translations: Vec<DVec3>,
        memory: Vec<[f32; 4]>,
        colors: Vec<[f32; 4]>,
        networks: Option<NetworkMemory>,
    ) -> Self {
        let joints = template.skeleton.joints().to_vec();
        let (positions, normals) = (template.positions.clone(), template.normals.clone());
        Self {
            positions,
            normals,
            joints,
            outfit,
            translations,
            memory,
            colors,
            networks,
            is_start: false,
            stream: None,
            avatar: None,
        }
    }

    /// Describes a person who is made of an avatar's Gaussians: they are tracked and rendered, and the images correct their colours. A
    /// person who was lost for long starts from the avatar again.
    #[must_use]
    pub fn of_avatar(avatar: Arc<Avatar>) -> Self {
        let none = vec![[0.0; 4]; avatar.gaussians()];
        let known = Self::new((&avatar.template, Outfit::default()), Vec::new(), none.clone(), none, None);
        Self { is_start: true, avatar: Some(avatar), ..known }
    }

    /// Lets viewers draw the person as this avatar, from poses alone. It must have the joints of the person's body.
    #[must_use]
    pub fn with_stream(self, avatar: EncodedTemplate) -> Self {
        Self { stream: Some(Arc::new(avatar)), ..self }
    }

    /// Removes the avatar of [`Self::with_stream`], so that viewers get the tracked surface.
    pub fn take_stream(&mut self) -> Option<Arc<EncodedTemplate>> {
        self.stream.take()
    }

    /// Returns the avatar that the person is made of; `None` for one made of the surface.
    #[must_use]
    pub fn avatar(&self) -> Option<&Arc<Avatar>> {
        self.avatar.as_ref()
    }

    /// Returns the person's clothes.
    #[must_use]
    pub fn outfit(&self) -> Outfit {
        self.outfit
    }

    /// Returns the person's template: `base` with the learnt shape.
    ///
    /// # Errors
    /// [`FusionError::SavedPerson`] when it was learnt with a template of other vertices or joints.
    pub fn template(&self, base: &Template) -> Result<Template, FusionError> {
        let names = |joints: &[Joint]| joints.iter().map(|joint| joint.name.clone()).collect::<Vec<_>>();
        // A person whose fingers were estimated.
        let with_fingers = base.with_fingers().ok().filter(|with| names(&self.joints) == names(with.skeleton.joints()));
        let base = with_fingers.as_ref().unwrap_or(base);
        if self.positions.len() != base.positions.len() || names(&self.joints) != names(base.skeleton.joints()) {
            return Err(fault(
                &base.name,
                format!(
                    "it has {} vertices and {} joints, the template {} and {}; use the body that it was saved with, or \
                     delete it",
                    self.positions.len(),
                    self.joints.len(),
                    base.positions.len(),
                    base.skeleton.joints().len()
                ),
            ));
        }
        let template = Template {
            positions: self.positions.clone(),
            normals: self.normals.clone(),
            skeleton: Skeleton::new(self.joints.clone())?,
            ..base.clone()
        };
        template.check()?;
        Ok(template)
    }
}

/// Builds the error of a saved person that cannot be used.
pub(super) fn fault(name: &str, problem: String) -> FusionError {
    FusionError::SavedPerson { name: name.to_owned(), problem }
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template, sample_surface};
    use flyrig_renderer::HarmonicOrder;

    use super::*;

    #[test]
    fn a_person_of_another_body_is_refused() {
        let mut base = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&base, 9, 1).unwrap();
        let avatar = Avatar::new(&base, &surface, None, &[], HarmonicOrder::Zero).unwrap();
        let memory = PersonMemory::of_avatar(Arc::new(avatar));
        base.positions.pop();
        assert!(memory.template(&base).unwrap_err().to_string().contains("vertices"));
    }
}
