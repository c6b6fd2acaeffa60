//! Points that can be seen from outside: seams of a mouth or a pocket have walls that no camera sees, and that belong to no surface of a
//! solid.

use glam::Vec3;
use rayon::prelude::*;

use crate::density::median;
use crate::points::OrientedPoints;

/// Directions of virtual cameras, spread evenly over the sphere.
const DIRECTIONS: usize = 96;
/// Depth behind the nearest point at which a point is hidden: in pixels of the depth images, as wide as the spacing, and in deviations.
const HIDDEN: f32 = 2.5;
const DEVIATIONS: f32 = 3.0;
/// Least cosine between a point's normal and the direction to a camera that sees it.
const FACING: f32 = 0.2;
/// Largest side of a depth image, pixels: a stray point far away does not grow it.
const MOST_PIXELS: f32 = 2048.0;

/// Returns for each point whether one of 96 distant virtual cameras on all sides sees it (HGM, section 3.1, where they render the
/// Gaussians). `spacing_m` is the spacing of the points. The result does not depend on the number of threads.
#[must_use]
pub fn visible(points: &OrientedPoints, spacing_m: f32) -> Vec<bool> {
    let count = points.len();
    let noise_m = DEVIATIONS * median(points.uncertainties().to_vec());
    let seen = (0..DIRECTIONS).into_par_iter().map(|i| seen_from(points, direction(i), (spacing_m, noise_m)));
    let either = |mut a: Vec<bool>, b: Vec<bool>| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a |= b);
        a
    };
    seen.reduce(|| vec![false; count], either)
}

/// Returns a direction of the Fibonacci lattice.
fn direction(i: usize) -> Vec3 {
    const GOLDEN_ANGLE: f32 = 2.399_963;
    let z = 1.0 - (2.0 * i as f32 + 1.0) / DIRECTIONS as f32;
    let (sin, cos) = (i as f32 * GOLDEN_ANGLE).sin_cos();
    let radius = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(radius * cos, radius * sin, z)
}

/// Returns the points that face a distant camera in this direction and lie behind no others.
fn seen_from(points: &OrientedPoints, to_camera: Vec3, (spacing_m, noise_m): (f32, f32)) -> Vec<bool> {
    let (right, up) = to_camera.any_orthonormal_pair();
    let flat: Vec<[f32; 3]> = points.positions().iter().map(|p| [p.dot(right), p.dot(up), p.dot(to_camera)]).collect();
    let bound = |k: usize, pick: fn(f32, f32) -> f32, start: f32| flat.iter().map(|p| p[k]).fold(start, pick);
    let low = [0, 1].map(|k| bound(k, f32::min, f32::INFINITY));
    let high = [0, 1].map(|k| bound(k, f32::max, f32::NEG_INFINITY));
    let extent = (high[0] - low[0]).max(high[1] - low[1]);
    let pixel = spacing_m.max(extent / MOST_PIXELS).max(f32::MIN_POSITIVE);
    let [width, height] = [0, 1].map(|k| ((high[k] - low[k]) / pixel) as usize + 3);
    let place = |p: &[f32; 3]| [0, 1].map(|k| ((p[k] - low[k]) / pixel) as usize + 1);
    let mut nearest = vec![f32::NEG_INFINITY; width * height];
    for p in &flat {
        // Points cover their neighbouring pixels, so that a surface has no gaps.
        let [x, y] = place(p);
        for row in y - 1..=y + 1 {
            for value in &mut nearest[row * width + x - 1..=row * width + x + 1] {
                *value = value.max(p[2]);
            }
        }
    }
    let is_seen = |(p, normal): (&[f32; 3], &Vec3)| {
        let [x, y] = place(p);
        // A slope through the neighbouring pixels hides nothing.
        let cosine = normal.dot(to_camera);
        let slope = (1.0 - cosine * cosine).max(0.0).sqrt() / cosine.max(FACING);
        cosine >= FACING && p[2] >= nearest[y * width + x] - (HIDDEN + 1.5 * slope) * pixel - noise_m
    };
    flat.iter().zip(points.normals()).map(is_seen).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::OrientedPoint;

    fn sphere(radius: f32, count: usize, inwards: bool) -> impl Iterator<Item = OrientedPoint> {
        (0..count).map(move |i| {
            let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
            let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
            let out = Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
            let normal = if inwards { -out } else { out };
            OrientedPoint { position: out * radius, normal, weight: 1.0, uncertainty_m: 0.001 }
        })
    }

    #[test]
    fn walls_inside_are_hidden_and_all_outside_is_seen() {
        let (outer, inner) = (20_000, 3000);
        let points = OrientedPoints::from_rows(sphere(0.3, outer, false).chain(sphere(0.1, inner, true)));
        let spacing = (4.0 * std::f32::consts::PI * 0.09 / outer as f32).sqrt();
        let seen = visible(&points, spacing);
        assert!(seen[..outer].iter().all(|seen| *seen));
        assert!(!seen[outer..].iter().any(|seen| *seen));
    }

    #[test]
    fn a_hollow_is_seen_into() {
        // Half of the sphere is open.
        let points = OrientedPoints::from_rows(sphere(0.3, 20_000, true).filter(|point| point.position.z < 0.0));
        let seen = visible(&points, 0.0075);
        assert!(seen.iter().filter(|seen| **seen).count() > 9900);
    }

    #[test]
    fn absurd_points_are_bounded() {
        assert!(visible(&OrientedPoints::default(), 0.01).is_empty());
        let far = OrientedPoint { position: Vec3::splat(1e20), normal: Vec3::X, weight: 1.0, uncertainty_m: 0.0 };
        let points = OrientedPoints::from_rows(sphere(0.3, 10, false).chain([far]));
        for spacing in [0.0, 1e-30, f32::NAN, f32::INFINITY] {
            assert_eq!(visible(&points, spacing).len(), 11, "{spacing}");
        }
    }
}
