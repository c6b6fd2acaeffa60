//! Visibility of a surface from cameras, and virtual cameras on all sides of it.

use flyrig_types::{Camera, Intrinsics, Isometry};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::depth::DepthImage;
use crate::harness::surface::Points;

/// Points farther behind the nearest surface than this are hidden, metres.
const HIDDEN_M: f64 = 0.005;
/// Virtual cameras around a person, and their pixels along a side.
const AROUND: usize = 24;
const SIDE: u32 = 512;
/// Distance of virtual cameras from the person's centre, in its largest extents.
const DISTANCE: f64 = 2.5;

/// Returns whether one of the cameras sees each point, which lies on the surface and faces it. World metres.
pub(super) fn seen_by(cameras: &[Camera], positions: &[Vec3], triangles: &[[u32; 3]], points: &Points) -> Vec<bool> {
    let images: Vec<DepthImage> =
        cameras.par_iter().map(|camera| DepthImage::render(camera, positions, triangles)).collect();
    let is_seen = |(point, normal): (&Vec3, &Vec3)| {
        cameras.iter().zip(&images).any(|(camera, depths)| {
            let faces = normal.as_dvec3().dot(camera.position() - point.as_dvec3()) > 0.0;
            faces && depths.shows(camera, point.as_dvec3(), HIDDEN_M)
        })
    };
    points.points.par_iter().zip(&points.normals).map(is_seen).collect()
}

/// Returns virtual cameras evenly around a surface, above and below it too.
pub(super) fn cameras_around(positions: &[Vec3]) -> Vec<Camera> {
    let finite = || positions.iter().filter(|position| position.is_finite());
    let low = finite().fold(Vec3::INFINITY, |low, position| low.min(*position)).as_dvec3();
    let high = finite().fold(Vec3::NEG_INFINITY, |high, position| high.max(*position)).as_dvec3();
    if !low.is_finite() {
        return Vec::new();
    }
    let (center, extent) = (0.5 * (low + high), (high - low).max_element());
    let focal_px = f64::from(SIDE) * DISTANCE / 1.2;
    let camera = |i: usize| {
        // Fibonacci's spiral.
        let z = 1.0 - (2.0 * i as f64 + 1.0) / AROUND as f64;
        let (sin, cos) = (i as f64 * 2.399_963_229_728_653).sin_cos();
        let away = DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
        let up = if away.z.abs() > 0.9 { DVec3::X } else { DVec3::Z };
        let pose = Isometry::look_at(center + away * extent * DISTANCE, center, up);
        Camera::new(format!("around{i:02}"), Intrinsics::pinhole(SIDE, SIDE, focal_px), pose)
    };
    (0..AROUND).map(camera).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surfaces::{score::SurfaceScore, true_surface::TrueSurface};

    /// Appends a cube around the origin, outward.
    fn add_cube(half: f32, (positions, triangles): &mut (Vec<Vec3>, Vec<[u32; 3]>)) {
        let first = positions.len() as u32;
        positions.extend((0..8u32).map(|i| {
            let side = |bit: u32| if i & bit == 0 { -half } else { half };
            Vec3::new(side(1), side(2), side(4))
        }));
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        for [a, b, c, d] in faces.map(|face: [u32; 4]| face.map(|i| first + i)) {
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }

    #[test]
    fn a_cube_in_a_cube_is_hidden() {
        let mut both = Default::default();
        add_cube(0.5, &mut both);
        add_cube(0.4, &mut both);
        let (positions, triangles) = both;
        let points = Points::on(&positions, &triangles, 20_000);
        let seen = seen_by(&cameras_around(&positions), &positions, &triangles, &points);
        let is_outer = |point: &Vec3| point.abs().max_element() > 0.45;
        let share = |outer: bool| {
            let of = || points.points.iter().zip(&seen).filter(|(point, _)| is_outer(point) == outer);
            of().filter(|(_, seen)| **seen).count() as f64 / of().count() as f64
        };
        assert!(share(true) > 0.99 && share(false) < 1e-9, "{} {}", share(true), share(false));
        assert!(seen_by(&[], &positions, &triangles, &points).iter().all(|seen| !seen));
    }

    #[test]
    fn what_is_hidden_counts_for_accuracy_alone() {
        let mut cube = Default::default();
        add_cube(0.5, &mut cube);
        let (positions, triangles) = cube.clone();
        let points = Points::on(&positions, &triangles, 100_000);
        let truth = TrueSurface::new(positions, triangles, points, &[]);
        add_cube(0.4, &mut cube);
        let score = SurfaceScore::of(&cube.0, &cube.1, &truth);
        // 3.84 of 9.84 square metres are 100 mm inside.
        assert!((score.accuracy_mm - 39.0).abs() < 3.0 && score.completeness_mm < 5.0, "{score:?}");
        assert!(score.outer_mm < 5.0, "{score:?}");
    }
}
