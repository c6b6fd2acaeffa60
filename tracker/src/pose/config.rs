//! Settings of the tracker.

use serde::{Deserialize, Serialize};

/// Settings of [`crate::PoseEstimator`]; the defaults suit a rig a few metres wide.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub struct PoseConfig {
    /// Crops whose presence is lower than this show no person, 0..1.
    pub presence_threshold: f64,
    /// Landmarks of lower confidence (the smaller of visibility and presence) are hidden: they prove nobody's presence and are not
    /// triangulated, but the fit heeds where the network expects them, 0..1.
    pub confidence_threshold: f64,
    /// Distance up to which views agree on a landmark, metres at its depth.
    pub inlier_m: f64,
    /// Standard deviation of the landmarks, as a multiple of the one measured on simulated people.
    pub landmark_spread: f64,
    /// Standard deviation of the body's outline from the mask's (clothes, the body's shape), metres.
    pub outline_sigma_m: f64,
    /// How often the outline of the body is matched with the masks, and its texture with the images, in a set; 0 fits the pose
    /// to landmarks alone.
    pub outline_rounds: usize,
    /// Height of the person, metres; `None` measures it.
    pub height_m: Option<f64>,
    /// Height of the floor in the world, along the rig's up, metres. A single camera, without [`Self::height_m`], measures people by where
    /// their feet stand.
    pub floor_m: f64,
    /// Rounds in which [`crate::PoseEstimator::measure_shape`] matches outlines with masks to solve for lengths, girths, build and
    /// poses together; 0 fits bone lengths to landmarks alone (docs/benchmarks/perception.md, "Shape from outlines").
    pub shape_rounds: usize,
    /// Standard deviation of a joint's turn between sets at 30 sets a second, radians; smaller is smoother.
    pub smooth_rad: f64,
    /// Distance that the body moves in a view until the network looks at that view again, metres; 0 looks at every view of
    /// every set.
    pub look_after_m: f64,
    /// Views with an earlier look that the network looks at again in a set at most, those that need it most; 0: all that need it.
    pub max_inferences: usize,
    /// Largest number of solver steps a frame set.
    pub max_steps: usize,
    /// Whether masks are made; off saves time where the source brings its own.
    pub masks: bool,
    /// Crops of an image that a search for a person looks at in a set; 0 looks at all of them in every set.
    pub search_crops: usize,
    /// Frame sets without a person after which the memory of the last pose is dropped.
    pub forget_after: u32,
}

impl Default for PoseConfig {
    fn default() -> Self {
        Self {
            presence_threshold: 0.5,
            confidence_threshold: 0.3,
            inlier_m: 0.07,
            landmark_spread: 1.0,
            outline_sigma_m: 0.01,
            outline_rounds: 2,
            height_m: None,
            floor_m: 0.0,
            shape_rounds: 2,
            smooth_rad: 0.15,
            look_after_m: 0.02,
            max_inferences: 0,
            max_steps: 12,
            masks: true,
            search_crops: 3,
            forget_after: 15,
        }
    }
}
