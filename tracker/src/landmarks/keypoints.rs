//! The 33 body landmarks of BlazePose: names, order, and their places in an image.

use glam::DVec2;

/// Number of body landmarks.
pub const LANDMARK_COUNT: usize = 33;

/// Names of the landmarks in the order of the network ("left" is the person's left).
pub const LANDMARK_NAMES: [&str; LANDMARK_COUNT] = [
    "nose",
    "left eye inner",
    "left eye",
    "left eye outer",
    "right eye inner",
    "right eye",
    "right eye outer",
    "left ear",
    "right ear",
    "mouth left",
    "mouth right",
    "left shoulder",
    "right shoulder",
    "left elbow",
    "right elbow",
    "left wrist",
    "right wrist",
    "left little finger",
    "right little finger",
    "left index finger",
    "right index finger",
    "left thumb",
    "right thumb",
    "left hip",
    "right hip",
    "left knee",
    "right knee",
    "left ankle",
    "right ankle",
    "left heel",
    "right heel",
    "left toes",
    "right toes",
];

/// Landmark in one image.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Keypoint {
    /// Pixels of the image; pixel centres at integers. May lie outside the image.
    pub pixel: DVec2,
    /// 0 unusable (or unseen) to 1 certain.
    pub confidence: f64,
    /// Sharpness of its heatmap.
    pub sharpness: Sharpness,
}

/// Sharpness of the heatmap in which a network sees a landmark.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Sharpness {
    /// The network has no heatmaps.
    #[default]
    Unknown,
    /// The heatmap has no peak near the landmark.
    NoPeak,
    /// The heatmap has a peak.
    Peak {
        /// Standard deviation, cells of the heatmap.
        spread_cells: f64,
        /// Direction in which the peak is widest, a unit vector.
        along: DVec2,
        /// Width along that direction over the width across, 1 or more.
        aspect: f64,
    },
}

impl Keypoint {
    /// Whether the point is finite and has any confidence.
    #[must_use]
    pub fn usable(&self) -> bool {
        self.pixel.is_finite() && self.confidence.is_finite() && self.confidence > 0.0
    }
}

/// Landmarks of one view.
pub type ViewKeypoints = [Keypoint; LANDMARK_COUNT];

pub(crate) const NOSE: usize = 0;
pub(crate) const LEFT_SHOULDER: usize = 11;
pub(crate) const RIGHT_SHOULDER: usize = 12;
pub(crate) const LEFT_ELBOW: usize = 13;
pub(crate) const LEFT_WRIST: usize = 15;
pub(crate) const LEFT_LITTLE: usize = 17;
pub(crate) const LEFT_INDEX: usize = 19;
pub(crate) const LEFT_THUMB: usize = 21;
pub(crate) const LEFT_HIP: usize = 23;
pub(crate) const RIGHT_HIP: usize = 24;
pub(crate) const LEFT_KNEE: usize = 25;
pub(crate) const LEFT_ANKLE: usize = 27;
pub(crate) const LEFT_HEEL: usize = 29;
pub(crate) const LEFT_TOES: usize = 31;
