//! Inputs and results of one solve: the person at the instants of a frame set, and the images that it is compared with.

use std::time::Duration;

use flyrig_body::Skeleton;
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::UNKNOWN_RGBA;
use flyrig_tracker::OutlineView;
use flyrig_types::{Camera, Pose};

/// One image that the person is compared with.
#[derive(Debug, Clone, Copy)]
pub struct TrackedView<'a> {
    pub camera: &'a Camera,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// sRGB bytes with mask coverage as alpha, row by row.
    pub rgba: &'a [u8],
    /// Copy of `rgba` on the GPU, one element per pixel.
    pub words: &'a StorageBuffer<u32>,
    /// Whether pixels may be marked as unknown ([`flyrig_renderer::LossSettings::with_unknown`]).
    pub with_unknown: bool,
    /// Index into [`TrackedPerson::poses`] of the instant at which the image was taken.
    pub instant: usize,
}

impl TrackedView<'_> {
    /// Returns the view as the outline term sees it.
    pub fn outline(&self) -> OutlineView<'_> {
        OutlineView {
            camera: self.camera,
            size: self.size,
            rgba: self.rgba,
            unknown: self.with_unknown.then_some(UNKNOWN_RGBA),
            instant: self.instant,
        }
    }
}

/// The person at the instants of one frame set.
pub struct TrackedPerson<'a> {
    pub gpu: &'a GpuContext,
    pub skeleton: &'a Skeleton,
    /// Pose at each instant at which images were taken.
    pub poses: &'a [&'a Pose],
    /// Colours of all Gaussians: those of the last painting, or the fixed ones of an avatar.
    pub colors: &'a StorageBuffer<[f32; 4]>,
}

/// Agreement of one view with the deformed person.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewAgreement {
    /// Fraction of the person that is where the image shows it, 0..=1; 0 when as much is wrong as there is.
    pub fraction: f64,
    /// Whether the view counted in the solve: one that disagrees with all others does not.
    pub is_trusted: bool,
}

/// Run times of one frame set's solve.
#[derive(Debug, Clone, Copy, Default)]
pub struct DeformTimes {
    /// Upload and preparation of the images.
    pub prepare: Duration,
    /// Skinning, drawing and comparison.
    pub draw: Duration,
    /// Backward rasteriser and read-back of its sums.
    pub derivatives: Duration,
    /// Everything else: gathering at the nodes and solving for the step.
    pub solve: Duration,
}
