//! Structural similarity (Wang et al. 2004) of patches with box windows, and their fine contrast.

use flyrig_learn::burn_tensor::{Tensor, module, ops::AvgPoolOptions};

use crate::sample::PATCH;

/// Side of a window and distance of two windows, pixels.
const WINDOW: usize = 8;
const STRIDE: usize = 4;
/// Stabilising constants of SSIM, for values from 0 to 1.
const SMALL: [f32; 2] = [1e-4, 9e-4];

/// Side of a window of fine contrast and distance of two windows, pixels.
const FINE: usize = 4;
const FINE_STRIDE: usize = 2;
/// Constant added to a variance, so that its root is differentiable everywhere.
const SMALL_VARIANCE: f32 = 1e-4;

/// Converts rows (pixel, 3), patch by patch and row by row, to planes.
fn planes(of: Tensor<2>) -> Tensor<4> {
    let patches = of.dims()[0] / (PATCH * PATCH);
    of.reshape([patches, PATCH, PATCH, 3]).permute([0, 3, 1, 2])
}

/// Computes the standard deviation of every small window.
pub(crate) fn fine_contrast(of: Tensor<2>) -> Tensor<4> {
    let mean = |of: Tensor<4>| module::avg_pool2d(of, AvgPoolOptions::new([FINE; 2]).with_stride([FINE_STRIDE; 2]));
    let of = planes(of);
    let variance = mean(of.clone().powf_scalar(2.0)) - mean(of).powf_scalar(2.0);
    (variance.clamp_min(0.0) + SMALL_VARIANCE).sqrt()
}

/// Computes the mean SSIM over windows and channels of rows (pixel, 3), patch by patch and row by row.
pub(crate) fn structural_similarity(ours: Tensor<2>, truth: Tensor<2>) -> Tensor<1> {
    let mean = |of: Tensor<4>| module::avg_pool2d(of, AvgPoolOptions::new([WINDOW; 2]).with_stride([STRIDE; 2]));
    let (a, b) = (planes(ours), planes(truth));
    let (mean_a, mean_b) = (mean(a.clone()), mean(b.clone()));
    let products = mean_a.clone() * mean_b.clone();
    let squares = mean_a.powf_scalar(2.0) + mean_b.powf_scalar(2.0);
    let covariance = mean(a.clone() * b.clone()) - products.clone();
    let variances = mean(a.powf_scalar(2.0) + b.powf_scalar(2.0)) - squares.clone();
    let light = (products * 2.0 + SMALL[0]) / (squares + SMALL[0]);
    let shape = (covariance * 2.0 + SMALL[1]) / (variances + SMALL[1]);
    (light * shape).mean()
}

#[cfg(test)]
mod tests {
    use flyrig_learn::burn_tensor::{Device, TensorData};
    use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

    use super::*;

    fn measured(a: &[f32], b: &[f32]) -> f64 {
        let rows =
            |of: &[f32]| Tensor::<2>::from_data(TensorData::new(of.to_vec(), [of.len() / 3, 3]), &Device::flex());
        f64::from(flyrig_learn::to_vec(structural_similarity(rows(a), rows(b)))[0])
    }

    /// Computes the reference in f64, window by window, from differences to the mean.
    fn reference(a: &[f32], b: &[f32]) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        for patch in 0..a.len() / (3 * PATCH * PATCH) {
            for (y0, x0) in (0..=PATCH - WINDOW)
                .step_by(STRIDE)
                .flat_map(|y| (0..=PATCH - WINDOW).step_by(STRIDE).map(move |x| (y, x)))
            {
                for c in 0..3 {
                    let places = (0..WINDOW * WINDOW).map(|i| {
                        let (y, x) = (y0 + i / WINDOW, x0 + i % WINDOW);
                        ((patch * PATCH + y) * PATCH + x) * 3 + c
                    });
                    let n = (WINDOW * WINDOW) as f64;
                    let mean = |of: &[f32]| places.clone().map(|i| f64::from(of[i])).sum::<f64>() / n;
                    let (ma, mb) = (mean(a), mean(b));
                    let moment = |f: &dyn Fn(f64, f64) -> f64| {
                        places.clone().map(|i| f(f64::from(a[i]) - ma, f64::from(b[i]) - mb)).sum::<f64>() / n
                    };
                    let (va, vb, cov) = (moment(&|a, _| a * a), moment(&|_, b| b * b), moment(&|a, b| a * b));
                    sum += (2.0 * ma * mb + 1e-4) / (ma * ma + mb * mb + 1e-4) * (2.0 * cov + 9e-4) / (va + vb + 9e-4);
                    count += 1.0;
                }
            }
        }
        sum / count
    }

    #[test]
    fn fine_contrast_is_the_deviation_of_every_small_window() {
        let mut rng = SmallRng::seed_from_u64(9);
        let size = 2 * PATCH * PATCH * 3;
        let a: Vec<f32> = (0..size).map(|_| rng.random_range(0.0..1.0)).collect();
        let rows = Tensor::<2>::from_data(TensorData::new(a.clone(), [size / 3, 3]), &Device::flex());
        let found = fine_contrast(rows);
        let side = (PATCH - FINE) / FINE_STRIDE + 1;
        assert_eq!(found.dims(), [2, 3, side, side]);
        let found = flyrig_learn::to_vec(found);
        for (i, found) in found.iter().enumerate() {
            let (x, y, c, patch) = (i % side, i / side % side, i / (side * side) % 3, i / (3 * side * side));
            let expected = window_contrast(&a, patch * PATCH + y * FINE_STRIDE, x * FINE_STRIDE, c);
            assert!((f64::from(*found) - expected).abs() < 1e-5, "window {i}: {found} against {expected}");
        }
    }

    /// Returns the largest difference of the slopes by autodiff from finite differences of the f64 references, relative
    /// to the largest slope.
    fn slope_error(size: usize, value: impl Fn(Tensor<2>) -> Tensor<1>, reference: impl Fn(&[f32]) -> f64) -> f64 {
        let mut rng = SmallRng::seed_from_u64(10);
        let a: Vec<f32> = (0..size).map(|_| rng.random_range(0.2..0.8)).collect();
        let leaf = Tensor::<2>::from_data(TensorData::new(a.clone(), [size / 3, 3]), &Device::flex().autodiff());
        let leaf = leaf.require_grad();
        let gradients = value(leaf.clone()).backward();
        let found = flyrig_learn::to_vec(leaf.grad(&gradients).unwrap());
        let largest = found.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        let step = 1e-3;
        (0..size).step_by(17).fold(0.0, |worst: f64, at| {
            let moved = |by: f32| {
                let mut a = a.clone();
                a[at] += by;
                reference(&a)
            };
            let expected = (moved(step) - moved(-step)) / (2.0 * f64::from(step));
            worst.max((f64::from(found[at]) - expected).abs() / f64::from(largest))
        })
    }

    #[test]
    fn slopes_equal_finite_differences() {
        let mut rng = SmallRng::seed_from_u64(11);
        let size = PATCH * PATCH * 3;
        let b: Vec<f32> = (0..size).map(|_| rng.random_range(0.2..0.8)).collect();
        let truth = b.clone();
        let similarity = move |of: Tensor<2>| {
            let device = of.device();
            structural_similarity(of, Tensor::from_data(TensorData::new(truth.clone(), [size / 3, 3]), &device))
        };
        let error = slope_error(size, similarity, |a| reference(a, &b));
        assert!(error < 1e-2, "similarity: {error}");
        let error = slope_error(size, |of| fine_contrast(of).mean(), fine_reference);
        assert!(error < 1e-2, "contrast: {error}");
    }

    /// Computes the deviation of the window that begins at this pixel, by definition.
    fn window_contrast(a: &[f32], y: usize, x: usize, c: usize) -> f64 {
        let values: Vec<f64> =
            (0..FINE * FINE).map(|k| f64::from(a[((y + k / FINE) * PATCH + x + k % FINE) * 3 + c])).collect();
        let mean = values.iter().sum::<f64>() / 16.0;
        (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 16.0 + 1e-4).sqrt()
    }

    /// Computes the mean fine contrast, window by window.
    fn fine_reference(a: &[f32]) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        for y in (0..=PATCH - FINE).step_by(FINE_STRIDE) {
            for x in (0..=PATCH - FINE).step_by(FINE_STRIDE) {
                for c in 0..3 {
                    sum += window_contrast(a, y, x, c);
                    count += 1.0;
                }
            }
        }
        sum / count
    }

    #[test]
    fn windows_equal_the_definition() {
        let mut rng = SmallRng::seed_from_u64(8);
        let size = 2 * PATCH * PATCH * 3;
        let a: Vec<f32> = (0..size).map(|_| rng.random_range(0.0..1.0)).collect();
        for blend in [0.0, 0.2, 0.9, 1.0] {
            let b: Vec<f32> = a.iter().map(|v| v + blend * (rng.random_range(0.0..1.0) - v)).collect();
            let (ours, expected) = (measured(&a, &b), reference(&a, &b));
            assert!((ours - expected).abs() < 2e-5, "{blend}: {ours} against {expected}");
        }
        let (black, white) = (vec![0.0; size], vec![1.0; size]);
        assert!((measured(&white, &white) - 1.0).abs() < 1e-4);
        assert!((measured(&black, &white) - reference(&black, &white)).abs() < 2e-5);
        let flat: Vec<f32> = (0..size).map(|_| 0.5).collect();
        assert!(measured(&a, &flat) < 0.1, "contrast that is lost counts");
    }
}
