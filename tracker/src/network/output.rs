//! Output of a pose network for one crop.

use crate::landmarks::keypoints::{LANDMARK_COUNT, Sharpness};

/// Side of the square crop that the built-in pose network takes, pixels.
pub(crate) const NET_SIDE: usize = 256;

/// Landmark inside the crop.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CropLandmark {
    /// Pixels of the crop, centre of the first pixel at 0.
    pub x: f64,
    /// Pixels of the crop.
    pub y: f64,
    /// Smaller of the probabilities that the landmark is visible and that it lies in the crop.
    pub confidence: f64,
    /// Sharpness of its heatmap, axes of the crop.
    pub sharpness: Sharpness,
    /// Metres from the middle of the hips, axes of the crop: x right, y down, z away from the camera; `None` where the
    /// network gives no depth.
    pub world: Option<[f64; 3]>,
}

impl CropLandmark {
    /// Landmark that the network does not give.
    pub(crate) const UNSEEN: Self =
        Self { x: f64::NAN, y: f64::NAN, confidence: 0.0, sharpness: Sharpness::Unknown, world: None };
}

/// Output for one crop.
#[derive(Debug, Clone)]
pub struct NetOutput {
    /// Body landmarks.
    pub landmarks: [CropLandmark; LANDMARK_COUNT],
    /// Probability of a person.
    pub presence: f64,
    /// Probability of the person, [`NET_SIDE`] x [`NET_SIDE`], row by row, 0..=1; `None` of a network without masks.
    pub mask: Option<Vec<f32>>,
}
