//! Forward splat rasteriser: what it draws and how it is called.

use std::time::Duration;

use flyrig_gpu::{GpuContext, GpuError, GpuTimer};
use flyrig_types::Camera;
use wgpu::CommandEncoder;

use crate::processor::ProcessorRasterizer;
use crate::raster_device::DeviceRasterizer;
use crate::{GaussianBuffers, RenderTarget};

/// Which pictures of a [`RenderTarget`] are written; the others keep their content.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
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
    /// Colour, alpha and canonical positions: the inputs of direct appearance.
    pub const SURFACE: Self = Self { color: true, depth: false, canonical: true };
}

/// How to render.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterSettings {
    /// Gaussians whose centre is closer to the camera's plane are skipped, metres.
    pub near_m: f32,
    /// Skip Gaussians whose normal points away from the camera ([`crate::BACKFACING_COSINE`]). For closed surfaces.
    pub cull_backfacing: bool,
    /// What to write.
    pub outputs: Outputs,
    /// Variance of the low-pass filter that is added to every splat on the screen, square pixels.
    /// The splat's opacity falls so that its integral stays: Mip-Splatting's 2D Mip filter (Yu et al.
    /// 2024, Eq. 10). 0.1 is that paper's value for one pixel.
    pub filter_variance_px2: f32,
    /// Only the tiles that this part of the picture touches are blended, `[left, top, right, bottom]` in pixels, right
    /// and bottom excluded; all others keep their content. None: the whole picture.
    pub area: Option<[u32; 4]>,
}

impl Default for RasterSettings {
    fn default() -> Self {
        Self { near_m: 0.05, cull_backfacing: true, outputs: Outputs::ALL, filter_variance_px2: 0.1, area: None }
    }
}

/// What the latest picture needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RasterStats {
    /// Gaussians that touch the picture.
    pub visible_gaussians: u32,
    /// Pairs of a Gaussian and a tile, at most one more than there is room for.
    pub pairs: u32,
    /// Pictures since this rasteriser was made that wanted more pairs than there was room for: they
    /// lack their farthest Gaussians.
    pub overflowed_pictures: u32,
}

/// Draws isotropic Gaussians into pictures: projection through the camera's lens (EWA splatting), stable
/// sort by depth, lists by tile, and front-to-back blending, all on the device without a wait, or on the processor when the
/// picture is recorded.
///
/// - Depth order is that of the centres, to 24 bits of the range of their depths as floats; equal depths keep the
///   order of the buffers. Equal input gives equal bytes on one device.
/// - `alpha = min(opacity * exp(-r²/2), 0.99)`; below 1/255 a splat does not touch a pixel; a pixel is
///   finished when less than 1e-4 of the light behind it would pass.
/// - A Gaussian with any number that is not finite, with scale or opacity not above 0, behind
///   [`RasterSettings::near_m`], beyond 1e9 m, or outside the lens's valid radius is not drawn.
/// - Buffers and pipelines are made once; they grow with the picture and the number of Gaussians.
#[derive(Debug)]
pub struct Rasterizer {
    pub(crate) on: RasterizerOn,
}

/// What the backward pass must know about the picture that was recorded last.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Latest {
    pub gaussians: usize,
    pub size: [u32; 2],
    /// Columns and rows of tiles that were blended.
    pub blended: [u32; 2],
    pub outputs: Outputs,
}

/// Where the kernels run.
#[derive(Debug)]
pub(crate) enum RasterizerOn {
    Device(Box<DeviceRasterizer>),
    Processor(Box<ProcessorRasterizer>),
}

impl Rasterizer {
    /// Room for `max_gaussians`.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, max_gaussians: usize) -> Result<Self, GpuError> {
        let on = if gpu.is_on_processor() {
            RasterizerOn::Processor(Box::default())
        } else {
            RasterizerOn::Device(Box::new(DeviceRasterizer::new(gpu, max_gaussians)?))
        };
        Ok(Self { on })
    }

    /// Records the rendering of one picture. Its size is the target's; the camera's own width and height
    /// do not matter. Any number of pictures can go into one encoder.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] when buffers must grow and cannot.
    pub fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: &GaussianBuffers,
        camera: &Camera,
        settings: &RasterSettings,
        target: &RenderTarget,
    ) -> Result<(), GpuError> {
        self.encode_timed(gpu, encoder, gaussians, (camera, settings), target, None)
    }

    /// [`Self::encode`] with the times of its four stages on the device: "project", "depth sort", "tile lists", "blend".
    ///
    /// # Errors
    /// As [`Self::encode`].
    pub fn encode_timed(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: &GaussianBuffers,
        (camera, settings): (&Camera, &RasterSettings),
        target: &RenderTarget,
        timer: Option<&mut GpuTimer>,
    ) -> Result<(), GpuError> {
        match &mut self.on {
            RasterizerOn::Device(device) => {
                device.encode_timed(gpu, encoder, gaussians, (camera, settings), target, timer)
            }
            RasterizerOn::Processor(processor) => {
                processor.draw(gaussians, camera, settings, target);
                Ok(())
            }
        }
    }

    /// The picture that was recorded last; None before the first picture.
    pub(crate) fn latest(&self) -> Option<Latest> {
        match &self.on {
            RasterizerOn::Device(device) => device.latest,
            RasterizerOn::Processor(processor) => processor.latest(),
        }
    }

    /// Run times of projection, depth sort, tile lists and blending of the latest picture on the processor. None for the
    /// device: pass a timer to [`Self::encode_timed`] there.
    #[must_use]
    pub fn processor_times(&self) -> Option<[Duration; 4]> {
        match &self.on {
            RasterizerOn::Device(_) => None,
            RasterizerOn::Processor(processor) => Some(processor.times()),
        }
    }

    /// Waits for the device and returns what the latest picture needed.
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn stats(&self, gpu: &GpuContext) -> Result<RasterStats, GpuError> {
        match &self.on {
            RasterizerOn::Device(device) => device.stats(gpu),
            RasterizerOn::Processor(processor) => Ok(processor.stats()),
        }
    }
}

/// First tile, and columns and rows of the tiles that an area of pixels touches.
pub(crate) fn tile_range(area: Option<[u32; 4]>, tiles: [u32; 2], tile: u32) -> ([u32; 2], [u32; 2]) {
    let Some([left, top, right, bottom]) = area else { return ([0; 2], tiles) };
    let range = |first: u32, end: u32, count: u32| {
        let tiles = if first < end { end.div_ceil(tile).min(count) } else { 0 };
        let first = (first / tile).min(count);
        (first, tiles.saturating_sub(first))
    };
    let (x, columns) = range(left, right, tiles[0]);
    let (y, rows) = range(top, bottom, tiles[1]);
    ([x, y], [columns, rows])
}
