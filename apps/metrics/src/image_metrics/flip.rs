//! ꟻLIP (Andersson et al. 2020, low dynamic range), computed by NVIDIA's code.

use nv_flip::{DEFAULT_PIXELS_PER_DEGREE, FlipImageFloat, FlipImageRgb8, FlipPool, magma_lut};

use super::{MetricError, Picture, PixelBox};

/// Per-pixel ꟻLIP error of the box.
#[derive(Debug, Clone, PartialEq)]
pub struct FlipMap {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Error from 0 (equal) to 1, row by row.
    pub error: Vec<f32>,
    /// Mean error, the single number of ꟻLIP.
    pub mean: f64,
}

impl FlipMap {
    /// Returns the error as RGB bytes in the perceptually uniform magma colours: black for equal pixels, bright for large errors.
    #[must_use]
    pub fn to_rgb8(&self) -> Vec<u8> {
        FlipImageFloat::with_data(self.width, self.height, &self.error).apply_color_lut(&magma_lut()).to_vec()
    }
}

/// Computes ꟻLIP between `truth` and `ours` inside the box, at 67 pixels per degree (the default of ꟻLIP); images are rounded
/// to 8 bits.
///
/// # Errors
/// [`MetricError::SizeMismatch`], [`MetricError::EmptyBox`].
pub fn flip(truth: &Picture, ours: &Picture, area: PixelBox) -> Result<FlipMap, MetricError> {
    let (a, b) = truth.crop_both(ours, area)?;
    let (width, height) = (a.width, a.height);
    let image = |p: &Picture| {
        let bytes: Vec<u8> = p.pixels.as_flattened().iter().map(|c| (c * 255.0 + 0.5) as u8).collect();
        FlipImageRgb8::with_data(width, height, &bytes)
    };
    let map = nv_flip::flip(image(&a), image(&b), DEFAULT_PIXELS_PER_DEGREE);
    let mean = f64::from(FlipPool::from_image(&map).mean());
    Ok(FlipMap { width, height, error: map.to_vec(), mean })
}
