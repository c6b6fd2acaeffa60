//! Error of drawn planes against a known surface, and its derivative (HGM, Eq. 15; the paper gives no equation for its normal term).

use flyrig_renderer::PixelPlane;
use glam::Vec3;

use crate::known_surface::KnownSurface;

/// Coverage below which a pixel draws no surface.
const LEAST_ALPHA: f32 = 0.5;
/// Difference of depth from which a pixel no longer counts, metres: it shows another surface, or its known depth is wrong.
const REACH_M: f32 = 0.05;

/// Weights of the error's terms. Those of [`crate::ErrorWeights`] are of colours of 0..=1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceWeights {
    /// Weight of absolute differences of depth, per metre.
    pub depth_per_m: f32,
    /// Weight of one minus the cosine between the normals.
    pub normal: f32,
}

impl Default for SurfaceWeights {
    fn default() -> Self {
        Self { depth_per_m: 10.0, normal: 0.1 }
    }
}

/// Error of one image's surface and its derivative.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SurfaceDifference {
    /// Weighted error: a sum over the compared pixels, divided by the number of pixels of the person.
    pub loss: f64,
    /// Mean absolute difference of depth over the compared pixels, metres; 0 without any.
    pub depth_m: f64,
    /// Derivative with respect to the sums of [`flyrig_renderer::RenderTarget::planes`], and to coverage; one element per pixel.
    pub planes: Vec<[f32; 4]>,
    /// Derivative with respect to coverage.
    pub coverage: Vec<f32>,
}

impl SurfaceDifference {
    /// Compares drawn planes with a known surface. `color` (premultiplied, coverage in w) and `planes` are images of a
    /// [`flyrig_renderer::RenderTarget`]. The planes pass through the Gaussians' centres, which lie `below_m` metres below the surface that
    /// they draw. `person` is the number of the person's pixels. Pixels that are not covered, not known, not finite or too far from the known
    /// surface count as nothing.
    #[must_use]
    pub fn of(
        [color, planes]: [&[[f32; 4]]; 2],
        known: &KnownSurface,
        below_m: f32,
        person: f64,
        weights: &SurfaceWeights,
    ) -> Self {
        let scale = (1.0 / person.max(1.0)) as f32;
        let mut error =
            Self { planes: vec![[0.0; 4]; planes.len()], coverage: vec![0.0; planes.len()], ..Self::default() };
        let mut compared = 0u32;
        for (i, ((color, sums), known)) in color.iter().zip(planes).zip(known.pixels.iter()).enumerate() {
            let Some(wanted) = known.depth_below(below_m) else { continue };
            let Some(plane) = PixelPlane::new(*sums, color[3], LEAST_ALPHA) else { continue };
            let difference = plane.depth_m - wanted;
            if difference.is_nan() || difference.abs() > REACH_M {
                continue;
            }
            compared += 1;
            error.depth_m += f64::from(difference.abs());
            let normal = Vec3::from(known.normal);
            let turned = 1.0 - normal.dot(Vec3::from(plane.normal));
            error.loss += f64::from(scale * (weights.depth_per_m * difference.abs() + weights.normal * turned));
            let along = if difference > 0.0 { 1.0 } else { -1.0 };
            let by_normal = normal * (-scale * weights.normal);
            let by_depth = scale * weights.depth_per_m * along;
            (error.planes[i], error.coverage[i]) = plane.slopes(*sums, color[3], by_depth, by_normal.to_array());
        }
        error.depth_m /= f64::from(compared.max(1));
        error
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::known_surface::KnownPixel;

    const BELOW_M: f32 = 0.004;

    /// Random pixels: drawn colours and planes, and a surface beside them.
    fn scene(seed: u64) -> ([Vec<[f32; 4]>; 2], KnownSurface) {
        let mut random = StdRng::seed_from_u64(seed);
        let (mut color, mut planes, mut known) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..50 {
            let mut number = |low: f32, high: f32| random.random_range(low..high);
            let (alpha, depth) = (number(0.55, 1.0), number(1.0, 3.0));
            let mut direction = || Vec3::new(number(-0.4, 0.4), number(-0.4, 0.4), -1.0).normalize();
            let (drawn, normal) = (direction() * 0.9 * alpha, direction());
            let slant = number(1.0, 4.0);
            color.push([0.1, 0.2, 0.3, alpha]);
            planes.push([drawn.x, drawn.y, drawn.z, depth * alpha]);
            let off = number(0.004, 0.03) * if number(-1.0, 1.0) > 0.0 { 1.0 } else { -1.0 };
            known.push(KnownPixel { depth_m: depth + off - BELOW_M * slant, normal: normal.to_array(), slant });
        }
        ([color, planes], KnownSurface { pixels: Arc::from(known) })
    }

    fn of([color, planes]: &[Vec<[f32; 4]>; 2], known: &KnownSurface, weights: &SurfaceWeights) -> SurfaceDifference {
        SurfaceDifference::of([color, planes], known, BELOW_M, 60.0, weights)
    }

    #[test]
    fn slopes_are_those_of_finite_differences_of_the_plain_sum() {
        let (mut images, known) = scene(3);
        let weights = SurfaceWeights { depth_per_m: 8.0, normal: 0.3 };
        let plain = |[color, planes]: &[Vec<[f32; 4]>; 2]| -> f64 {
            let rows = color.iter().zip(planes).zip(known.pixels.iter());
            let of = rows.map(|((color, sums), known)| {
                let normal = Vec3::new(sums[0], sums[1], sums[2]).as_dvec3().normalize();
                let wanted = f64::from(known.depth_m) + f64::from(BELOW_M) * f64::from(known.slant);
                let depth = f64::from(sums[3]) / f64::from(color[3]);
                8.0 * (depth - wanted).abs() + 0.3 * (1.0 - normal.dot(Vec3::from(known.normal).as_dvec3()))
            });
            of.sum::<f64>() / 60.0
        };
        let error = of(&images, &known, &weights);
        assert!((error.loss - plain(&images)).abs() < 1e-5 * error.loss, "{} {}", error.loss, plain(&images));
        assert!((0.004..0.03).contains(&error.depth_m));
        let step = 1e-3;
        for i in 0..50 {
            for (image, k) in [(0, 3), (1, 0), (1, 1), (1, 2), (1, 3)] {
                let mut at = |by: f32| {
                    let kept = images[image][i][k];
                    images[image][i][k] += by;
                    let loss = plain(&images);
                    images[image][i][k] = kept;
                    loss
                };
                let expected = (at(step) - at(-step)) / f64::from(2.0 * step);
                let found = if image == 0 { error.coverage[i] } else { error.planes[i][k] };
                assert!(
                    (expected - f64::from(found)).abs() < 1e-3 * expected.abs() + 2e-5,
                    "{i} {image} {k}: {expected} {found}"
                );
            }
        }
    }

    #[test]
    fn pixels_without_a_surface_and_poison_count_as_nothing() {
        let (images, known) = scene(5);
        let weights = SurfaceWeights::default();
        let whole = of(&images, &known, &weights);
        let mut broken = images.clone();
        broken[0][1][3] = 0.4; // hardly covered
        broken[0][2][3] = f32::NAN;
        broken[1][3] = [f32::NAN; 4];
        broken[1][4] = [0.0, 0.0, 0.0, 2.0];
        broken[1][5][3] += 0.2; // far from the known surface
        broken[1][6][3] = f32::INFINITY;
        let mut unknown = known.pixels.to_vec();
        unknown[7].depth_m = 0.0;
        unknown[8].depth_m = f32::NAN;
        let error = of(&broken, &KnownSurface { pixels: Arc::from(unknown) }, &weights);
        assert!(error.loss.is_finite() && error.depth_m.is_finite());
        for i in 0..50 {
            if (1..9).contains(&i) {
                assert!(
                    error.planes[i].iter().all(|slope| slope.abs() <= 0.0) && error.coverage[i].abs() <= 0.0,
                    "{i}"
                );
            } else {
                assert_eq!((error.planes[i], error.coverage[i]), (whole.planes[i], whole.coverage[i]));
            }
        }
        // No pixel at all, and lists of different lengths.
        let none = of(&[Vec::new(), Vec::new()], &known, &weights);
        assert!(none.loss.abs() <= 0.0 && none.depth_m.abs() <= 0.0 && none.planes.is_empty());
        let short = of(&[images[0][..9].to_vec(), images[1].clone()], &known, &weights);
        assert!(short.planes.len() == 50 && short.planes[9].iter().all(|slope| slope.abs() <= 0.0));
    }
}
