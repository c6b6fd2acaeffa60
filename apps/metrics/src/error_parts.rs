//! Parts of a rendered image's error: the gain of better colours, and the rest, which needs a better surface.

use flyrig_types::Mask;
use serde::Serialize;

use crate::image_metrics::{Picture, PixelBox};

/// Scales of detail: standard deviations of Gaussian blur, pixels.
pub const SCALES_PX: [f64; 3] = [8.0, 4.0, 2.0];

/// Least coverage of a fully covered pixel.
const COVERED: u8 = 250;
/// Largest reported gain, decibels.
const MOST_DB: f64 = 99.0;

/// Parts of an image's squared error, and the PSNR that removing each would gain.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ErrorParts {
    /// Fraction of the squared error in pixels that the rendered view or the truth does not cover fully, 0..=1.
    pub silhouette: f64,
    /// Gain of perfect colours in pixels that both cover fully, dB.
    pub colors_db: f64,
    /// Gain of colours there that are right up to detail finer than each of [`SCALES_PX`], dB: the blurred difference of the
    /// two images is subtracted. This is a bound, since it takes the truth.
    pub smooth_db: [f64; 3],
}

impl ErrorParts {
    /// Computes the parts for two images on black of equal size, inside `area`. `rendered` is the coverage of `ours`, `mask` that of
    /// `truth`.
    #[must_use]
    pub fn new(ours: &Picture, truth: &Picture, rendered: &Mask, mask: &Mask, area: PixelBox) -> Self {
        let [left, top, right, bottom] = area;
        let width = (right - left) as usize;
        let at = |x: u32, y: u32| (y * ours.size().0 + x) as usize;
        let places: Vec<usize> = (top..bottom).flat_map(|y| (left..right).map(move |x| at(x, y))).collect();
        let covered = |i: usize| rendered.coverage()[i] >= COVERED && mask.coverage()[i] >= COVERED;
        let inside: Vec<bool> = places.iter().map(|&i| covered(i)).collect();
        let difference: Vec<[f64; 3]> = places
            .iter()
            .map(|&i| std::array::from_fn(|c| f64::from(ours.pixels()[i][c]) - f64::from(truth.pixels()[i][c])))
            .collect();
        let squared = |d: &[f64; 3]| d.iter().map(|v| v * v).sum::<f64>();
        let total: f64 = difference.iter().map(squared).sum();
        let outside: f64 =
            difference.iter().zip(&inside).filter(|(_, inside)| !**inside).map(|(d, _)| squared(d)).sum();
        if total <= 0.0 || !total.is_finite() {
            return Self::default();
        }
        let gain = |left: f64| (10.0 * (total / left.max(1e-30)).log10()).clamp(-MOST_DB, MOST_DB);
        Self {
            silhouette: outside / total,
            colors_db: gain(outside),
            smooth_db: SCALES_PX.map(|sigma| {
                let smooth = blurred(&difference, &inside, width, sigma);
                let rest = difference.iter().zip(&smooth).zip(&inside).filter(|(_, inside)| **inside);
                let rest = rest.map(|((d, s), _)| squared(&std::array::from_fn(|c| d[c] - s[c])));
                gain(outside + rest.sum::<f64>())
            }),
        }
    }

    /// Returns the mean of several; `None` for an empty slice.
    #[must_use]
    pub fn mean(parts: &[Self]) -> Option<Self> {
        let over = |pick: &dyn Fn(&Self) -> f64| parts.iter().map(pick).sum::<f64>() / parts.len() as f64;
        (!parts.is_empty()).then(|| Self {
            silhouette: over(&|p| p.silhouette),
            colors_db: over(&|p| p.colors_db),
            smooth_db: std::array::from_fn(|i| over(&|p| p.smooth_db[i])),
        })
    }
}

impl std::fmt::Display for ErrorParts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [a, b, c] = SCALES_PX;
        let [x, y, z] = self.smooth_db;
        write!(
            f,
            "{:.0} % of the squared error is at the silhouette. Perfect colours inside would gain {:.2} dB; \
             right but for detail finer than {a} / {b} / {c} px, {x:.2} / {y:.2} / {z:.2} dB",
            100.0 * self.silhouette,
            self.colors_db
        )
    }
}

/// Blurs the pixels inside by a Gaussian, normalized over these pixels alone; 0 where no pixel inside is near.
fn blurred(values: &[[f64; 3]], inside: &[bool], width: usize, sigma: f64) -> Vec<[f64; 3]> {
    let radius = (2.5 * sigma).ceil() as usize;
    let kernel: Vec<f64> = (0..=radius).map(|d| (-0.5 * (d as f64 / sigma).powi(2)).exp()).collect();
    let start: Vec<[f64; 4]> =
        values.iter().zip(inside).map(|(v, &inside)| if inside { [v[0], v[1], v[2], 1.0] } else { [0.0; 4] }).collect();
    let height = values.len() / width.max(1);
    let pass = |from: &[[f64; 4]], step: usize, count: usize, place: &dyn Fn(usize) -> usize| {
        let mut to = vec![[0.0; 4]; from.len()];
        for (i, to) in to.iter_mut().enumerate() {
            let here = place(i);
            let (low, high) = (here.saturating_sub(radius), (here + radius).min(count - 1));
            for other in low..=high {
                let weight = kernel[here.abs_diff(other)];
                let from = &from[i + other * step - here * step];
                to.iter_mut().zip(from).for_each(|(to, from)| *to += weight * from);
            }
        }
        to
    };
    let rows = pass(&start, 1, width, &|i| i % width);
    let both = pass(&rows, width, height, &|i| i / width);
    let mean = |p: &[f64; 4]| if p[3] > 1e-9 { [p[0] / p[3], p[1] / p[3], p[2] / p[3]] } else { [0.0; 3] };
    both.iter().map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: u32 = 48;

    fn picture(value: impl Fn(u32, u32) -> u8) -> Picture {
        let rgb: Vec<u8> = (0..SIDE * SIDE).flat_map(|i| [value(i % SIDE, i / SIDE); 3]).collect();
        Picture::from_rgb8(SIDE, SIDE, &rgb).unwrap()
    }

    fn mask(covered: impl Fn(u32, u32) -> bool) -> Mask {
        let coverage = (0..SIDE * SIDE).map(|i| if covered(i % SIDE, i / SIDE) { 255 } else { 0 }).collect();
        Mask::new(SIDE, SIDE, coverage).unwrap()
    }

    const ALL: [u32; 4] = [0, 0, SIDE, SIDE];

    #[test]
    fn a_wrong_shade_is_all_colour_and_smooth() {
        let whole = mask(|_, _| true);
        let parts = ErrorParts::new(&picture(|_, _| 120), &picture(|_, _| 100), &whole, &whole, ALL);
        assert!(parts.silhouette < 1e-12 && parts.colors_db > 98.0, "{parts:?}");
        assert!(parts.smooth_db.iter().all(|db| *db > 60.0), "{parts:?}");
    }

    #[test]
    fn stripes_of_two_pixels_are_detail() {
        let whole = mask(|_, _| true);
        let parts =
            ErrorParts::new(&picture(|x, _| 100 + 40 * (x / 2 % 2) as u8), &picture(|_, _| 120), &whole, &whole, ALL);
        assert!(parts.smooth_db.iter().all(|db| *db < 0.3), "{parts:?}"); // at the borders the blur is one-sided
        assert!(parts.colors_db > 98.0, "{parts:?}");
    }

    #[test]
    fn what_only_one_of_them_covers_is_silhouette() {
        let (left, whole) = (mask(|x, _| x < 24), mask(|_, _| true));
        // Two equal errors: one where only the truth is, one where both are.
        let ours = picture(|x, _| if x < 24 { 110 } else { 90 });
        let parts = ErrorParts::new(&ours, &picture(|_, _| 100), &left, &whole, ALL);
        assert!((parts.silhouette - 0.5).abs() < 1e-9, "{parts:?}");
        assert!((parts.colors_db - 10.0 * 2f64.log10()).abs() < 1e-6, "{parts:?}");
    }

    #[test]
    fn equal_images_and_no_images_have_no_error() {
        let whole = mask(|_, _| true);
        let same = picture(|x, y| (x + y) as u8);
        assert_eq!(ErrorParts::new(&same, &same, &whole, &whole, ALL), ErrorParts::default());
        assert_eq!(ErrorParts::mean(&[]), None);
    }
}
