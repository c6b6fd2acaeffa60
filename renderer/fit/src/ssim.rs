//! Structural similarity of a plane, and its derivative.
//!
//! Wang et al. 2004 with a Gaussian window of 11 pixels (standard deviation 1.5); outside of the plane both images are
//! zero.

use rayon::prelude::*;

const RADIUS: usize = 5;
const DEVIATION: f64 = 1.5;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;

fn window() -> [f32; RADIUS + 1] {
    let half: [f64; RADIUS + 1] = std::array::from_fn(|i| (-0.5 * (i as f64 / DEVIATION).powi(2)).exp());
    let sum = half[0] + 2.0 * half[1..].iter().sum::<f64>();
    half.map(|value| (value / sum) as f32)
}

/// Gaussian blur of planes of one size.
#[derive(Debug)]
pub(crate) struct Blur {
    window: [f32; RADIUS + 1],
    width: usize,
}

impl Blur {
    /// Prepares the blur of planes with rows of `width` pixels.
    pub(crate) fn new(width: usize) -> Self {
        Self { window: window(), width }
    }

    /// Convolves a plane with the window, which is its own transpose. The plane has complete rows, at least one.
    pub(crate) fn apply(&self, plane: &[f32]) -> Vec<f32> {
        let (width, window) = (self.width, &self.window);
        let height = plane.len() / width.max(1);
        let mut across = vec![0.0f32; plane.len()];
        across.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each(|(out, row)| {
            for (i, weight) in window.iter().enumerate().take(width) {
                let (len, weight) = (width - i, *weight);
                out[..len].iter_mut().zip(&row[i..]).for_each(|(out, value)| *out += weight * value);
                if i > 0 {
                    out[i..].iter_mut().zip(&row[..len]).for_each(|(out, value)| *out += weight * value);
                }
            }
        });
        let mut smooth = vec![0.0f32; plane.len()];
        smooth.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            for from in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height) {
                let weight = window[y.abs_diff(from)];
                let row = &across[from * width..(from + 1) * width];
                out.iter_mut().zip(row).for_each(|(out, value)| *out += weight * value);
            }
        });
        smooth
    }
}

/// Returns the sum of the similarity over all pixels of a plane, values 0..=1, and its derivative with respect to
/// `drawn`. Both planes have complete rows of `width` pixels; without a pixel the sum is 0.
pub(crate) fn ssim(rendered: &[f32], wanted: &[f32], width: usize) -> (f64, Vec<f32>) {
    let count = rendered.len().min(wanted.len());
    if width == 0 || count < width {
        return (0.0, vec![0.0; rendered.len()]);
    }
    let blur = Blur::new(width);
    let product = |a: &[f32], b: &[f32]| -> Vec<f32> { a.iter().zip(b).map(|(a, b)| a * b).collect() };
    let (mean_x, mean_y) = (blur.apply(rendered), blur.apply(wanted));
    let (xx, yy, xy) = (
        blur.apply(&product(rendered, rendered)),
        blur.apply(&product(wanted, wanted)),
        blur.apply(&product(rendered, wanted)),
    );
    let (mut by_mean, mut by_square, mut by_product) = (vec![0.0; count], vec![0.0; count], vec![0.0; count]);
    let mut sum = 0.0;
    for i in 0..count {
        let (x, y) = (mean_x[i], mean_y[i]);
        let (a1, a2) = (2.0 * x * y + C1, 2.0 * (xy[i] - x * y) + C2);
        let (b1, b2) = (x * x + y * y + C1, xx[i] - x * x + yy[i] - y * y + C2);
        let inverse = 1.0 / (b1 * b2);
        let similarity = a1 * a2 * inverse;
        sum += f64::from(similarity);
        by_square[i] = -similarity / b2;
        by_product[i] = 2.0 * a1 * inverse;
        by_mean[i] = 2.0 * y * a2 * inverse - 2.0 * x * similarity / b1 - 2.0 * x * by_square[i] - y * by_product[i];
    }
    let (by_mean, by_square, by_product) = (blur.apply(&by_mean), blur.apply(&by_square), blur.apply(&by_product));
    let slope = (0..count).map(|i| by_mean[i] + 2.0 * rendered[i] * by_square[i] + wanted[i] * by_product[i]).collect();
    (sum, slope)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    /// Computes the definition, pixel by pixel in f64.
    fn reference(rendered: &[f64], wanted: &[f64], width: usize) -> f64 {
        let height = rendered.len() / width;
        let weight = |d: i64| (-0.5 * (d as f64 / DEVIATION).powi(2)).exp();
        let total: f64 = (-5..=5).map(weight).sum();
        let mut sum = 0.0;
        for y in 0..height as i64 {
            for x in 0..width as i64 {
                let mean = |value: &dyn Fn(usize) -> f64| {
                    let mut mean = 0.0;
                    for dy in -5..=5 {
                        for dx in -5..=5 {
                            let (px, py) = (x + dx, y + dy);
                            if (0..width as i64).contains(&px) && (0..height as i64).contains(&py) {
                                let at = py as usize * width + px as usize;
                                mean += weight(dx) * weight(dy) / (total * total) * value(at);
                            }
                        }
                    }
                    mean
                };
                let (mx, my) = (mean(&|i| rendered[i]), mean(&|i| wanted[i]));
                let vx = mean(&|i| rendered[i] * rendered[i]) - mx * mx;
                let vy = mean(&|i| wanted[i] * wanted[i]) - my * my;
                let vxy = mean(&|i| rendered[i] * wanted[i]) - mx * my;
                let (c1, c2) = (1e-4, 9e-4);
                sum += (2.0 * mx * my + c1) * (2.0 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2));
            }
        }
        sum
    }

    #[test]
    fn similarity_and_slope_are_those_of_the_definition() {
        let mut random = StdRng::seed_from_u64(2);
        for (width, height) in [(1, 1), (3, 17), (24, 9), (13, 13)] {
            let plane = |random: &mut StdRng| -> Vec<f64> { (0..width * height).map(|_| random.random()).collect() };
            let (mut rendered, wanted) = (plane(&mut random), plane(&mut random));
            let narrow = |plane: &[f64]| -> Vec<f32> { plane.iter().map(|value| *value as f32).collect() };
            let (sum, slope) = ssim(&narrow(&rendered), &narrow(&wanted), width);
            assert!((sum - reference(&rendered, &wanted, width)).abs() < 1e-3 * rendered.len() as f64, "{width} {sum}");
            for i in (0..rendered.len()).step_by(5) {
                let mut at = |by: f64| {
                    rendered[i] += by;
                    let found = reference(&rendered, &wanted, width);
                    rendered[i] -= by;
                    found
                };
                let expected = (at(1e-5) - at(-1e-5)) / 2e-5;
                let error = (expected - f64::from(slope[i])).abs();
                assert!(error < 2e-3 * (expected.abs() + 0.1), "{width} {i}: {expected} {}", slope[i]);
            }
        }
        let same: Vec<f32> = (0..200).map(|i| (i as f32 * 0.37).sin().abs()).collect();
        let (sum, slope) = ssim(&same, &same, 20);
        assert!((sum - 200.0).abs() < 1e-2 && slope.iter().all(|slope| slope.abs() < 1e-2));
        assert!(ssim(&[], &[], 5).0.abs() <= 0.0);
    }
}
