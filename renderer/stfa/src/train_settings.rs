//! Settings of a training.

use serde::{Deserialize, Serialize};

/// Settings of a training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Seed of the order of samples and of the initial weights.
    pub seed: u64,
    /// Total steps; the rate falls to zero along half a cosine.
    pub steps: u64,
    /// Adam's rate at the start.
    pub rate: f32,
    /// Weight of 1 - SSIM relative to the mean squared difference: the perceptual term, which preserves contrast that
    /// the mean squared difference alone would blur.
    pub structure: f32,
    /// Weight of the difference of a patch's fine contrast (mean standard deviation of 4x4 pixels): SSIM's windows are
    /// too wide to notice a weave or a print fading.
    pub contrast: f32,
    /// Share of steps without the graph, so that the same weights serve the ablation.
    pub without_space: f64,
    /// Decay of the weights, relative to the rate (Loshchilov and Hutter 2019).
    pub decay: f32,
    /// Whether samples are augmented: colour channels swapped and darkened, left and right mirrored.
    pub vary: bool,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            steps: 10_000,
            rate: 2e-3,
            structure: 0.2,
            contrast: 1.0,
            without_space: 0.1,
            decay: 0.05,
            vary: true,
        }
    }
}
