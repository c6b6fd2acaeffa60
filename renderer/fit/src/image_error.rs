//! Error of a rendered image against a photograph of the person, and its derivative.
//!
//! The comparison uses the bytes that a viewer would show: straight colours in sRGB times coverage, against the
//! photograph times its mask (LoGAvatar Eq. 16 without the learned perceptual term: colour distance, structural
//! similarity, and unsharp-mask differences, Eq. 17), and coverage against the mask.

use flyrig_model::srgb;
use flyrig_renderer::srgb_from_linear;
use rayon::prelude::*;

use crate::ssim::{Blur, ssim};

/// Coverage below which a pixel has no colour.
const CLEAR: f32 = 1.0 / 512.0;
/// Linear value below which the slope of the sRGB curve is held constant: at black it is too steep to descend.
const DARK: f32 = 1e-3;

/// Colour distance below which there is no gradient, codes of 0..=1.
const LEAST: f32 = 1e-4;

/// Weights of the error's terms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorWeights {
    /// Weight of colour distances, root mean squares of the three channels.
    pub color: f32,
    /// Weight of one minus the structural similarity.
    pub structure: f32,
    /// Weight of absolute differences of coverage.
    pub coverage: f32,
    /// Weight of absolute differences of unsharp masks (an image less its blurred version), which emphasises fine
    /// detail.
    pub sharpness: f32,
}

impl Default for ErrorWeights {
    fn default() -> Self {
        Self { color: 0.8, structure: 0.2, coverage: 0.3, sharpness: 0.0 }
    }
}

/// Error of one image and its derivative.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageDifference {
    /// Weighted error, a mean over the pixels of the person.
    pub loss: f64,
    /// Mean squared difference of sRGB over all compared pixels, codes of 0..=1.
    pub squared: f64,
    /// Derivative with respect to premultiplied linear red, green, blue, and coverage; one element per pixel.
    pub slope: Vec<[f32; 4]>,
}

fn srgb_slope(linear: f32) -> f32 {
    srgb::slope(linear.max(DARK), f32::powf)
}

/// Rendered pixel in compared form: sRGB times coverage, with its derivatives.
#[derive(Debug, Clone, Copy, Default)]
struct Shown {
    color: [f32; 3],
    /// Slope with respect to the premultiplied colour, and to coverage.
    by_color: [f32; 3],
    by_coverage: [f32; 3],
}

impl Shown {
    fn of([r, g, b, alpha]: [f32; 4]) -> Self {
        let mut shown = Self::default();
        if alpha.is_nan() || alpha <= CLEAR {
            return shown;
        }
        for (k, value) in [r, g, b].into_iter().enumerate() {
            let straight = (value / alpha).clamp(0.0, 1.0);
            let code = srgb_from_linear(straight);
            shown.color[k] = code * alpha;
            // A clamped value has no slope.
            let moves = value > 0.0 && value < alpha;
            shown.by_color[k] = if moves { srgb_slope(straight) } else { 0.0 };
            shown.by_coverage[k] = code - shown.by_color[k] * straight;
        }
        shown
    }
}

/// Returns the sum of absolute differences of two planes' unsharp masks (LoGAvatar Eq. 17), and its derivative with
/// respect to `drawn`.
fn sharpness(rendered: &[f32], wanted: &[f32], width: usize) -> (f64, Vec<f32>) {
    let count = rendered.len().min(wanted.len());
    if width == 0 || count < width {
        return (0.0, vec![0.0; rendered.len()]);
    }
    let blur = Blur::new(width);
    // Linear and its own transpose.
    let detail = |plane: Vec<f32>| -> Vec<f32> { plane.iter().zip(blur.apply(&plane)).map(|(a, b)| a - b).collect() };
    let difference = detail(rendered.iter().zip(wanted).map(|(a, b)| a - b).collect());
    let sum = difference.iter().map(|value| f64::from(value.abs())).sum();
    let sign = |value: &f32| if *value > 0.0 { 1.0 } else { -1.0 };
    (sum, detail(difference.iter().map(sign).collect()))
}

/// Pixels of a photograph.
#[derive(Debug, Clone, Copy, Default)]
pub struct Photograph<'a> {
    /// sRGB and mask.
    pub rgba: &'a [u8],
    /// Pixels of mixed colour, which is not compared; pixels beyond the end of the list are not mixed.
    pub mixed: &'a [bool],
}

impl ImageDifference {
    /// Compares a rendered image (premultiplied linear RGB, coverage) with a photograph of `width` pixels per row. A
    /// non-finite pixel counts as transparent and has no slope.
    #[must_use]
    pub fn of(rendered: &[[f32; 4]], photograph: Photograph<'_>, width: usize, weights: &ErrorWeights) -> Self {
        let wanted = photograph.rgba;
        let is_mixed = |i: usize| photograph.mixed.get(i).is_some_and(|mixed| *mixed);
        let count = rendered.len().min(wanted.len() / 4);
        let whole = |pixel: &[f32; 4]| if pixel.iter().all(|value| value.is_finite()) { *pixel } else { [0.0; 4] };
        let pixels: Vec<[f32; 4]> = rendered[..count].iter().map(whole).collect();
        let shown: Vec<Shown> = pixels.par_iter().with_min_len(4096).map(|pixel| Shown::of(*pixel)).collect();
        let unit = |code: u8| f32::from(code) / 255.0;
        let mask: Vec<f32> = wanted.chunks_exact(4).take(count).map(|pixel| unit(pixel[3])).collect();
        // A mean over the person, so that a small one counts as much as a large one.
        let person = mask.iter().map(|mask| f64::from(*mask)).sum::<f64>().max(1.0);
        let scale = (1.0 / person) as f32;
        let mut error = Self { slope: vec![[0.0; 4]; count], ..Self::default() };
        let planes: Vec<_> = (0..3)
            .into_par_iter()
            .map(|k| {
                let ours: Vec<f32> = shown.iter().map(|pixel| pixel.color[k]).collect();
                // What is not compared is as wanted.
                let theirs = wanted.chunks_exact(4).zip(&mask).zip(ours.iter().enumerate());
                let theirs: Vec<f32> = theirs
                    .map(|((pixel, mask), (i, ours))| if is_mixed(i) { *ours } else { unit(pixel[k]) * mask })
                    .collect();
                let (similarity, slope) = if weights.structure > 0.0 {
                    ssim(&ours, &theirs, width)
                } else {
                    (count as f64, vec![0.0; count])
                };
                let (sharp, sharp_slope) =
                    if weights.sharpness > 0.0 { sharpness(&ours, &theirs, width) } else { (0.0, vec![0.0; count]) };
                (ours, theirs, [similarity, sharp], [slope, sharp_slope])
            })
            .collect();
        // The distance of two colours, so that a pixel that shows one cloth in some images and another in others gets a colour between them:
        // each channel by itself would go to either, and both together to a third colour.
        let mut distance = 0.0;
        let inverse_lengths: Vec<f32> = (0..count)
            .map(|i| {
                let squares: f32 = planes.iter().map(|(ours, theirs, ..)| (ours[i] - theirs[i]).powi(2)).sum();
                let length = (squares / 3.0).sqrt();
                distance += f64::from(length);
                1.0 / length.max(LEAST)
            })
            .collect();
        let third = scale / 3.0;
        for (k, (ours, theirs, [similarity, sharp], [structure, sharpening])) in planes.into_iter().enumerate() {
            error.loss += f64::from(weights.structure) * (count as f64 - similarity) / (3.0 * person);
            error.loss += f64::from(weights.sharpness) * sharp / (3.0 * person);
            for i in (0..count).filter(|i| !is_mixed(*i)) {
                let difference = ours[i] - theirs[i];
                error.squared += f64::from(difference * difference);
                let along = difference * inverse_lengths[i];
                let slope = third
                    * (weights.color * along - weights.structure * structure[i] + weights.sharpness * sharpening[i]);
                let Shown { by_color, by_coverage, .. } = &shown[i];
                error.slope[i][k] = slope * by_color[k];
                error.slope[i][3] += slope * by_coverage[k];
            }
        }
        error.loss += f64::from(weights.color) * distance / person;
        let compared = (0..count).filter(|i| !is_mixed(*i)).count();
        error.squared /= 3.0 * compared.max(1) as f64;
        for ((slope, pixel), mask) in error.slope.iter_mut().zip(&pixels).zip(&mask) {
            let difference = pixel[3] - mask;
            error.loss += f64::from(weights.coverage * difference.abs()) / person;
            slope[3] += scale * weights.coverage * if difference > 0.0 { 1.0 } else { -1.0 };
        }
        for (slope, pixel) in error.slope.iter_mut().zip(rendered) {
            if !pixel.iter().all(|value| value.is_finite()) {
                *slope = [0.0; 4];
            }
        }
        error
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    fn photograph(rgba: &[u8]) -> Photograph<'_> {
        Photograph { rgba, mixed: &[] }
    }

    #[test]
    fn slopes_are_those_of_finite_differences() {
        let mut random = StdRng::seed_from_u64(4);
        let width = 12;
        let mut rendered: Vec<[f32; 4]> = (0..width * 10)
            .map(|_| {
                let alpha = random.random_range(0.1f32..0.99);
                [0; 3]
                    .map(|_| alpha * random.random_range(0.05f32..0.95))
                    .into_iter()
                    .chain([alpha])
                    .collect::<Vec<_>>()
            })
            .map(|row| [row[0], row[1], row[2], row[3]])
            .collect();
        let wanted: Vec<u8> = (0..width * 10 * 4).map(|_| random.random()).collect();
        let weights = ErrorWeights { color: 0.8, structure: 0.2, coverage: 0.3, sharpness: 0.7 };
        let slope = ImageDifference::of(&rendered, photograph(&wanted), width, &weights).slope;
        let mut worst = 0.0f64;
        for i in (0..rendered.len()).step_by(3) {
            for k in 0..4 {
                let step = 1e-3;
                let mut at = |by: f32| {
                    rendered[i][k] += by;
                    let loss = ImageDifference::of(&rendered, photograph(&wanted), width, &weights).loss;
                    rendered[i][k] -= by;
                    loss
                };
                let expected = (at(step) - at(-step)) / f64::from(2.0 * step);
                worst = worst.max((expected - f64::from(slope[i][k])).abs() / (expected.abs() + 1e-3));
            }
        }
        assert!(worst < 0.03, "{worst}");
    }

    #[test]
    fn the_color_of_mixed_pixels_does_not_count_and_their_coverage_does() {
        let mut random = StdRng::seed_from_u64(8);
        let width = 14;
        let rendered: Vec<[f32; 4]> = (0..width * 12).map(|_| [0.1, 0.2, 0.3, random.random_range(0.4..0.9)]).collect();
        let mut rgba: Vec<u8> = (0..rendered.len() * 4).map(|_| random.random()).collect();
        let mixed: Vec<bool> = (0..rendered.len()).map(|_| random.random()).collect();
        let weights = ErrorWeights { sharpness: 0.5, ..ErrorWeights::default() };
        let of = |rgba: &[u8]| ImageDifference::of(&rendered, Photograph { rgba, mixed: &mixed }, width, &weights);
        let before = of(&rgba);
        for (pixel, _) in rgba.chunks_exact_mut(4).zip(&mixed).filter(|(_, mixed)| **mixed) {
            pixel[..3].iter_mut().for_each(|code| *code = !*code);
        }
        assert_eq!(before, of(&rgba));
        let scale = weights.coverage / rgba.chunks_exact(4).map(|pixel| f32::from(pixel[3]) / 255.0).sum::<f32>();
        for (slope, _) in before.slope.iter().zip(&mixed).filter(|(_, mixed)| **mixed) {
            assert!(slope[..3].iter().all(|slope| slope.abs() <= 0.0) && (slope[3].abs() - scale).abs() < 1e-3 * scale);
        }
        assert!(before != ImageDifference::of(&rendered, photograph(&rgba), width, &weights));
    }

    #[test]
    fn sharpness_sees_detail_alone_and_its_derivative_is_that_of_finite_differences() {
        let mut random = StdRng::seed_from_u64(6);
        let (width, height) = (40, 30);
        let wanted: Vec<f32> = (0..width * height).map(|_| random.random()).collect();
        let mut rendered: Vec<f32> = (0..width * height).map(|_| random.random()).collect();
        let (sum, slope) = sharpness(&rendered, &wanted, width);
        // The definition, in f64 and two dimensions.
        let weight = |d: f64| (-0.5 * (d / 1.5f64).powi(2)).exp();
        let total: f64 = (-5..=5).map(|d| weight(f64::from(d))).sum();
        let mut expected = 0.0;
        for y in 0..height as i64 {
            for x in 0..width as i64 {
                let at = |x: i64, y: i64| {
                    let inside = (0..width as i64).contains(&x) && (0..height as i64).contains(&y);
                    let i = (y * width as i64 + x) as usize;
                    if inside { f64::from(rendered[i]) - f64::from(wanted[i]) } else { 0.0 }
                };
                let taps = (-5..=5i64).flat_map(|dy| (-5..=5i64).map(move |dx| (dx, dy)));
                let smooth: f64 = taps.map(|(dx, dy)| weight(dx as f64) * weight(dy as f64) * at(x + dx, y + dy)).sum();
                expected += (at(x, y) - smooth / (total * total)).abs();
            }
        }
        assert!((sum - expected).abs() < 1e-3 * expected, "{sum} {expected}");
        for i in (0..rendered.len()).step_by(17) {
            let step = 1e-3;
            rendered[i] += step;
            let more = sharpness(&rendered, &wanted, width).0;
            rendered[i] -= 2.0 * step;
            let expected = (more - sharpness(&rendered, &wanted, width).0) / f64::from(2.0 * step);
            rendered[i] += step;
            assert!((expected - f64::from(slope[i])).abs() < 0.2, "{i}: {expected} {}", slope[i]);
        }
        // A smooth difference hardly counts inside.
        let ramp: Vec<f32> = (0..width * height).map(|i| wanted[i] + (i % width) as f32 * 0.01).collect();
        assert!(sharpness(&ramp, &wanted, width).0 < 0.15 * ramp.len() as f64);
        assert!(sharpness(&[], &[], 5).0.abs() <= 0.0 && sharpness(&[1.0], &[0.0], 0).0.abs() <= 0.0);
    }

    #[test]
    fn the_same_image_has_no_error_and_poison_is_left_out() {
        let wanted: Vec<u8> = (0..400).flat_map(|i| [40 + (i % 100) as u8, 90, 160, 255]).collect();
        let linear = |code: u8| {
            let code = f32::from(code) / 255.0;
            if code <= 0.040_45 { code / 12.92 } else { ((code + 0.055) / 1.055).powf(2.4) }
        };
        let mut rendered: Vec<[f32; 4]> =
            wanted.chunks_exact(4).map(|p| [linear(p[0]), linear(p[1]), linear(p[2]), 1.0]).collect();
        let error = ImageDifference::of(&rendered, photograph(&wanted), 20, &ErrorWeights::default());
        assert!(error.loss < 1e-3 && error.squared < 1e-8, "{} {}", error.loss, error.squared);
        rendered[3] = [f32::NAN, 0.0, 0.0, 1.0];
        rendered[5] = [f32::INFINITY; 4];
        let error = ImageDifference::of(&rendered, photograph(&wanted), 20, &ErrorWeights::default());
        assert!(
            error.loss.is_finite()
                && error.slope[3].iter().all(|v| v.abs() <= 0.0)
                && error.slope.iter().flatten().all(|v| v.is_finite())
        );
        assert!(ImageDifference::of(&[], photograph(&[]), 20, &ErrorWeights::default()).slope.is_empty());
        // Nobody in the image: what is drawn is too much.
        let error = ImageDifference::of(&[[0.5, 0.5, 0.5, 0.9]], photograph(&[0; 4]), 1, &ErrorWeights::default());
        assert!(error.loss > 0.1 && error.slope[0][3] > 0.0);
    }
}
