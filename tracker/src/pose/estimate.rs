//! What the estimator hands out.

use flyrig_types::{Mask, Pose};
use glam::DVec3;

use crate::landmarks::keypoints::{LANDMARK_COUNT, ViewKeypoints};

/// Why a camera of a set has no mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoMask {
    /// The set has no frame of this camera.
    NoFrame,
    /// The network saw no person in the crop.
    NoPerson,
    /// The fitted body lies outside this image or behind the camera.
    OutOfView,
    /// Nothing was left after cleaning.
    Empty,
    /// The settings ask for no masks.
    Off,
}

/// How well one camera agrees with the fitted body.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewQuality {
    /// Network's probability that the crop shows a person; 0 where there was no frame.
    pub presence: f64,
    /// Landmarks that the pose fit used and that lie within the inlier distance.
    pub inliers: usize,
    /// Median distance in pixels between the usable landmarks and the fitted body's; `None` without any.
    pub residual_px: Option<f64>,
    /// Overlap (intersection over union) of the mask and the fitted body's outline, 0..1; `None` without a mask.
    /// Clothes and hair keep it below 1; a body off the person shows as a low value.
    pub mask_overlap: Option<f64>,
    /// Why there is no mask; `None` when there is one.
    pub no_mask: Option<NoMask>,
}

/// Time spent in the stages of one estimate, seconds.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StageSeconds {
    /// Search of whole images for a person.
    pub search: f64,
    /// Network on the crops around a followed person.
    pub net: f64,
    /// Triangulation.
    pub triangulate: f64,
    /// Pose fit.
    pub fit: f64,
    /// Masks.
    pub masks: f64,
    /// Pose fit to the outlines of the masks.
    pub outline: f64,
}

/// How far an estimate may be trusted.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseQuality {
    /// A slot a camera, rig order.
    pub views: Vec<ViewQuality>,
    /// Median over all views of the landmarks' distance to the fitted body, pixels.
    pub residual_px: f64,
    /// Landmarks that two or more views agreed on.
    pub triangulated: usize,
    /// Views that the network looked at; the others' landmarks and masks were carried along.
    pub inferred: usize,
    /// Where the time went.
    pub seconds: StageSeconds,
}

/// Pose of the person in one frame set.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    /// For the skeleton of [`crate::PoseEstimator::template`], at the set's master time.
    pub pose: Pose,
    /// A slot a camera: the person's mask at the image's size.
    pub masks: Vec<Option<Mask>>,
    /// A slot a camera: what the network saw.
    pub keypoints: Vec<Option<ViewKeypoints>>,
    /// Triangulated landmarks in the world, metres.
    pub points: [Option<DVec3>; LANDMARK_COUNT],
    /// How far to trust it.
    pub quality: PoseQuality,
}
