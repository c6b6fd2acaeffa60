//! The estimator: frame sets in, poses and masks out.

use flyrig_body::Template;
use flyrig_types::{FrameSet, Image, Rig};

use crate::{PoseConfig, PoseEstimate, PoseNet, ShapeFit, TrackError};

/// Tracks one person through the frame sets of a rig.
#[derive(Debug)]
pub struct PoseEstimator {
    net: PoseNet,
    template: Template,
    rig: Rig,
    config: PoseConfig,
}

impl PoseEstimator {
    /// For one template (see [`Self::fit_shape`] for its size) and one rig.
    ///
    /// # Errors
    /// Kinds `Rig` and `Template` when either is not usable.
    pub fn new(net: PoseNet, template: &Template, rig: &Rig, config: PoseConfig) -> Result<Self, TrackError> {
        Ok(Self { net, template: template.clone(), rig: rig.clone(), config })
    }

    /// The template, with the person's bone lengths once [`Self::fit_shape`] has run.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Fits bone lengths to the person in a few frame sets (5 to 10, buffered at the start), replaces the
    /// template by the fitted one and forgets the pose. From then on the shape is final.
    ///
    /// # Errors
    /// Kind `Lost` when too few of the sets show a person; the template stays as it was.
    pub fn fit_shape(&mut self, _sets: &[FrameSet]) -> Result<ShapeFit, TrackError> {
        Err(TrackError::lost("not fitted"))
    }

    /// Gives a camera's empty picture; masks of that camera then come from the difference to it.
    ///
    /// # Errors
    /// Kind `Frames` when there is no such camera, `Image` when the size differs or the format cannot be read.
    pub fn set_plate(&mut self, _slot: usize, _plate: &Image) -> Result<(), TrackError> {
        Ok(())
    }

    /// Forgets the last pose: the next set is searched from nothing.
    pub fn reset(&mut self) {}

    /// Pose, masks and quality of one frame set; sets come in the order of time.
    ///
    /// # Errors
    /// Kind `Lost` when no person was found: call again with the next set, the search goes on by itself.
    /// Kinds `Frames`, `Image` and `Net` when the input is not usable. The state stays sound in any case.
    pub fn estimate(&mut self, _set: &FrameSet) -> Result<PoseEstimate, TrackError> {
        let _ = (&self.net, &self.rig, &self.config);
        Err(TrackError::lost("not estimated"))
    }
}
