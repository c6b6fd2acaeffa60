//! One person found in the images by the pose network.

use std::{borrow::Cow, time::Duration};

use flyrig_body::Template;
use flyrig_tracker::{PoseConfig, PoseEstimator, PoseNet, ShapeFit, mask_from_plate};
use flyrig_types::{FrameSet, Image, PersonId, Rig};

use super::{Observation, Perception, SeenPerson, ViewObservation};
use crate::{FusionError, Origin, PerceptionSettings, StageTimes};

/// Frame sets that the shape is fitted to before the first pose.
pub const SHAPE_SETS: usize = 8;
/// Time that they are spread over, seconds: a person who moves is seen in several poses.
pub const SHAPE_SECS: f64 = 1.5;
/// Median residual at which a pose is half believed, pixels.
const HALF_BELIEVED_PX: f64 = 12.0;

/// Estimates pose and masks of one person.
#[derive(Debug)]
pub struct EstimatedPerception {
    estimator: PoseEstimator,
    masks: Origin,
    plates: Vec<Option<Image>>,
}

impl EstimatedPerception {
    /// Looks for one person with the cameras of `rig`. `plates` holds an image of the empty scene by slot, where there is
    /// one: masks then use the difference to it. Masks come from the frames where those of the settings are given.
    ///
    /// # Errors
    /// [`FusionError::Track`] when template, rig or a plate cannot be used.
    pub fn new(
        rig: &Rig,
        template: &Template,
        settings: &PerceptionSettings,
        plates: Vec<Option<Image>>,
    ) -> Result<Self, FusionError> {
        let masks = settings.masks;
        let config = PoseConfig { masks: masks == Origin::Estimated, ..PoseConfig::default() };
        let mut estimator = PoseEstimator::new(PoseNet::embedded()?, template, rig, config)?;
        for (slot, plate) in plates.iter().enumerate() {
            if let Some(plate) = plate {
                estimator.set_plate(slot, plate)?;
            }
        }
        Ok(Self { estimator, masks, plates })
    }

    /// Fits the template's shape to the person in a few sets ([`SHAPE_SETS`], over [`SHAPE_SECS`]). Call it before the session is built.
    ///
    /// # Errors
    /// [`FusionError::Track`] when too few of the sets show a person; the shape stays as it was.
    pub fn learn_shape(&mut self, sets: &[FrameSet]) -> Result<ShapeFit, FusionError> {
        Ok(self.estimator.fit_shape(sets)?)
    }
}

impl Perception for EstimatedPerception {
    fn people(&self) -> Vec<(PersonId, &Template)> {
        vec![(PersonId::default(), self.estimator.template())]
    }

    fn observe<'a>(&mut self, set: &'a FrameSet, stages: &mut StageTimes) -> Result<Vec<Observation<'a>>, FusionError> {
        let person = PersonId::default();
        let estimate = match stages.time("pose from pictures", || self.estimator.estimate(set)) {
            Ok(estimate) => estimate,
            Err(error) => return Ok(vec![Observation::Lost { person, reason: error.to_string() }]),
        };
        let seconds = estimate.quality.seconds;
        for (stage, seconds) in [
            ("  network", seconds.net),
            ("  fit to landmarks", seconds.triangulate + seconds.fit),
            ("  masks", seconds.masks),
            ("  fit to outlines", seconds.outline),
        ] {
            stages.add(stage, Duration::from_secs_f64(seconds.max(0.0)));
        }
        if !estimate.pose.is_valid() {
            let reason = "the pose holds numbers that are not finite".to_owned();
            return Ok(vec![Observation::Lost { person, reason }]);
        }
        let (mut masks, mut keypoints) = (estimate.masks, estimate.keypoints);
        let mut views = Vec::new();
        for (slot, frame) in set.present() {
            let quality = estimate.quality.views.get(slot);
            let mask = match (self.masks, self.plates.get(slot).and_then(Option::as_ref)) {
                (Origin::Given, _) => frame.mask.as_ref().map(Cow::Borrowed),
                (Origin::Estimated, plate) => match (masks.get_mut(slot).and_then(Option::take), plate) {
                    (Some(mask), _) => Some(Cow::Owned(mask)),
                    (None, Some(plate)) => {
                        stages.time("mask from plate", || mask_from_plate(&frame.image, plate))?.map(Cow::Owned)
                    }
                    (None, None) => None,
                },
            };
            let overlap = quality.and_then(|quality| quality.mask_overlap).unwrap_or(0.0);
            let confidence = if self.masks == Origin::Given { 1.0 } else { overlap };
            let landmarks = keypoints.get_mut(slot).and_then(Option::take);
            views.push(ViewObservation { landmarks, ..ViewObservation::of_mask(mask, confidence) });
        }
        let confidence = 1.0 / (1.0 + (estimate.quality.residual_px / HALF_BELIEVED_PX).powi(2));
        Ok(vec![Observation::Seen(SeenPerson { person, pose: estimate.pose, confidence, views })])
    }
}
