//! One person found in the images by the pose network.

use std::{borrow::Cow, time::Duration};

use flyrig_body::{Template, skin_mesh};
use flyrig_tracker::{BodyGate, Matte, PoseConfig, PoseEstimator, PoseNet, ShapeFit, matte};
use flyrig_types::{Camera, FrameSet, Image, PersonId, Pose, Rig};

use super::background::{BackgroundWatch, backgrounds, report};
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
    cameras: Vec<Camera>,
    masks: Origin,
    watch: BackgroundWatch,
}

impl EstimatedPerception {
    /// Looks for one person with the cameras of `rig`. `plates` holds an image of the empty scene by slot, where there is
    /// one: masks then use the difference to it. Masks come from the frames where those of the settings are given.
    ///
    /// # Errors
    /// [`FusionError::Track`] when template, rig or a plate cannot be used, [`FusionError::Setting`] for a wrong key colour.
    pub fn new(
        rig: &Rig,
        template: &Template,
        settings: &PerceptionSettings,
        plates: &[Option<Image>],
    ) -> Result<Self, FusionError> {
        let masks = settings.masks;
        let config = PoseConfig { masks: masks == Origin::Estimated, ..PoseConfig::default() };
        let mut estimator = PoseEstimator::new(PoseNet::embedded()?, template, rig, config)?;
        estimator.set_backgrounds(backgrounds(&rig.cameras, settings, plates)?);
        Ok(Self { estimator, cameras: rig.cameras.clone(), masks, watch: BackgroundWatch::default() })
    }

    /// Fits the template's shape to the person in a few sets ([`SHAPE_SETS`], over [`SHAPE_SECS`]). Call it before the session is built.
    ///
    /// # Errors
    /// [`FusionError::Track`] when too few of the sets show a person; the shape stays as it was.
    pub fn learn_shape(&mut self, sets: &[FrameSet]) -> Result<ShapeFit, FusionError> {
        Ok(self.estimator.fit_shape(sets)?)
    }

    /// Lets the backgrounds follow the light where the person does not stand.
    fn follow_backgrounds(&mut self, set: &FrameSet, pose: &Pose) -> Result<(), FusionError> {
        let (vertices, _) = skin_mesh(self.estimator.template(), pose);
        for (slot, frame) in set.present() {
            let Some(camera) = self.cameras.get(slot) else { continue };
            let gate = BodyGate::new(camera, &vertices, &self.estimator.template().triangles);
            if let Some(background) = self.estimator.background_mut(slot) {
                report(camera, &background.update(&frame.image, gate.as_slice())?);
            }
        }
        Ok(())
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
            let (mask, edge_colors) = match self.masks {
                Origin::Given => (frame.mask.as_ref().map(Cow::Borrowed), Vec::new()),
                Origin::Estimated => match masks.get_mut(slot).and_then(Option::take) {
                    Some(mask) => {
                        let background = self.estimator.background(slot);
                        let Matte { mask, colors } = stages.time("matte", || matte(&frame.image, &mask, background))?;
                        (Some(Cow::Owned(mask)), colors)
                    }
                    None => (None, Vec::new()),
                },
            };
            let overlap = quality.and_then(|quality| quality.mask_overlap).unwrap_or(0.0);
            let confidence = if self.masks == Origin::Given { 1.0 } else { overlap };
            let landmarks = keypoints.get_mut(slot).and_then(Option::take);
            views.push(ViewObservation { landmarks, edge_colors, ..ViewObservation::of_mask(mask, confidence) });
        }
        if self.masks == Origin::Estimated && self.watch.is_due() {
            stages.time("background", || self.follow_backgrounds(set, &estimate.pose))?;
        }
        let confidence = 1.0 / (1.0 + (estimate.quality.residual_px / HALF_BELIEVED_PX).powi(2));
        Ok(vec![Observation::Seen(SeenPerson { person, pose: estimate.pose, confidence, views })])
    }
}
