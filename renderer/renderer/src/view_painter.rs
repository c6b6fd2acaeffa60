//! Rendering of Gaussians to bytes: rasteriser, target and conversion in one type.

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_types::{Camera, RenderedView};

use crate::anisotropic::buffers::Gaussians;
use crate::buffers::RenderTarget;
use crate::raster::rasterizer::Rasterizer;
use crate::raster::settings::{Outputs, RasterSettings};
use crate::view_bytes::ViewBytes;

/// Renderer of single views; its buffers are created once and grow with the image and the number of Gaussians.
#[derive(Debug)]
pub struct ViewPainter {
    gpu: GpuContext,
    rasterizer: Rasterizer,
    target: RenderTarget,
    bytes: ViewBytes,
}

impl ViewPainter {
    /// Creates a painter with buffers for `max_gaussians`.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, max_gaussians: usize) -> Result<Self, GpuError> {
        Ok(Self {
            gpu: gpu.clone(),
            rasterizer: Rasterizer::new(gpu, max_gaussians)?,
            target: RenderTarget::of_color(gpu, 16, 16)?,
            bytes: ViewBytes::new(gpu)?,
        })
    }

    /// Renders Gaussians from a camera at its image size and waits for the result, straight alpha.
    ///
    /// # Errors
    /// [`GpuError`].
    pub fn draw<'a>(&mut self, gaussians: impl Into<Gaussians<'a>>, camera: &Camera) -> Result<RenderedView, GpuError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if (self.target.width, self.target.height) != (width, height) {
            self.target = RenderTarget::of_color(&self.gpu, width, height)?;
        }
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.rasterizer.encode(&self.gpu, &mut encoder, gaussians, camera, &settings, &self.target)?;
        self.bytes.encode(&self.gpu, &mut encoder, &self.target)?;
        self.gpu.queue.submit([encoder.finish()]);
        Ok(RenderedView { width, height, rgba: self.bytes.read(&self.gpu, &self.target)? })
    }
}
