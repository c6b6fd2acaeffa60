//! Results of the pose estimator and their quality.

use flyrig_types::{Mask, Pose};
use glam::DVec3;

use crate::landmarks::keypoints::{LANDMARK_COUNT, ViewKeypoints};
use crate::masks::seen_background::SeenBackground;

/// Reason why a camera has no mask in a frame set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoMask {
    /// The frame set has no frame of this camera.
    NoFrame,
    /// The network finds no person in the crop.
    NoPerson,
    /// The fitted body lies outside this image or behind the camera.
    OutOfView,
    /// The mask was empty after cleaning.
    Empty,
    /// The settings turn masks off.
    Off,
}

/// Agreement of one camera with the fitted body.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewQuality {
    /// Network's probability that the crop shows a person; 0 without a frame.
    pub presence: f64,
    /// Landmarks that the pose fit used and that lie within the inlier distance.
    pub inliers: usize,
    /// Median distance in pixels between the usable landmarks and the fitted body's; `None` without any.
    pub residual_px: Option<f64>,
    /// Intersection over union of the mask and the fitted body's silhouette, 0..=1; `None` without a mask. Clothes and hair
    /// keep it below 1; a low value means that the body is off the person.
    pub mask_overlap: Option<f64>,
    /// Reason why there is no mask; `None` when there is one.
    pub no_mask: Option<NoMask>,
}

/// Time per stage of one estimate, seconds.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StageSeconds {
    /// Search of whole images for a person.
    pub search: f64,
    /// Pose network on the crops around a tracked person.
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

/// Quality of an estimate.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseQuality {
    /// Quality of each view, in rig order.
    pub views: Vec<ViewQuality>,
    /// Median distance of the landmarks of all views from the fitted body, pixels.
    pub residual_px: f64,
    /// Landmarks that two or more views agreed on.
    pub triangulated: usize,
    /// Views that the network ran on; landmarks and masks of the others were carried along.
    pub inferred: usize,
    /// Time per stage.
    pub seconds: StageSeconds,
}

/// Pose of the person in one frame set.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    /// Pose of the skeleton of [`crate::PoseEstimator::template`] at the frame set's master time.
    pub pose: Pose,
    /// Person's mask in each view, at the image's size, in rig order.
    pub masks: Vec<Option<Mask>>,
    /// Background around the person in each view, as the mask estimation measured it, in rig order.
    pub backgrounds: Vec<Option<SeenBackground>>,
    /// Landmarks of each view in which the network ran and found the person, in rig order.
    pub keypoints: Vec<Option<ViewKeypoints>>,
    /// Triangulated landmarks in the world, metres.
    pub points: [Option<DVec3>; LANDMARK_COUNT],
    /// Quality.
    pub quality: PoseQuality,
}
