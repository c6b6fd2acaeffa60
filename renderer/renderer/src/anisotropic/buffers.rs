//! Buffers of anisotropic Gaussians and of derivatives with respect to all their attributes.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use wgpu::CommandEncoder;

use crate::anisotropic::order::HarmonicOrder;
use crate::buffers::GaussianBuffers;
use crate::schema::{self, GaussianElement};

/// Gaussians with three scales, a rotation, an opacity, and a colour that depends on the direction; a buffer for each of
/// [`ANISOTROPIC_ATTRIBUTES`](crate::ANISOTROPIC_ATTRIBUTES).
///
/// The covariance is `R diag(scale²) R^T`. The colour is the sum of the real spherical harmonics of the direction from
/// the camera to the centre, with the signs of the 3D Gaussian Splatting reference code and without its offset of 0.5,
/// times their coefficients; negative values become 0. A Gaussian with a non-finite number, a scale or opacity not
/// above 0, or a quaternion whose length is not within 1e-15 to 1e15 is not drawn.
#[derive(Debug)]
pub struct AnisotropicBuffers {
    /// World position, metres; w unused.
    pub center: StorageBuffer<GaussianElement>,
    /// Standard deviations along the Gaussian's own axes, metres; w: opacity in 0..=1.
    pub scale_opacity: StorageBuffer<GaussianElement>,
    /// Quaternion x, y, z, w of any length: world from the Gaussian's axes.
    pub rotation: StorageBuffer<GaussianElement>,
    /// Coefficients of linear RGB; w unused. Those of one Gaussian are consecutive.
    pub harmonics: StorageBuffer<GaussianElement>,
    /// Surface that the Gaussians belong to; `None` for free ones.
    pub surface: Option<SurfaceBuffers>,
    order: HarmonicOrder,
}

/// Surface that anisotropic Gaussians belong to, one element per Gaussian. Gaussians whose surface faces away from the camera
/// ([`AWAY_COSINE`](crate::AWAY_COSINE)) are culled, and canonical positions can be rendered.
#[derive(Debug)]
pub struct SurfaceBuffers {
    /// World unit normal of the surface; w unused.
    pub normal: StorageBuffer<GaussianElement>,
    /// Canonical position, metres, finite; w unused.
    pub canonical: StorageBuffer<GaussianElement>,
}

impl AnisotropicBuffers {
    /// Allocates buffers for `count` Gaussians, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(gpu: &GpuContext, count: usize, order: HarmonicOrder) -> Result<Self, GpuError> {
        Ok(Self {
            center: schema::CENTER.zeroed(gpu, count)?,
            scale_opacity: schema::SCALE_OPACITY.zeroed(gpu, count)?,
            rotation: schema::ROTATION.zeroed(gpu, count)?,
            harmonics: schema::HARMONICS.zeroed(gpu, count * order.coefficients())?,
            surface: None,
            order,
        })
    }

    /// Adds a surface, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn with_surface(self, gpu: &GpuContext) -> Result<Self, GpuError> {
        let (normal, canonical) =
            (schema::NORMAL.zeroed(gpu, self.count())?, schema::CANONICAL.zeroed(gpu, self.count())?);
        Ok(Self { surface: Some(SurfaceBuffers { normal, canonical }), ..self })
    }

    /// Returns the number of Gaussians.
    #[must_use]
    pub fn count(&self) -> usize {
        self.center.len()
    }

    /// Returns the harmonic order of the colours.
    #[must_use]
    pub fn order(&self) -> HarmonicOrder {
        self.order
    }

    /// Returns the buffers in the order of [`ANISOTROPIC_ATTRIBUTES`](crate::ANISOTROPIC_ATTRIBUTES).
    #[must_use]
    pub fn attributes(&self) -> [&StorageBuffer<GaussianElement>; 4] {
        [&self.center, &self.scale_opacity, &self.rotation, &self.harmonics]
    }
}

/// Derivatives of a loss L with respect to [`AnisotropicBuffers`], element for element as there, summed over the views since
/// [`Self::clear`].
#[derive(Debug)]
pub struct AnisotropicGradients {
    /// dL/d world centre, per metre; w: blending weight in the pixels that had a gradient (0: no influence).
    pub center: StorageBuffer<GaussianElement>,
    /// dL/d scales, per metre; w: dL/d opacity, 0 where it is above 1.
    pub scale_opacity: StorageBuffer<GaussianElement>,
    /// dL/d stored quaternion. It is orthogonal to the quaternion, whose length has no influence.
    pub rotation: StorageBuffer<GaussianElement>,
    /// dL/d coefficients, 0 where the colour is clamped at 0; w: 0.
    pub harmonics: StorageBuffer<GaussianElement>,
}

impl AnisotropicGradients {
    /// Allocates derivatives of `count` Gaussians, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(gpu: &GpuContext, count: usize, order: HarmonicOrder) -> Result<Self, GpuError> {
        let AnisotropicBuffers { center, scale_opacity, rotation, harmonics, .. } =
            AnisotropicBuffers::zeroed(gpu, count, order)?;
        Ok(Self { center, scale_opacity, rotation, harmonics })
    }

    /// Records the clearing of all buffers.
    pub fn clear(&self, encoder: &mut CommandEncoder) {
        self.attributes().into_iter().for_each(|buffer| buffer.encode_clear(encoder));
    }

    /// Returns the buffers in the order of [`ANISOTROPIC_ATTRIBUTES`](crate::ANISOTROPIC_ATTRIBUTES).
    #[must_use]
    pub fn attributes(&self) -> [&StorageBuffer<GaussianElement>; 4] {
        [&self.center, &self.scale_opacity, &self.rotation, &self.harmonics]
    }
}

/// Gaussians that a rasteriser draws.
#[derive(Debug, Clone, Copy)]
pub enum Gaussians<'a> {
    /// Surface Gaussians of one scale and one colour each.
    Isotropic(&'a GaussianBuffers),
    /// Gaussians of three scales and colours by direction. Without a [`SurfaceBuffers`] none is culled, and
    /// [`RenderTarget::canonical`](crate::RenderTarget::canonical) keeps its content.
    Anisotropic(&'a AnisotropicBuffers),
}

impl Gaussians<'_> {
    /// Returns the number of Gaussians.
    #[must_use]
    pub fn count(&self) -> usize {
        match self {
            Self::Isotropic(gaussians) => gaussians.count(),
            Self::Anisotropic(gaussians) => gaussians.count(),
        }
    }

    /// Returns the normals and canonical positions of the surface; `None` without one.
    pub(crate) fn surface(&self) -> Option<(&StorageBuffer<GaussianElement>, &StorageBuffer<GaussianElement>)> {
        match self {
            Self::Isotropic(gaussians) => Some((&gaussians.normal, &gaussians.canonical)),
            Self::Anisotropic(gaussians) => {
                gaussians.surface.as_ref().map(|surface| (&surface.normal, &surface.canonical))
            }
        }
    }

    /// Returns the harmonic order of the colours; `None` for isotropic Gaussians.
    pub(crate) fn order(&self) -> Option<HarmonicOrder> {
        match self {
            Self::Isotropic(_) => None,
            Self::Anisotropic(gaussians) => Some(gaussians.order()),
        }
    }
}

impl<'a> From<&'a GaussianBuffers> for Gaussians<'a> {
    fn from(gaussians: &'a GaussianBuffers) -> Self {
        Self::Isotropic(gaussians)
    }
}

impl<'a> From<&'a AnisotropicBuffers> for Gaussians<'a> {
    fn from(gaussians: &'a AnisotropicBuffers) -> Self {
        Self::Anisotropic(gaussians)
    }
}
