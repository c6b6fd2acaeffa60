//! Crops of the input images to the person's box, and their fine detail.

use flyrig_renderer::AppearanceSettings;
use rayon::prelude::*;

use crate::{StfaError, taps::FeatureMaps};

/// Channels of fine and of coarse detail.
pub const DETAIL: usize = 6;

/// Margin around the person, pixels.
const MARGIN_PX: usize = 8;
/// Divisor of the sides of crops: the encoder halves twice.
const MULTIPLE: usize = 4;
/// Standard deviations of the blurs that separate fine and coarse detail, pixels.
pub(crate) const BLURS_PX: [f32; 2] = [1.0, 3.0];

/// Input image.
#[derive(Debug, Clone, Copy)]
pub struct ViewImage<'a> {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// sRGB rows without padding; a: mask coverage, 255 on the person.
    pub rgba: &'a [u8],
}

/// Crops of all images, of one size.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Crops {
    /// Number of images.
    pub views: usize,
    /// Pixels, a multiple of four.
    pub width: usize,
    /// Pixels, a multiple of four.
    pub height: usize,
    /// Position of the crop's first pixel in each image.
    pub origins: Vec<[u32; 2]>,
    /// sRGB and mask coverage, view by view, row by row.
    pub rgba: Vec<u8>,
}

impl Crops {
    /// Crops the images to the boxes of their masks, enlarged to a common size. An image without a person gives an
    /// empty crop.
    ///
    /// # Errors
    /// [`StfaError::Frame`] where an image's bytes do not fit its size.
    pub fn cut(pictures: &[ViewImage<'_>]) -> Result<Self, StfaError> {
        let mut boxes = Vec::with_capacity(pictures.len());
        for (view, picture) in pictures.iter().enumerate() {
            let (width, height) = (picture.width as usize, picture.height as usize);
            if width == 0 || picture.rgba.len() != width * height * 4 {
                let bytes = picture.rgba.len();
                return Err(StfaError::Frame(format!("view {view}: {bytes} bytes for {width}x{height} pixels")));
            }
            boxes.push(person_box(picture.rgba, width, height));
        }
        let side = |of: fn(&[usize; 4]) -> usize| boxes.iter().map(of).max().unwrap_or(0).next_multiple_of(MULTIPLE);
        let (width, height) = (side(|b| b[2] - b[0]), side(|b| b[3] - b[1]));
        let mut rgba = vec![0; pictures.len() * width * height * 4];
        for ((picture, area), crop) in
            pictures.iter().zip(&boxes).zip(rgba.chunks_exact_mut((width * height * 4).max(1)))
        {
            let stride = picture.width as usize * 4;
            let columns = width.min(picture.width as usize - area[0]) * 4;
            let rows = picture.rgba.chunks_exact(stride).skip(area[1]);
            for (to, from) in crop.chunks_exact_mut(width * 4).zip(rows) {
                to[..columns].copy_from_slice(&from[area[0] * 4..area[0] * 4 + columns]);
            }
        }
        let origins = boxes.iter().map(|area| [area[0] as u32, area[1] as u32]).collect();
        Ok(Self { views: pictures.len(), width, height, origins, rgba })
    }

    /// Returns the bytes of one view.
    #[must_use]
    pub fn view(&self, view: usize) -> &[u8] {
        let bytes = self.width * self.height * 4;
        self.rgba.get(view * bytes..(view + 1) * bytes).unwrap_or_default()
    }

    /// Returns the encoder's input of a view, channels first: sRGB 0..1 on the person, black elsewhere, and the weight
    /// of the mask.
    #[must_use]
    pub fn planes(&self, view: usize, settings: &AppearanceSettings) -> Vec<f32> {
        let pixels = self.width * self.height;
        let mut out = vec![0.0; 4 * pixels];
        for (i, pixel) in self.view(view).chunks_exact(4).enumerate() {
            for (c, value) in believed(pixel, settings).into_iter().enumerate() {
                out[c * pixels + i] = value;
            }
        }
        out
    }

    /// Returns sRGB values times mask weight, and the weight.
    #[must_use]
    pub fn colors(&self, settings: &AppearanceSettings) -> FeatureMaps {
        let values = self.rgba.par_chunks_exact(4).flat_map_iter(|pixel| believed(pixel, settings)).collect();
        FeatureMaps { width: self.width, height: self.height, channels: 4, stride: 1, values }
    }

    /// Computes the detail that two blurs remove from the sRGB values, excluding the background.
    #[must_use]
    pub fn detail(&self, settings: &AppearanceSettings) -> FeatureMaps {
        let pixels = self.width * self.height;
        let mut values = vec![0.0; self.views * pixels * DETAIL];
        values.par_chunks_mut((pixels * DETAIL).max(1)).zip(self.rgba.par_chunks((pixels * 4).max(1))).for_each(
            |(out, crop)| {
                let sharp: Vec<[f32; 4]> = crop.chunks_exact(4).map(|pixel| believed(pixel, settings)).collect();
                let [fine, coarse] = BLURS_PX.map(|sigma| blurred(&sharp, self.width, sigma));
                let mean = |p: [f32; 4], c: usize| if p[3] > 1e-3 { p[c] / p[3] } else { 0.0 };
                for (i, out) in out.chunks_exact_mut(DETAIL).enumerate() {
                    if sharp[i][3] > 0.0 {
                        for c in 0..3 {
                            out[c] = mean(sharp[i], c) - mean(fine[i], c);
                            out[3 + c] = mean(fine[i], c) - mean(coarse[i], c);
                        }
                    }
                }
            },
        );
        FeatureMaps { width: self.width, height: self.height, channels: DETAIL, stride: 1, values }
    }
}

/// Returns the weight of a pixel of this coverage, as in direct appearance.
fn belief(coverage: u8, settings: &AppearanceSettings) -> f32 {
    ((f32::from(coverage) / 255.0 - settings.min_mask) / (1.0 - settings.min_mask)).clamp(0.0, 1.0)
}

/// Returns sRGB 0..1 times mask weight, and the weight.
fn believed(pixel: &[u8], settings: &AppearanceSettings) -> [f32; 4] {
    let belief = belief(pixel[3], settings);
    let color = |c: usize| belief * f32::from(pixel[c]) / 255.0;
    [color(0), color(1), color(2), belief]
}

/// Returns left, top, right, bottom (excluded) of the mask with a margin; empty without a person.
fn person_box(rgba: &[u8], width: usize, height: usize) -> [usize; 4] {
    let (mut left, mut top, mut right, mut bottom) = (width, height, 0, 0);
    for (y, row) in rgba.chunks_exact(width * 4).enumerate() {
        let covered = |pixel: &&[u8]| pixel[3] > 0;
        let mut pixels = row.chunks_exact(4);
        if let Some(first) = pixels.position(|pixel| covered(&pixel)) {
            let last = row.chunks_exact(4).rposition(|pixel| covered(&pixel)).unwrap_or(first);
            (left, right) = (left.min(first), right.max(last + 1));
            (top, bottom) = (top.min(y), y + 1);
        }
    }
    if left >= right {
        return [0; 4];
    }
    [
        left.saturating_sub(MARGIN_PX),
        top.saturating_sub(MARGIN_PX),
        (right + MARGIN_PX).min(width),
        (bottom + MARGIN_PX).min(height),
    ]
}

/// Returns the blur's kernel, an odd number of weights that sum to 1.
pub(crate) fn blur_kernel(sigma: f32) -> Vec<f32> {
    let radius = (2.5 * sigma).ceil() as isize;
    let kernel: Vec<f32> = (-radius..=radius).map(|d| (-0.5 * (d as f32 / sigma).powi(2)).exp()).collect();
    let total: f32 = kernel.iter().sum();
    kernel.into_iter().map(|weight| weight / total).collect()
}

/// Applies a separable Gaussian blur, zero outside.
fn blurred(pixels: &[[f32; 4]], width: usize, sigma: f32) -> Vec<[f32; 4]> {
    let kernel = blur_kernel(sigma);
    let radius = (kernel.len() / 2) as isize;
    let add = |to: &mut [[f32; 4]], from: &[[f32; 4]], weight: f32| {
        for (to, from) in to.as_flattened_mut().iter_mut().zip(from.as_flattened()) {
            *to += weight * from;
        }
    };
    let shares = |d: isize| kernel[(d + radius) as usize];
    let width = width.max(1);
    let mut rows = vec![[0.0; 4]; pixels.len()];
    for (to, from) in rows.chunks_exact_mut(width).zip(pixels.chunks_exact(width)) {
        for d in -radius..=radius {
            let away = d.unsigned_abs().min(width);
            let (first_to, first_from) = if d < 0 { (away, 0) } else { (0, away) };
            add(&mut to[first_to..width - first_from], &from[first_from..width - first_to], shares(d));
        }
    }
    let height = pixels.len() / width;
    let mut out = vec![[0.0; 4]; pixels.len()];
    for (y, to) in out.chunks_exact_mut(width).enumerate() {
        for d in -radius..=radius {
            if let Some(from) = y.checked_add_signed(d).filter(|&from| from < height) {
                add(to, &rows[from * width..(from + 1) * width], shares(d));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: u32, height: u32, person: impl Fn(u32, u32) -> Option<[u8; 3]>) -> Vec<u8> {
        (0..width * height)
            .flat_map(|i| match person(i % width, i / width) {
                Some([r, g, b]) => [r, g, b, 255],
                None => [255, 0, 255, 0],
            })
            .collect()
    }

    #[test]
    fn boxes_hold_the_person_and_keep_their_place() {
        let one =
            picture(60, 50, |x, y| ((20..23).contains(&x) && (30..44).contains(&y)).then_some([x as u8, y as u8, 9]));
        let nobody = picture(40, 30, |_, _| None);
        let whole = picture(33, 21, |x, y| Some([x as u8, y as u8, 1]));
        let pictures = [(60, 50, &one), (40, 30, &nobody), (33, 21, &whole)].map(|(width, height, rgba)| ViewImage {
            width,
            height,
            rgba,
        });
        let crops = Crops::cut(&pictures).unwrap();
        assert_eq!((crops.width, crops.height), (36, 28));
        assert_eq!(crops.origins, [[12, 22], [0, 0], [0, 0]]);
        let at = |view: usize, x: usize, y: usize| &crops.rgba[((view * 28 + y) * 36 + x) * 4..][..4];
        assert_eq!(at(0, 20 - 12, 30 - 22), [20, 30, 9, 255]);
        assert_eq!(at(2, 32, 20), [32, 20, 1, 255]);
        assert_eq!(at(2, 33, 20), [0; 4]);
        assert!(crops.planes(1, &AppearanceSettings::default()).iter().all(|v| *v == 0.0));
        let error = Crops::cut(&[ViewImage { width: 4, height: 4, rgba: &one }]).unwrap_err().to_string();
        assert!(error.contains("view 0") && error.contains("4x4"), "{error}");
    }

    #[test]
    fn detail_is_zero_on_flat_cloth_and_never_sees_the_background() {
        let flat = picture(40, 40, |x, _| (x > 10).then_some([200, 100, 50]));
        let crops = Crops::cut(&[ViewImage { width: 40, height: 40, rgba: &flat }]).unwrap();
        let detail = crops.detail(&AppearanceSettings::default());
        assert!(detail.values.iter().all(|v| v.abs() < 1e-5), "flat cloth");
        let stripes = picture(40, 40, |x, _| Some(if x % 2 == 0 { [255; 3] } else { [0; 3] }));
        let crops = Crops::cut(&[ViewImage { width: 40, height: 40, rgba: &stripes }]).unwrap();
        let detail = crops.detail(&AppearanceSettings::default());
        let middle = &detail.values[(20 * crops.width + 20) * DETAIL..][..DETAIL];
        assert!(middle[0] > 0.4 && middle[3].abs() < 0.02, "stripes of a pixel are fine detail: {middle:?}");
    }

    #[test]
    fn blurs_equal_the_definition() {
        for (width, height) in [(1, 1), (3, 20), (13, 2), (24, 19)] {
            let value = |i: usize, c: usize| ((i * 7 + c * 5) % 11) as f32 / 11.0;
            let pixels: Vec<[f32; 4]> = (0..width * height).map(|i| std::array::from_fn(|c| value(i, c))).collect();
            for sigma in BLURS_PX {
                let radius = (2.5 * f64::from(sigma)).ceil() as i64;
                let weight = |d: i64| (-0.5 * (d as f64 / f64::from(sigma)).powi(2)).exp();
                let total: f64 = (-radius..=radius).map(weight).sum();
                let found = blurred(&pixels, width, sigma);
                for (i, found) in found.iter().enumerate() {
                    let (x, y) = ((i % width) as i64, (i / width) as i64);
                    let mut expected = [0.0f64; 4];
                    for (dx, dy) in (-radius..=radius).flat_map(|dx| (-radius..=radius).map(move |dy| (dx, dy))) {
                        if (0..width as i64).contains(&(x + dx)) && (0..height as i64).contains(&(y + dy)) {
                            let from = pixels[((y + dy) * width as i64 + x + dx) as usize];
                            for c in 0..4 {
                                expected[c] += weight(dx) * weight(dy) / total.powi(2) * f64::from(from[c]);
                            }
                        }
                    }
                    for c in 0..4 {
                        assert!((f64::from(found[c]) - expected[c]).abs() < 1e-6, "{width}x{height}, pixel {i}");
                    }
                }
            }
        }
    }

    #[test]
    fn no_image_at_all_gives_empty_crops() {
        let crops = Crops::cut(&[]).unwrap();
        assert_eq!(crops, Crops::default());
        assert!(crops.detail(&AppearanceSettings::default()).values.is_empty());
    }
}
