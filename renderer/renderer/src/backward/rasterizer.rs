//! Public interface of the backward splat rasteriser.

use flyrig_gpu::{GpuContext, GpuError};
use wgpu::CommandEncoder;

use crate::anisotropic::buffers::{AnisotropicBuffers, AnisotropicGradients};
use crate::backward::device::DeviceBackward;
use crate::backward::error::BackwardError;
use crate::backward::gradients::{Carry, GaussianGradients, ImageGradients};
use crate::backward::processor::ProcessorBackward;
use crate::backward::target::{GradientTarget, check};
use crate::buffers::{GaussianBuffers, RenderTarget};
use crate::raster::rasterizer::Rasterizer;
use crate::raster::rasterizer::RasterizerOn;

/// Derivatives of [`Rasterizer`]'s images with respect to the centres of the Gaussians (FlyHuman section 3.1), and with respect
/// to all attributes of [`AnisotropicBuffers`].
///
/// - Complete where the image is smooth: position, depth, and the size and shape of the ellipse, through the lens and
///   the low-pass filter. Discontinuities contribute nothing: a splat that enters or leaves a pixel at alpha 1/255, a
///   pixel that is finished, the order by depth, back-face culling; at the clamp (alpha 0.99) alpha itself is constant.
///   On the built-in body the discontinuities are 4 to 6 % of the loss's true slope (`--bench backward`).
/// - No atomics: the sums of a tile go to their own slots and are added row by row. Equal input gives equal bytes on
///   one device.
/// - A tile without a gradient costs one pass over its pixels; a Gaussian without influence costs one pass over its
///   tiles.
/// - A Gaussian on more than 60,000 tiles, or behind the first 24,576 of a tile's list, receives no derivative there.
///   Non-finite sums are dropped.
#[derive(Debug)]
pub struct BackwardRasterizer {
    on: BackwardOn,
}

#[derive(Debug)]
enum BackwardOn {
    Device(Box<DeviceBackward>),
    Processor(ProcessorBackward),
}

impl BackwardRasterizer {
    /// Compiles the kernels for images of any [`Rasterizer::new`] with this context; buffers grow with the images.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let on = if gpu.is_on_processor() {
            BackwardOn::Processor(ProcessorBackward::default())
        } else {
            BackwardOn::Device(Box::new(DeviceBackward::new(gpu)?))
        };
        Ok(Self { on })
    }

    /// Records the derivatives of the image that `rasterizer` recorded last, with the same `gaussians` and `target`,
    /// and adds them to `out`. Within one submission the order is: a view, its loss, its derivative, the next view.
    /// Records nothing without a previous image, or for one without colour or of anisotropic Gaussians.
    ///
    /// # Errors
    /// [`BackwardError`]; nothing is recorded then.
    #[allow(clippy::too_many_arguments)]
    pub fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        rasterizer: &Rasterizer,
        gaussians: &GaussianBuffers,
        target: &RenderTarget,
        (incoming, carry): (&ImageGradients, Carry),
        out: &GaussianGradients,
    ) -> Result<(), BackwardError> {
        let to = GradientTarget::Isotropic { gaussians, carry, out };
        self.add(gpu, encoder, rasterizer, target, incoming, to)
    }

    /// Records the derivatives of an image of anisotropic Gaussians, as [`Self::encode`] does of isotropic ones.
    /// Records nothing for an image of isotropic Gaussians or of another order. Pixels carry only their dL/d colour: of
    /// [`ImageGradients::depth_carry`] only x is used, and nothing where [`ImageGradients::planes`] counts.
    ///
    /// Derivatives by planes reach centre, rotation and scales directly, and all attributes through the blending weights. Where
    /// a depth is limited to three standard deviations ([`RenderTarget::planes`]) it follows the deviation in place of the
    /// plane. Nothing flows through the limit of 0.9 of the depth, the least angle of a plane to the line of sight (0.6
    /// degrees), and the choice of the smallest axis and of its sign.
    ///
    /// # Errors
    /// [`BackwardError`]; nothing is recorded then.
    #[allow(clippy::too_many_arguments)]
    pub fn encode_anisotropic(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        rasterizer: &Rasterizer,
        gaussians: &AnisotropicBuffers,
        target: &RenderTarget,
        incoming: &ImageGradients,
        out: &AnisotropicGradients,
    ) -> Result<(), BackwardError> {
        self.add(gpu, encoder, rasterizer, target, incoming, GradientTarget::Anisotropic { gaussians, out })
    }

    fn add(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        rasterizer: &Rasterizer,
        target: &RenderTarget,
        incoming: &ImageGradients,
        to: GradientTarget<'_>,
    ) -> Result<(), BackwardError> {
        let Some(latest) = rasterizer.latest() else { return Ok(()) };
        if !latest.outputs.color || latest.gaussians == 0 || latest.order != to.order() {
            return Ok(());
        }
        let pixels = latest.size[0] as usize * latest.size[1] as usize;
        check("dL/d colour", incoming.color.len(), pixels)?;
        check("dL/d depth", incoming.depth_carry.len(), pixels)?;
        let rendered = target.color.len().min(target.depth.len());
        if let (Some(drawn), Some(by_planes), true) = (&target.planes, &incoming.planes, latest.outputs.planes) {
            check("the rendered planes", drawn.len(), pixels)?;
            check("dL/d planes", by_planes.len(), pixels)?;
        }
        check("the rendered image", rendered, pixels)?;
        to.check(&latest)?;
        match (&mut self.on, &rasterizer.on) {
            (BackwardOn::Device(device), RasterizerOn::Device(rasterizer)) => {
                device.encode(gpu, encoder, rasterizer, target, incoming, to)?;
            }
            (BackwardOn::Processor(processor), RasterizerOn::Processor(rasterizer)) => {
                processor.add(rasterizer, target, incoming, to);
            }
            _ => {}
        }
        Ok(())
    }
}
