//! Settings of the pose estimator.

use serde::{Deserialize, Serialize};

use crate::settings::PoseSettings;

/// Settings of [`crate::PoseEstimator`]; the defaults suit a rig a few metres wide.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub struct PoseConfig {
    /// Settings that users choose.
    pub settings: PoseSettings,
    /// Least presence of a crop that shows a person, 0..=1.
    pub presence_threshold: f64,
    /// Least confidence of a visible landmark (the smaller of visibility and presence), 0..=1. Hidden ones do not count as
    /// a sign of a person and are not triangulated, but the fit uses the network's estimate of their place.
    pub confidence_threshold: f64,
    /// Largest residual at which a view agrees on a landmark, metres at its depth.
    pub inlier_m: f64,
    /// Standard deviation of the landmarks, as a multiple of that measured on simulated people: errors of a landmark are alike
    /// in all views and last for many frames, so that they are no independent measurements.
    pub landmark_spread: f64,
    /// Standard deviation of the body's outline from the mask's (clothes, the body's shape), metres.
    pub outline_sigma_m: f64,
    /// Rounds per frame set in which the body's outline is matched with the masks and its texture with the images; 0 fits
    /// the pose to landmarks alone.
    pub outline_rounds: usize,
    /// Rounds in which [`crate::PoseEstimator::measure_shape`] matches outlines with masks to solve for lengths, girths,
    /// build and poses together; 0 fits bone lengths to landmarks alone (docs/benchmarks/perception.md, "Shape").
    pub shape_rounds: usize,
    /// Standard deviation of a joint's rotation between frame sets at 30 frame sets per second, radians; smaller is
    /// smoother.
    pub smooth_rad: f64,
    /// Most views with an earlier inference that the network runs on again per frame set, the stalest first; 0 for all that
    /// are due.
    pub max_inferences: usize,
    /// Largest number of solver steps per frame set.
    pub max_steps: usize,
    /// Whether masks are estimated; off saves time where the source provides its own.
    pub masks: bool,
    /// Crops per image and frame set that a search for a person tries; 0 for all of them in every frame set.
    pub search_crops: usize,
    /// Frame sets without the person after which the last pose is forgotten.
    pub forget_after: u32,
}

impl Default for PoseConfig {
    fn default() -> Self {
        Self {
            settings: PoseSettings::default(),
            presence_threshold: 0.5,
            confidence_threshold: 0.3,
            inlier_m: 0.07,
            landmark_spread: 1.4,
            outline_sigma_m: 0.01,
            outline_rounds: 2,
            shape_rounds: 2,
            smooth_rad: 0.15,
            max_inferences: 0,
            max_steps: 12,
            masks: true,
            search_crops: 3,
            forget_after: 15,
        }
    }
}
