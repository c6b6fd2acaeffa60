//! Errors of estimated masks.

use std::path::Path;

use anyhow::{Context, Result};
use flyrig_metrics::mask_iou;
use flyrig_types::Mask;
use serde::Serialize;

use crate::harness::images::coverage;

/// Half width of the band around the true outline in which alpha is compared, pixels.
const BAND_PX: i64 = 3;

/// Means over images.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct MaskErrors {
    /// Intersection over union.
    pub iou: f64,
    /// Harmonic mean of the fraction of the estimated outline within one pixel of the true one, and vice versa.
    pub boundary_f: f64,
    /// Mean absolute error of alpha in a band of 3 pixels around the true outline.
    pub band_alpha: f64,
    #[serde(skip)]
    count: usize,
}

impl MaskErrors {
    /// Adds an input image with the estimated coverage in its alpha channel.
    pub fn add(&mut self, rgba: &[u8], truth: &Mask) {
        let Some(ours) = coverage(rgba, truth) else { return };
        let Ok(iou) = mask_iou(&ours, truth) else { return };
        let (our_edge, true_edge) = (Edge::new(&ours), Edge::new(truth));
        let (precision, recall) = (our_edge.share_near(&true_edge, 1), true_edge.share_near(&our_edge, 1));
        self.iou += iou;
        self.boundary_f += if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 };
        let (mut error, mut pixels) = (0.0, 0usize);
        for at in 0..truth.coverage().len() {
            if true_edge.is_near(at, BAND_PX) {
                error += (f64::from(ours.coverage()[at]) - f64::from(truth.coverage()[at])).abs() / 255.0;
                pixels += 1;
            }
        }
        self.band_alpha += error / pixels.max(1) as f64;
        self.count += 1;
    }

    /// Divides the sums by the number of images.
    pub fn mean(self) -> Self {
        let count = self.count.max(1) as f64;
        Self {
            iou: self.iou / count,
            boundary_f: self.boundary_f / count,
            band_alpha: self.band_alpha / count,
            count: self.count,
        }
    }
}

/// Writes an image in grey, red where the estimated coverage is too small and blue where it is too large.
///
/// # Errors
/// Names the file that cannot be written.
pub fn write_errors(path: &Path, rgba: &[u8], truth: &Mask) -> Result<()> {
    let pixels = rgba.chunks_exact(4).zip(truth.coverage());
    let bytes: Vec<u8> = pixels
        .flat_map(|(pixel, truth)| {
            let grey = pixel[..3].iter().map(|c| u16::from(*c)).sum::<u16>() / 6 + 40;
            let error = i16::from(pixel[3]) - i16::from(*truth);
            let tint = |error: i16| (f32::from(grey) + f32::from(error.clamp(0, 255)) * 0.6).min(255.0) as u8;
            [tint(-error), grey as u8, tint(error)]
        })
        .collect();
    let image = image::RgbImage::from_raw(truth.width(), truth.height(), bytes).context("the mask has another size")?;
    image.save(path).with_context(|| format!("cannot write {}", path.display()))
}

/// Pixels inside a mask with a neighbour outside.
struct Edge {
    width: i64,
    height: i64,
    on: Vec<bool>,
}

impl Edge {
    fn new(mask: &Mask) -> Self {
        let (width, height) = (i64::from(mask.width()), i64::from(mask.height()));
        let inside = |x: i64, y: i64| {
            x >= 0 && y >= 0 && x < width && y < height && mask.coverage()[(y * width + x) as usize] >= 128
        };
        let on = |(x, y): (i64, i64)| {
            inside(x, y) && [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().any(|(dx, dy)| !inside(x + dx, y + dy))
        };
        let on = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(on).collect();
        Self { width, height, on }
    }

    fn is_near(&self, at: usize, reach: i64) -> bool {
        let (x, y) = (at as i64 % self.width, at as i64 / self.width);
        let span = |v: i64, limit: i64| (v - reach).max(0)..=(v + reach).min(limit - 1);
        span(y, self.height).any(|y| span(x, self.width).any(|x| self.on[(y * self.width + x) as usize]))
    }

    /// Returns the fraction of this outline's pixels within `reach` pixels of another outline.
    fn share_near(&self, other: &Self, reach: i64) -> f64 {
        let (mut near, mut all) = (0usize, 0usize);
        for at in (0..self.on.len()).filter(|&at| self.on[at]) {
            all += 1;
            near += usize::from(other.is_near(at, reach));
        }
        near as f64 / all.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(from: usize, to: usize) -> Mask {
        let inside = |i: usize| (from..to).contains(&(i % 40)) && (from..to).contains(&(i / 40));
        Mask::new(40, 40, (0..1600).map(|i| if inside(i) { 255 } else { 0 }).collect()).unwrap()
    }

    fn errors(ours: &Mask, truth: &Mask) -> MaskErrors {
        let rgba: Vec<u8> = ours.coverage().iter().flat_map(|&a| [0, 0, 0, a]).collect();
        let mut errors = MaskErrors::default();
        errors.add(&rgba, truth);
        errors.mean()
    }

    #[test]
    fn the_truth_has_no_error_and_a_pixel_more_keeps_the_boundary_but_costs_alpha() {
        let truth = square(10, 30);
        let same = errors(&truth, &truth);
        assert!((same.iou - 1.0).abs() < 1e-9 && (same.boundary_f - 1.0).abs() < 1e-9 && same.band_alpha == 0.0);
        let larger = errors(&square(9, 31), &truth);
        assert!((larger.boundary_f - 1.0).abs() < 1e-9 && larger.band_alpha > 0.05, "{larger:?}");
        assert!((larger.iou - 400.0 / 484.0).abs() < 1e-9);
        let far = errors(&square(5, 35), &truth);
        assert!(far.boundary_f < 1e-9, "{far:?}");
    }
}
