//! Structural similarity (Wang, Bovik, Sheikh, Simoncelli 2004): 11x11 Gaussian window, sigma 1.5, data range 1,
//! mean over pixels and channels; borders mirrored without repeating the edge pixel.

use rayon::prelude::*;

use super::{MetricError, Picture, PixelBox};

const RADIUS: i64 = 5;
const SIGMA_PX: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Computes SSIM inside the box, at most 1; windows do not reach beyond the box.
///
/// # Errors
/// [`MetricError::SizeMismatch`], [`MetricError::EmptyBox`].
pub fn ssim(first: &Picture, second: &Picture, area: PixelBox) -> Result<f64, MetricError> {
    let (a, b) = first.crop_both(second, area)?;
    let (width, height) = (a.width as usize, a.height as usize);
    let mut total = 0.0;
    for channel in 0..3 {
        let plane = |p: &Picture| -> Vec<f64> { p.pixels.iter().map(|p| f64::from(p[channel])).collect() };
        let product = |x: &[f64], y: &[f64]| -> Vec<f64> { x.iter().zip(y).map(|(x, y)| x * y).collect() };
        let (a, b) = (plane(&a), plane(&b));
        let [mean_a, mean_b, aa, bb, ab] = [
            blur(&a, width),
            blur(&b, width),
            blur(&product(&a, &a), width),
            blur(&product(&b, &b), width),
            blur(&product(&a, &b), width),
        ];
        for i in 0..width * height {
            let (ma, mb) = (mean_a[i], mean_b[i]);
            let (va, vb, covariance) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
            total += (2.0 * ma * mb + C1) * (2.0 * covariance + C2) / ((ma * ma + mb * mb + C1) * (va + vb + C2));
        }
    }
    Ok(total / (3 * width * height) as f64)
}

fn kernel() -> [f64; 2 * RADIUS as usize + 1] {
    let raw: [f64; 2 * RADIUS as usize + 1] =
        std::array::from_fn(|i| (-0.5 * ((i as i64 - RADIUS) as f64 / SIGMA_PX).powi(2)).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|x| x / sum)
}

/// Mirrors an index without repeating the edge, several times in a narrow image.
fn mirror(index: i64, len: usize) -> usize {
    let last = len as i64 - 1;
    if last == 0 {
        return 0;
    }
    let folded = index.rem_euclid(2 * last);
    folded.min(2 * last - folded) as usize
}

fn blur(plane: &[f64], width: usize) -> Vec<f64> {
    let kernel = kernel();
    let height = plane.len() / width;
    let tap = |center: usize, len: usize, at: &dyn Fn(usize) -> f64| -> f64 {
        (-RADIUS..=RADIUS).zip(&kernel).map(|(offset, k)| k * at(mirror(center as i64 + offset, len))).sum()
    };
    let mut rows = vec![0.0; plane.len()];
    rows.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each(|(out, row)| {
        for (x, value) in out.iter_mut().enumerate() {
            *value = tap(x, width, &|i| row[i]);
        }
    });
    let mut out = vec![0.0; plane.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (x, value) in out.iter_mut().enumerate() {
            *value = tap(y, height, &|i| rows[i * width + x]);
        }
    });
    out
}
