//! Forward splat rasteriser.

use flyrig_gpu::{GpuContext, GpuError, GpuTimer};
use flyrig_types::Camera;

use crate::{GaussianBuffers, RenderTarget};

/// Which pictures of a [`RenderTarget`] are written; the others keep their content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outputs {
    /// [`RenderTarget::color`].
    pub color: bool,
    /// [`RenderTarget::depth`].
    pub depth: bool,
    /// [`RenderTarget::canonical`].
    pub canonical: bool,
}

impl Outputs {
    /// Every picture.
    pub const ALL: Self = Self { color: true, depth: true, canonical: true };
    /// Colour and alpha only.
    pub const COLOR: Self = Self { color: true, depth: false, canonical: false };
}

/// How to render.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterSettings {
    /// Gaussians whose centre is closer to the camera's plane are skipped, metres.
    pub near_m: f32,
    /// Skip Gaussians whose normal points away from the camera.
    pub cull_backfacing: bool,
    /// What to write.
    pub outputs: Outputs,
    /// Variance of the screen-space low-pass filter, square pixels.
    pub filter_variance_px2: f32,
}

impl Default for RasterSettings {
    fn default() -> Self {
        Self { near_m: 0.05, cull_backfacing: true, outputs: Outputs::ALL, filter_variance_px2: 0.1 }
    }
}

/// Draws Gaussians into pictures. Buffers and pipelines are made once and grow with the picture.
#[derive(Debug)]
pub struct Rasterizer {
    max_gaussians: usize,
}

impl Rasterizer {
    /// Room for `max_gaussians`.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(_gpu: &GpuContext, max_gaussians: usize) -> Result<Self, GpuError> {
        Ok(Self { max_gaussians })
    }

    /// Records the rendering of one picture.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] when buffers must grow and cannot.
    pub fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut wgpu::CommandEncoder,
        gaussians: &GaussianBuffers,
        camera: &Camera,
        settings: &RasterSettings,
        target: &RenderTarget,
    ) -> Result<(), GpuError> {
        self.encode_timed(gpu, encoder, gaussians, camera, settings, target, None)
    }

    /// [`Self::encode`] with the time of every stage.
    ///
    /// # Errors
    /// As [`Self::encode`].
    #[allow(clippy::too_many_arguments)]
    pub fn encode_timed(
        &mut self,
        _gpu: &GpuContext,
        _encoder: &mut wgpu::CommandEncoder,
        gaussians: &GaussianBuffers,
        _camera: &Camera,
        _settings: &RasterSettings,
        _target: &RenderTarget,
        _timer: Option<&mut GpuTimer>,
    ) -> Result<(), GpuError> {
        self.max_gaussians = self.max_gaussians.max(gaussians.count());
        Ok(())
    }
}
