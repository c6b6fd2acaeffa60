//! Derivatives with respect to images (input of the backward rasteriser) and to Gaussians (its output).

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use wgpu::CommandEncoder;

/// Derivatives of a loss L with respect to the images of one view, row by row, one element per pixel. Pixels with a
/// non-finite number and pixels without any Gaussian count as zero.
#[derive(Debug)]
pub struct ImageGradients {
    /// dL/d of the premultiplied linear red, green, blue, and of alpha ([`crate::RenderTarget::color`]).
    pub color: StorageBuffer<[f32; 4]>,
    /// x: dL/d [`crate::RenderTarget::depth`], per metre (ignored where the forward pass wrote no depth); yzw: three
    /// numbers that the pixel passes to its Gaussians, see [`Carry`].
    pub depth_carry: StorageBuffer<[f32; 4]>,
    /// dL/d [`crate::RenderTarget::planes`]: normal sums, depth sum (per metre). `None`, until [`Self::with_planes`], and
    /// an image that was drawn without planes contribute nothing. Where they count, the x of [`Self::depth_carry`] does
    /// not: a view has derivatives by the depth of the planes or by that of the centres.
    pub planes: Option<StorageBuffer<[f32; 4]>>,
}

impl ImageGradients {
    /// Allocates derivatives of images of `width` x `height` pixels, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(gpu: &GpuContext, width: u32, height: u32) -> Result<Self, GpuError> {
        let pixels = width as usize * height as usize;
        Ok(Self {
            color: StorageBuffer::zeroed(gpu, "dL/d colour", pixels)?,
            depth_carry: StorageBuffer::zeroed(gpu, "dL/d depth", pixels)?,
            planes: None,
        })
    }

    /// Adds derivatives with respect to normals and plane depths, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn with_planes(self, gpu: &GpuContext) -> Result<Self, GpuError> {
        let planes = StorageBuffer::zeroed(gpu, "dL/d planes", self.color.len())?;
        Ok(Self { planes: Some(planes), ..self })
    }
}

/// Treatment of the numbers that a pixel passes to its Gaussians, weighted by their blending weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Carry {
    /// Sum. With dL/d (red, green, blue) as the numbers, the sums are dL/d the Gaussian's colour.
    Sum,
    /// Lift to the world of the sum of 2x2 matrices C in the image, whose entries (xx, xy, yy) per square pixel the
    /// numbers are: `J^T C J` with J = d pixel / d centre. With C from the image's own gradient this is the
    /// Gauss-Newton matrix of the pixels under the assumption that everything visible in a pixel moves together (Lucas
    /// and Kanade 1981).
    Lift,
}

/// Derivatives with respect to the Gaussians, summed over the views since [`Self::clear`].
#[derive(Debug)]
pub struct GaussianGradients {
    /// xyz: dL/d world centre, per metre; w: blending weight in the pixels that had a gradient (0: no influence).
    pub center: StorageBuffer<[f32; 4]>,
    /// Two elements per Gaussian. [`Carry::Sum`]: the three numbers, the rest 0. [`Carry::Lift`]: entries xx, xy, xz,
    /// yy | yz, zz, 0, 0 of the symmetric matrix, per square metre.
    pub carried: StorageBuffer<[f32; 4]>,
}

impl GaussianGradients {
    /// Allocates derivatives of `count` Gaussians, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(gpu: &GpuContext, count: usize) -> Result<Self, GpuError> {
        Ok(Self {
            center: StorageBuffer::zeroed(gpu, "dL/d centres", count)?,
            carried: StorageBuffer::zeroed(gpu, "carried sums", 2 * count)?,
        })
    }

    /// Records the clearing of all buffers.
    pub fn clear(&self, encoder: &mut CommandEncoder) {
        self.center.encode_clear(encoder);
        self.carried.encode_clear(encoder);
    }
}
