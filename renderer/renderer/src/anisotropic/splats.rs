//! Anisotropic Gaussians in memory.

use flyrig_gpu::{GpuContext, GpuError, read_all};

use crate::anisotropic::buffers::AnisotropicBuffers;
use crate::anisotropic::order::HarmonicOrder;
use crate::schema::GaussianElement;

/// Anisotropic Gaussians in memory, element for element as in [`AnisotropicBuffers`].
#[derive(Debug, Clone, PartialEq)]
pub struct AnisotropicSplats {
    /// World position, metres; w unused.
    pub center: Vec<GaussianElement>,
    /// Standard deviations along the Gaussian's own axes, metres; w: opacity in 0..=1.
    pub scale_opacity: Vec<GaussianElement>,
    /// Quaternion x, y, z, w of any length: world from the Gaussian's axes.
    pub rotation: Vec<GaussianElement>,
    /// Coefficients of linear RGB; w unused. Those of one Gaussian are consecutive.
    pub harmonics: Vec<GaussianElement>,
    /// Harmonic order of the colours.
    pub order: HarmonicOrder,
}

impl AnisotropicSplats {
    /// Returns an empty list.
    #[must_use]
    pub fn empty(order: HarmonicOrder) -> Self {
        Self { center: vec![], scale_opacity: vec![], rotation: vec![], harmonics: vec![], order }
    }

    /// Returns the number of Gaussians that have all attributes.
    #[must_use]
    pub fn count(&self) -> usize {
        let rows = self.center.len().min(self.scale_opacity.len()).min(self.rotation.len());
        rows.min(self.harmonics.len() / self.order.coefficients())
    }

    /// Waits for the GPU and reads the Gaussians back.
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn read(gpu: &GpuContext, buffers: &AnisotropicBuffers) -> Result<Self, GpuError> {
        let mut attributes = read_all(gpu, &buffers.attributes())?.into_iter();
        let mut next = || attributes.next().unwrap_or_default();
        let (center, scale_opacity, rotation, harmonics) = (next(), next(), next(), next());
        Ok(Self { center, scale_opacity, rotation, harmonics, order: buffers.order() })
    }

    /// Uploads the Gaussians into new buffers.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn upload(&self, gpu: &GpuContext) -> Result<AnisotropicBuffers, GpuError> {
        let buffers = AnisotropicBuffers::zeroed(gpu, self.count(), self.order)?;
        let attributes = [&self.center, &self.scale_opacity, &self.rotation, &self.harmonics];
        buffers.attributes().into_iter().zip(attributes).for_each(|(buffer, content)| buffer.write(gpu, content));
        Ok(buffers)
    }
}
