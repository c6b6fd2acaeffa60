//! How the deformation is tracked.

use flyrig_renderer::WantedPicture;
use flyrig_tracker::{DeformSettings, PoseFreedom};

/// Everything about the deformation that may be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeformOptions {
    /// Steps, weights and limits.
    pub solver: DeformSettings,
    /// Gaussians that are compared with the pictures; the others follow.
    pub gaussians: usize,
    /// Pictures are halved at most so often, while a pixel stays finer than the compared Gaussians' spacing.
    pub max_level: u32,
    /// Views that are compared at most, those from the most different directions; 0: all.
    pub views: usize,
    /// Whether, and how freely, the pose is corrected as well.
    pub pose: Option<PoseFreedom>,
}

impl DeformOptions {
    /// Compared as they are drawn: every Gaussian, every pixel.
    pub fn full(solver: DeformSettings) -> Self {
        Self { gaussians: usize::MAX, max_level: 0, views: 0, ..Self::coarse(solver) }
    }

    /// Compared no finer than the result needs: measured in docs/benchmarks/deform.md.
    pub fn coarse(solver: DeformSettings) -> Self {
        Self { solver, gaussians: 30_000, max_level: WantedPicture::MAX_LEVEL, views: 0, pose: None }
    }
}
