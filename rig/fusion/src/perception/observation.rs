//! Who is in front of the cameras: from a frame set to observations of people.

mod background;
mod colors;
mod estimated;
mod given;
mod outfits;
mod split_mask;

use flyrig_body::{Outfit, Template};
use flyrig_tracker::{EdgeColor, ViewKeypoints};
use flyrig_types::{Camera, FrameSet, Image, Mask, PersonId, Pose};

pub use self::estimated::{EstimatedPerception, SHAPE_SECS, SHAPE_SETS};
pub use self::given::{GivenPerception, GivenPerson};
use crate::{Effort, FusionError, StageTimes};

/// Finds people in frame sets. Sets come in the order of their times.
pub trait Perception: Send {
    /// The people known so far. People may be added while the session runs. A person whose shape number changes is somebody
    /// else: the session forgets what it has learnt about the person.
    fn people(&self) -> Vec<KnownPerson<'_>>;

    /// Observes every known person in one set: one element a person, in the order of [`Self::people`].
    ///
    /// # Errors
    /// Only errors from which later sets cannot recover; a person who is not found is [`Observation::Lost`].
    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<Observation>, FusionError>;

    /// Measures everybody's shape again from the next sets on. Returns whether shapes are measured at all.
    fn measure_again(&mut self) -> bool {
        false
    }

    /// A camera stands elsewhere from the next set on; `plate` is the empty scene as it sees it now, where one is known.
    ///
    /// # Errors
    /// [`FusionError::Track`] for a plate of another size.
    fn move_camera(&mut self, slot: usize, camera: &Camera, plate: Option<&Image>) -> Result<(), FusionError> {
        let _ = (slot, camera, plate);
        Ok(())
    }

    /// Measures people in threads of their own from now on, so that no set waits for it.
    fn work_beside(&mut self) {}

    /// Chooses how much work the next sets get.
    fn set_effort(&mut self, effort: Effort) {
        let _ = effort;
    }
}

/// A person whose shape is known.
#[derive(Debug, Clone, Copy)]
pub struct KnownPerson<'a> {
    /// Who.
    pub person: PersonId,
    /// Number of the shape; another one for another template.
    pub shape: u32,
    /// The person's shape in its bind pose.
    pub template: &'a Template,
    /// Clothes of the person, as far as they are known.
    pub outfit: Outfit,
}

/// Observation of one person in a set.
#[derive(Debug, Clone)]
pub enum Observation {
    /// The person was found.
    Seen(SeenPerson),
    /// The person was not found.
    Lost {
        /// Who.
        person: PersonId,
        /// Why, for the log.
        reason: String,
    },
}

/// A person found in a set.
#[derive(Debug, Clone)]
pub struct SeenPerson {
    /// Who.
    pub person: PersonId,
    /// Pose at the set's time, for the person's template.
    pub pose: Pose,
    /// Confidence in the pose, 0..=1; 1 for a given one.
    pub confidence: f64,
    /// One element a present frame, in their order.
    pub views: Vec<ViewObservation>,
}

/// A person in one image.
#[derive(Debug, Clone, Default)]
pub struct ViewObservation {
    /// Coverage by the person; `None` when it is not known.
    pub mask: Option<Mask>,
    /// Confidence in the mask, 0..=1; 1 for a given one.
    pub mask_confidence: f64,
    /// Colours of the mask's outline without the background's share; the image's own elsewhere.
    pub edge_colors: Vec<EdgeColor>,
    /// Coverage by other people, whose pixels say nothing about this person. `None` without others.
    pub others: Option<Mask>,
    /// Landmarks with their own confidences; `None` for given poses.
    pub landmarks: Option<ViewKeypoints>,
    /// Pose at the image's own capture time, where it is known exactly and differs from that of the set. `None` lets the
    /// session interpolate the observed poses.
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
