//! Backward splat rasteriser: what a change of the Gaussians does to a loss on the images.

use flyrig_gpu::{GpuContext, GpuError};
use wgpu::CommandEncoder;

use crate::processor::ProcessorBackward;
use crate::raster::RasterizerOn;
use crate::raster_backward_device::DeviceBackward;
use crate::raster_settings::Latest;
use crate::{
    AnisotropicBuffers, AnisotropicGradients, Carry, GaussianBuffers, GaussianGradients, HarmonicOrder, ImageGradients,
    Rasterizer, RenderTarget,
};

/// Why there is no derivative.
#[derive(Debug, thiserror::Error)]
pub enum BackwardError {
    /// Buffers must grow and cannot.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A buffer does not belong to the image that was drawn last.
    #[error("{what}: {found} elements where the image drawn last needs {needed}; make it for that image")]
    Buffer {
        /// Which buffer.
        what: &'static str,
        /// Its elements.
        found: usize,
        /// Elements needed.
        needed: usize,
    },
}

/// Derivatives of [`Rasterizer`]'s images with respect to the centres of the Gaussians (FlyHuman section 3.1), and with respect
/// to all attributes of [`AnisotropicBuffers`].
///
/// - Complete where the image is smooth: place, depth, and the size and shape of the ellipse, through the lens and
///   the low-pass filter. What jumps passes nothing on: a splat that enters or leaves a pixel at alpha 1/255, a pixel
///   that is finished, the order by depth, back-face culling; at the clamp (alpha 0.99) alpha itself is constant. On
///   the built-in body the jumps are 4 to 6 % of the loss's true slope (`bench_backward`).
/// - No atomics: the sums of a tile go to a slot of their own and are added up row by row. Equal input gives equal
///   bytes on one device.
/// - A tile without a gradient costs the look at its pixels; a Gaussian without a pixel that matters costs nothing
///   but a look at its tiles.
/// - A Gaussian on more than 60,000 tiles, or behind the first 24,576 of a tile's list, gets nothing there. Sums that
///   are not finite are left out.
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

    /// Records the derivatives of the image that `rasterizer` recorded last, with the same `gaussians` and
    /// `target`, and adds them to `out`. Views of one submission: encode a view, its loss, its derivative, the next
    /// view. Without an image before, or with one without colour or of anisotropic Gaussians, nothing is recorded.
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
        let onto = Onto::Isotropic { gaussians, carry, out };
        self.add(gpu, encoder, rasterizer, target, incoming, onto)
    }

    /// As [`Self::encode`], of an image of anisotropic Gaussians; nothing is recorded for one of isotropic ones or of another
    /// order. Pixels carry nothing but their dL/d colour: [`ImageGradients::depth_carry`] counts in x alone.
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
        self.add(gpu, encoder, rasterizer, target, incoming, Onto::Anisotropic { gaussians, out })
    }

    fn add(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        rasterizer: &Rasterizer,
        target: &RenderTarget,
        incoming: &ImageGradients,
        onto: Onto<'_>,
    ) -> Result<(), BackwardError> {
        let Some(latest) = rasterizer.latest() else { return Ok(()) };
        if !latest.outputs.color || latest.gaussians == 0 || latest.order != onto.order() {
            return Ok(());
        }
        let pixels = latest.size[0] as usize * latest.size[1] as usize;
        check("dL/d colour", incoming.color.len(), pixels)?;
        check("dL/d depth", incoming.depth_carry.len(), pixels)?;
        check("the drawn image", target.color.len().min(target.depth.len()), pixels)?;
        onto.check(&latest)?;
        match (&mut self.on, &rasterizer.on) {
            (BackwardOn::Device(device), RasterizerOn::Device(rasterizer)) => {
                device.encode(gpu, encoder, rasterizer, target, incoming, onto)?;
            }
            (BackwardOn::Processor(processor), RasterizerOn::Processor(rasterizer)) => {
                processor.add(rasterizer, target, incoming, onto);
            }
            _ => {}
        }
        Ok(())
    }
}

/// Gaussians that derivatives are carried to, and where these are added.
#[derive(Clone, Copy)]
pub(crate) enum Onto<'a> {
    Isotropic { gaussians: &'a GaussianBuffers, carry: Carry, out: &'a GaussianGradients },
    Anisotropic { gaussians: &'a AnisotropicBuffers, out: &'a AnisotropicGradients },
}

impl Onto<'_> {
    /// Order of the colours; None for isotropic Gaussians.
    fn order(&self) -> Option<HarmonicOrder> {
        match self {
            Self::Isotropic { .. } => None,
            Self::Anisotropic { gaussians, .. } => Some(gaussians.order()),
        }
    }

    fn check(&self, latest: &Latest) -> Result<(), BackwardError> {
        let (count, room) = match self {
            Self::Isotropic { gaussians, out, .. } => (gaussians.count(), out.center.len().min(out.carried.len() / 2)),
            Self::Anisotropic { gaussians, out } => {
                let rows = out.center.len().min(out.scale_opacity.len()).min(out.rotation.len());
                (gaussians.count(), rows.min(out.harmonics.len() / gaussians.order().coefficients()))
            }
        };
        check("the Gaussians", count, latest.gaussians)?;
        check("dL/d Gaussians", room, latest.gaussians)
    }
}

fn check(what: &'static str, found: usize, needed: usize) -> Result<(), BackwardError> {
    if found >= needed { Ok(()) } else { Err(BackwardError::Buffer { what, found, needed }) }
}
