//! Buffers that the renderer's stages pass to each other on the GPU.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};

use crate::schema::{self, GaussianElement};

/// Posed, coloured isotropic Gaussians of one instant; one element per Gaussian in every buffer, one buffer for each of
/// [`GAUSSIAN_ATTRIBUTES`](crate::GAUSSIAN_ATTRIBUTES).
#[derive(Debug)]
pub struct GaussianBuffers {
    /// World position, metres; w: standard deviation of the isotropic Gaussian, metres.
    pub center_scale: StorageBuffer<GaussianElement>,
    /// World unit normal of the surface; w: depth of the centre below the drawn surface, metres.
    pub normal: StorageBuffer<GaussianElement>,
    /// Linear RGB; w: opacity in 0..=1.
    pub color: StorageBuffer<GaussianElement>,
    /// Canonical position, metres; w unused. Constant over time.
    pub canonical: StorageBuffer<GaussianElement>,
}

impl GaussianBuffers {
    /// Allocates buffers for `count` Gaussians, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(gpu: &GpuContext, count: usize) -> Result<Self, GpuError> {
        Ok(Self {
            center_scale: schema::CENTER_SCALE.zeroed(gpu, count)?,
            normal: schema::NORMAL.zeroed(gpu, count)?,
            color: schema::COLOR.zeroed(gpu, count)?,
            canonical: schema::CANONICAL.zeroed(gpu, count)?,
        })
    }

    /// Creates another pose of the same person: own centres and normals, shared colours and canonical positions.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn posed_again(&self, gpu: &GpuContext) -> Result<Self, GpuError> {
        Ok(Self {
            center_scale: schema::CENTER_SCALE.zeroed(gpu, self.count())?,
            normal: schema::NORMAL.zeroed(gpu, self.count())?,
            color: self.color.clone(),
            canonical: self.canonical.clone(),
        })
    }

    /// Records the copy of all Gaussians into `other`, from its element `first` on; Gaussians beyond its end are
    /// dropped.
    pub fn encode_copy(&self, encoder: &mut wgpu::CommandEncoder, other: &Self, first: usize) {
        for (from, to) in self.attributes().into_iter().zip(other.attributes()) {
            from.encode_copy(encoder, to, first);
        }
    }

    /// Returns the buffers in the order of [`GAUSSIAN_ATTRIBUTES`](crate::GAUSSIAN_ATTRIBUTES).
    #[must_use]
    pub fn attributes(&self) -> [&StorageBuffer<GaussianElement>; 4] {
        [&self.center_scale, &self.normal, &self.color, &self.canonical]
    }

    /// Returns the number of Gaussians.
    #[must_use]
    pub fn count(&self) -> usize {
        self.center_scale.len()
    }
}

/// Images of one view, row by row, one element per pixel.
#[derive(Debug)]
pub struct RenderTarget {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Linear RGB times alpha; w: alpha (coverage).
    pub color: StorageBuffer<[f32; 4]>,
    /// Mean camera-space z of the visible Gaussians, metres; 0 where alpha is 0.
    pub depth: StorageBuffer<f32>,
    /// Canonical position times alpha, metres; w: alpha.
    pub canonical: StorageBuffer<[f32; 4]>,
    /// Surface of anisotropic Gaussians, `None` until [`Self::with_planes`]; alpha is that of [`Self::color`], and
    /// [`PixelPlane`](crate::PixelPlane) divides by it. Each Gaussian counts as the plane through its centre perpendicular
    /// to the axis of its smallest scale (the first of equal ones).
    ///
    /// - xyz: sum of blending weight times unit normal, in camera axes, towards the camera.
    /// - w: sum of blending weight times the camera-space z where the pixel's ray meets the plane, metres. Rays are
    ///   linearised at the Gaussian's centre, as the projection of its ellipse is: exact for lenses without distortion.
    ///   The depth stays within three standard deviations of the Gaussian along z, and within 0.9 of its depth, about
    ///   the depth of its centre. No point of the plane within three standard deviations of the centre is beyond.
    ///
    /// A plane closer to edge-on than 0.6 degrees has the depths of one at this angle.
    pub planes: Option<StorageBuffer<[f32; 4]>>,
}

impl RenderTarget {
    /// Allocates images of `width` x `height` pixels, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, width: u32, height: u32) -> Result<Self, GpuError> {
        let pixels = width as usize * height as usize;
        Self::with_room(gpu, [width, height], pixels)
    }

    /// Allocates a target for colour alone: depth and canonical positions are empty and must not be among the
    /// [`Outputs`](crate::Outputs).
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn of_color(gpu: &GpuContext, width: u32, height: u32) -> Result<Self, GpuError> {
        Self::with_room(gpu, [width, height], 0)
    }

    /// Adds the image of normals and plane depths, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn with_planes(self, gpu: &GpuContext) -> Result<Self, GpuError> {
        let planes = StorageBuffer::zeroed(gpu, "rendered planes", self.color.len())?;
        Ok(Self { planes: Some(planes), ..self })
    }

    /// Returns the number of pixels of the largest target that the adapter can bind.
    #[must_use]
    pub fn max_pixels(gpu: &GpuContext) -> u64 {
        let limits = gpu.device.limits();
        limits.max_buffer_size.min(limits.max_storage_buffer_binding_size) / size_of::<[f32; 4]>() as u64
    }

    fn with_room(gpu: &GpuContext, [width, height]: [u32; 2], others: usize) -> Result<Self, GpuError> {
        let pixels = width as usize * height as usize;
        Ok(Self {
            width,
            height,
            color: StorageBuffer::zeroed(gpu, "rendered colour", pixels)?,
            depth: StorageBuffer::zeroed(gpu, "rendered depth", others)?,
            canonical: StorageBuffer::zeroed(gpu, "rendered canonical positions", others)?,
            planes: None,
        })
    }
}
