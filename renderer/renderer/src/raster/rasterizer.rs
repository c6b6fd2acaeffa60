//! Public interface of the forward splat rasteriser.

use std::time::Duration;

use flyrig_gpu::{GpuContext, GpuError, GpuTimer};
use flyrig_types::Camera;
use wgpu::CommandEncoder;

use crate::anisotropic::buffers::Gaussians;
use crate::buffers::RenderTarget;
use crate::raster::device::DeviceRasterizer;
use crate::raster::processor::rasterizer::ProcessorRasterizer;
use crate::raster::settings::Latest;
use crate::raster::settings::{RasterSettings, RasterStats};

/// Rasteriser of Gaussians into images: projection through the camera's lens (EWA splatting), stable sort by depth,
/// lists by tile, and front-to-back blending, all on the device without a wait, or on the processor when the image is
/// recorded.
///
/// - Gaussians are ordered by the depth of their centres, to 24 bits of the range of the depths as floats; equal depths
///   keep the order of the buffers. Equal input gives equal bytes on one device.
/// - `alpha = min(opacity * exp(-r²/2), 0.99)`; below 1/255 a splat does not touch a pixel; a pixel is finished once
///   its transmittance is below 1e-4.
/// - A Gaussian with a non-finite number, with scale or opacity not above 0, behind [`RasterSettings::near_m`], beyond
///   1e9 m, or outside the lens's valid radius is not drawn.
/// - [`AnisotropicBuffers`](crate::AnisotropicBuffers) share all steps after projection and colouring.
/// - Their normals and the depths on their planes ([`RenderTarget::planes`](crate::RenderTarget::planes)) are drawn where
///   [`Outputs::planes`](crate::Outputs::planes) asks for them; otherwise no kernel computes them.
/// - Buffers and pipelines are created once and grow with the image and the number of Gaussians.
///
/// # Examples
/// ```
/// use flyrig_gpu::{AdapterChoice, GpuContext};
/// use flyrig_renderer::{GaussianBuffers, RasterSettings, Rasterizer, RenderTarget};
/// use flyrig_types::{Camera, ColorMatch, Intrinsics, Isometry};
/// use glam::DVec3;
///
/// let gpu = GpuContext::new(&AdapterChoice::Best)?.on_processor();
/// // A red Gaussian of 10 cm at the origin that faces the camera.
/// let gaussians = GaussianBuffers::zeroed(&gpu, 1)?;
/// gaussians.center_scale.write(&gpu, &[[0.0, 0.0, 0.0, 0.1]]);
/// gaussians.normal.write(&gpu, &[[0.0, -1.0, 0.0, 0.0]]);
/// gaussians.color.write(&gpu, &[[1.0, 0.0, 0.0, 1.0]]);
/// let camera = Camera {
///     id: "front".into(),
///     intrinsics: Intrinsics::pinhole(65, 65, 100.0),
///     camera_from_world: Isometry::look_at(DVec3::new(0.0, -2.0, 0.0), DVec3::ZERO, DVec3::Z),
///     time_offset_nanos: 0,
///     color: ColorMatch::NONE,
/// };
///
/// let mut rasterizer = Rasterizer::new(&gpu, gaussians.count())?;
/// let target = RenderTarget::new(&gpu, 65, 65)?;
/// let mut encoder = gpu.device.create_command_encoder(&Default::default());
/// rasterizer.encode(&gpu, &mut encoder, &gaussians, &camera, &RasterSettings::default(), &target)?;
/// gpu.queue.submit([encoder.finish()]);
///
/// let [red, _, _, alpha] = target.color.read(&gpu)?[65 * 32 + 32];
/// assert!(red > 0.9 && alpha > 0.9);
/// assert!((target.depth.read(&gpu)?[65 * 32 + 32] - 2.0).abs() < 1e-3);
/// # Ok::<(), flyrig_gpu::GpuError>(())
/// ```
#[derive(Debug)]
pub struct Rasterizer {
    pub(crate) on: RasterizerOn,
}

/// Implementation by the place where kernels run.
#[derive(Debug)]
pub(crate) enum RasterizerOn {
    Device(Box<DeviceRasterizer>),
    Processor(Box<ProcessorRasterizer>),
}

impl Rasterizer {
    /// Creates a rasteriser with buffers for `max_gaussians`.
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

    /// Records the rendering of one image. The target determines its size; the camera's own width and height are
    /// ignored. One encoder takes any number of images.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] where buffers would have to grow beyond the adapter's limits.
    pub fn encode<'a>(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: impl Into<Gaussians<'a>>,
        camera: &Camera,
        settings: &RasterSettings,
        target: &RenderTarget,
    ) -> Result<(), GpuError> {
        self.encode_timed(gpu, encoder, gaussians, (camera, settings), target, None)
    }

    /// Records the image as [`Self::encode`] does and measures its four stages on the device: "project", "depth sort",
    /// "tile lists", "blend".
    ///
    /// # Errors
    /// As [`Self::encode`].
    pub fn encode_timed<'a>(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: impl Into<Gaussians<'a>>,
        (camera, settings): (&Camera, &RasterSettings),
        target: &RenderTarget,
        timer: Option<&mut GpuTimer>,
    ) -> Result<(), GpuError> {
        let gaussians = gaussians.into();
        let settings = settings.for_kind(gaussians, target);
        match &mut self.on {
            RasterizerOn::Device(device) => {
                device.encode_timed(gpu, encoder, gaussians, (camera, &settings), target, timer)
            }
            RasterizerOn::Processor(processor) => {
                processor.draw(gaussians, camera, &settings, target);
                Ok(())
            }
        }
    }

    /// Returns the description of the image recorded last; `None` before the first one.
    pub(crate) fn latest(&self) -> Option<Latest> {
        match &self.on {
            RasterizerOn::Device(device) => device.latest,
            RasterizerOn::Processor(processor) => processor.latest(),
        }
    }

    /// Returns the run times of projection, depth sort, tile lists and blending of the latest image on the processor.
    /// `None` on a device: pass a timer to [`Self::encode_timed`] there.
    #[must_use]
    pub fn processor_times(&self) -> Option<[Duration; 4]> {
        match &self.on {
            RasterizerOn::Device(_) => None,
            RasterizerOn::Processor(processor) => Some(processor.times()),
        }
    }

    /// Waits for the device and returns the resources that the latest image used.
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
