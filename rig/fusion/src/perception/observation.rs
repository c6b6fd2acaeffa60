//! Interface of perception: the trait, and its observations of people in one frame set.

use flyrig_body::{Outfit, Template};
use flyrig_tracker::{EdgeColor, ViewKeypoints};
use flyrig_types::{Camera, FrameSet, Image, Mask, PersonId, Pose};

use crate::{error::FusionError, health::stage_times::StageTimes, settings::effort::Effort};

/// Source of people in frame sets, which come in the order of their times.
///
/// Implement it to bring another detector; [`crate::EstimatedPerception`] and [`crate::GivenPerception`] are the built-in ones.
pub trait Perception: Send {
    /// Returns the people known so far. People may be added while the session runs. A person whose shape number changes is another person:
    /// the session forgets what it has learnt.
    fn people(&self) -> Vec<KnownPerson<'_>>;

    /// Observes every known person in one frame set: one element per person, in the order of [`Self::people`].
    ///
    /// # Errors
    /// Only errors from which later frame sets cannot recover; a person who is not found is [`PersonObservation::Lost`].
    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError>;

    /// Measures the shapes of all people again from the next frame sets on. Returns whether shapes are measured at all.
    fn measure_again(&mut self) -> bool {
        false
    }

    /// Moves a camera from the next frame set on. `plate` is the empty scene as the camera sees it now, where one is known.
    ///
    /// # Errors
    /// [`FusionError::Track`] for a plate of another size.
    fn move_camera(&mut self, slot: usize, camera: &Camera, plate: Option<&Image>) -> Result<(), FusionError> {
        let _ = (slot, camera, plate);
        Ok(())
    }

    /// Measures people in threads of their own from now on, so that no frame set waits for it.
    fn use_threads(&mut self) {}

    /// Returns whether a person is seen whose shape is not known yet.
    fn is_measuring(&self) -> bool {
        false
    }

    /// Chooses the work that the next frame sets get.
    fn set_effort(&mut self, effort: Effort) {
        let _ = effort;
    }
}

/// Person whose shape is known.
#[derive(Debug, Clone, Copy)]
pub struct KnownPerson<'a> {
    /// Id of the person.
    pub person: PersonId,
    /// Number of the shape, which changes with the template.
    pub shape: u32,
    /// Shape of the person in its bind pose.
    pub template: &'a Template,
    /// Clothes of the person, as far as they are known.
    pub outfit: Outfit,
}

/// Observation of one person in a frame set.
#[derive(Debug, Clone)]
pub enum PersonObservation {
    /// The person was found.
    Seen(SeenPerson),
    /// The person was not found.
    Lost {
        /// Id of the person.
        person: PersonId,
        /// Reason, for the log.
        reason: String,
    },
}

/// Person found in a frame set.
#[derive(Debug, Clone)]
pub struct SeenPerson {
    /// Id of the person.
    pub person: PersonId,
    /// Pose at the frame set's time, for the person's template.
    pub pose: Pose,
    /// Confidence in the pose, 0..=1; 1 for a given one.
    pub confidence: f64,
    /// Views, one element per present frame, in their order.
    pub views: Vec<ViewObservation>,
}

/// Observation of one person in one image.
#[derive(Debug, Clone, Default)]
pub struct ViewObservation {
    /// Coverage by the person; `None` when it is not known.
    pub mask: Option<Mask>,
    /// Confidence in the mask, 0..=1; 1 for a given one.
    pub mask_confidence: f64,
    /// Foreground colours along the mask's outline, free of the background's share. Elsewhere the image's own colours hold.
    pub edge_colors: Vec<EdgeColor>,
    /// Coverage by other people, whose pixels are not informative for this person. `None` without others.
    pub others: Option<Mask>,
    /// Landmarks with their own confidences; `None` for given poses.
    pub landmarks: Option<ViewKeypoints>,
    /// Pose at the image's own capture time, where it is known exactly and differs from that of the frame set. `None` lets the session
    /// interpolate the observed poses.
    pub pose: Option<Pose>,
}

impl ViewObservation {
    /// Returns an observation of a mask alone; its confidence is 0 without one.
    #[must_use]
    pub fn of_mask(mask: Option<Mask>, confidence: f64) -> Self {
        let mask_confidence = if mask.is_some() { confidence } else { 0.0 };
        Self { mask, mask_confidence, ..Self::default() }
    }
}
