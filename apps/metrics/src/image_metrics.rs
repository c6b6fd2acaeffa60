//! Metrics of two images inside a box around the person.
//!
//! PSNR and SSIM agree with OpenCV-based reference scripts: sRGB values in 0..=1, data range 1.

mod flip;
mod ssim;

use flyrig_types::Mask;

pub use flip::{FlipMap, flip};
pub use ssim::ssim;

/// Box in an image, pixels: `[x0, y0, x1, y1]`, ends excluded.
pub type PixelBox = [u32; 4];

/// Margin around the person in evaluations, pixels.
pub const BOX_MARGIN_PX: u32 = 10;

/// PSNR of equal images and largest reported PSNR, decibels.
pub const MAX_PSNR_DB: f64 = 99.0;

/// Reason why two images cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MetricError {
    /// Image that cannot be read.
    #[error("{0}")]
    Image(String),
    /// Images of different size.
    #[error("images of different size cannot be compared: {}x{} and {}x{}", first.0, first.1, second.0, second.1)]
    SizeMismatch {
        /// Width and height of the first image, pixels.
        first: (u32, u32),
        /// Width and height of the second image, pixels.
        second: (u32, u32),
    },
    /// Number of values that does not fit the size.
    #[error("a {width}x{height} image needs {needed} values but has {found}")]
    ByteCount {
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Expected number of values.
        needed: usize,
        /// Number of values.
        found: usize,
    },
    /// Box without pixels.
    #[error("the box {area:?} (x0, y0, x1, y1) holds no pixel of a {width}x{height} image")]
    EmptyBox {
        /// Box.
        area: PixelBox,
        /// Width of the image, pixels.
        width: u32,
        /// Height of the image, pixels.
        height: u32,
    },
    /// Mask without a person.
    #[error("the mask is empty: there is no person to put a box around")]
    EmptyMask,
    /// Pixel that is not finite.
    #[error("pixel ({x}, {y}) is not a finite number")]
    NotFinite {
        /// Column.
        x: u32,
        /// Row.
        y: u32,
    },
}

/// Image to compare: sRGB values in 0..=1.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    width: u32,
    height: u32,
    pixels: Vec<[f32; 3]>,
}

impl Picture {
    /// Creates an image from sRGB values, row by row; clamps them to 0..=1.
    ///
    /// # Errors
    /// [`MetricError::ByteCount`], [`MetricError::NotFinite`].
    pub fn new(width: u32, height: u32, mut pixels: Vec<[f32; 3]>) -> Result<Self, MetricError> {
        check_count(width, height, 1, pixels.len())?;
        if let Some(bad) = pixels.iter().position(|p| p.iter().any(|c| !c.is_finite())) {
            let (x, y) = (bad as u32 % width, bad as u32 / width);
            return Err(MetricError::NotFinite { x, y });
        }
        pixels.as_flattened_mut().iter_mut().for_each(|c| *c = c.clamp(0.0, 1.0));
        Ok(Self { width, height, pixels })
    }

    /// Creates an image from RGB bytes.
    ///
    /// # Errors
    /// [`MetricError::ByteCount`].
    pub fn from_rgb8(width: u32, height: u32, rgb: &[u8]) -> Result<Self, MetricError> {
        check_count(width, height, 3, rgb.len())?;
        let pixels = rgb.chunks_exact(3).map(|p| [unit(p[0]), unit(p[1]), unit(p[2])]).collect();
        Ok(Self { width, height, pixels })
    }

    /// Composites straight-alpha RGBA bytes on black, without rounding.
    ///
    /// # Errors
    /// [`MetricError::ByteCount`].
    pub fn on_black(width: u32, height: u32, rgba: &[u8]) -> Result<Self, MetricError> {
        check_count(width, height, 4, rgba.len())?;
        let pixels = rgba.chunks_exact(4).map(|p| [p[0], p[1], p[2]].map(|c| unit(c) * unit(p[3]))).collect();
        Ok(Self { width, height, pixels })
    }

    /// Composites straight-alpha RGBA bytes over a background, without rounding.
    ///
    /// # Errors
    /// [`MetricError::ByteCount`], [`MetricError::SizeMismatch`].
    pub fn over(width: u32, height: u32, rgba: &[u8], background: &Self) -> Result<Self, MetricError> {
        let mut picture = Self::on_black(width, height, rgba)?;
        picture.same_size(background)?;
        for ((pixel, from), behind) in picture.pixels.iter_mut().zip(rgba.chunks_exact(4)).zip(&background.pixels) {
            for (c, b) in pixel.iter_mut().zip(behind) {
                *c = (*c + (1.0 - unit(from[3])) * b).clamp(0.0, 1.0);
            }
        }
        Ok(picture)
    }

    /// Returns width and height, pixels.
    #[must_use]
    pub fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// Returns the sRGB values in 0..=1, row by row.
    #[must_use]
    pub fn pixels(&self) -> &[[f32; 3]] {
        &self.pixels
    }

    fn same_size(&self, other: &Self) -> Result<(), MetricError> {
        let (first, second) = (self.size(), other.size());
        if first == second { Ok(()) } else { Err(MetricError::SizeMismatch { first, second }) }
    }

    /// Returns the part inside a box, which is clipped at the image's border.
    fn crop(&self, area: PixelBox) -> Result<Self, MetricError> {
        let [x0, y0, x1, y1] = area;
        let (x1, y1) = (x1.min(self.width), y1.min(self.height));
        if x0 >= x1 || y0 >= y1 {
            return Err(MetricError::EmptyBox { area, width: self.width, height: self.height });
        }
        let row = |y: u32| y as usize * self.width as usize;
        let pixels = (y0..y1).flat_map(|y| &self.pixels[row(y) + x0 as usize..row(y) + x1 as usize]).copied().collect();
        Ok(Self { width: x1 - x0, height: y1 - y0, pixels })
    }

    /// Crops both images to the box.
    fn crop_both(&self, other: &Self, area: PixelBox) -> Result<(Self, Self), MetricError> {
        self.same_size(other)?;
        Ok((self.crop(area)?, other.crop(area)?))
    }
}

/// Returns the bounding box of a mask with a margin, clipped at the image's border.
///
/// # Errors
/// [`MetricError::EmptyMask`].
pub fn person_box(mask: &Mask, margin_px: u32) -> Result<PixelBox, MetricError> {
    let [x0, y0, x1, y1] = mask.bounding_box().ok_or(MetricError::EmptyMask)?;
    Ok([
        x0.saturating_sub(margin_px),
        y0.saturating_sub(margin_px),
        x1.saturating_add(margin_px).min(mask.width()),
        y1.saturating_add(margin_px).min(mask.height()),
    ])
}

/// Computes the peak signal-to-noise ratio inside the box, decibels; at most [`MAX_PSNR_DB`].
///
/// ```
/// use flyrig_metrics::{Picture, psnr, ssim};
///
/// let gray = |value| Picture::new(16, 16, vec![[value; 3]; 256]);
/// let (truth, ours) = (gray(0.5)?, gray(0.6)?);
/// assert!((psnr(&truth, &ours, [0, 0, 16, 16])? - 20.0).abs() < 1e-4);
/// assert!(ssim(&truth, &ours, [0, 0, 16, 16])? < 1.0);
/// # Ok::<(), flyrig_metrics::MetricError>(())
/// ```
///
/// # Errors
/// [`MetricError::SizeMismatch`], [`MetricError::EmptyBox`].
pub fn psnr(first: &Picture, second: &Picture, area: PixelBox) -> Result<f64, MetricError> {
    let (a, b) = first.crop_both(second, area)?;
    let (a, b) = (a.pixels.as_flattened(), b.pixels.as_flattened());
    let sum: f64 = a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2)).sum();
    let mean_square = sum / a.len() as f64;
    // log10(0) is minus infinity: equal images get the cap.
    Ok((-10.0 * mean_square.log10()).min(MAX_PSNR_DB))
}

/// Computes the intersection over union of the pixels with at least half coverage in the whole image; 0 if both masks are empty.
///
/// # Errors
/// [`MetricError::SizeMismatch`].
pub fn mask_iou(first: &Mask, second: &Mask) -> Result<f64, MetricError> {
    let (a, b) = ((first.width(), first.height()), (second.width(), second.height()));
    if a != b {
        return Err(MetricError::SizeMismatch { first: a, second: b });
    }
    let (mut both, mut either) = (0u64, 0u64);
    for (&x, &y) in first.coverage().iter().zip(second.coverage()) {
        both += u64::from(x >= 128 && y >= 128);
        either += u64::from(x >= 128 || y >= 128);
    }
    Ok(both as f64 / either.max(1) as f64)
}

fn unit(byte: u8) -> f32 {
    f32::from(byte) / 255.0
}

fn check_count(width: u32, height: u32, per_pixel: usize, found: usize) -> Result<(), MetricError> {
    let needed = width as usize * height as usize * per_pixel;
    if found == needed { Ok(()) } else { Err(MetricError::ByteCount { width, height, needed, found }) }
}

#[cfg(test)]
mod tests;
