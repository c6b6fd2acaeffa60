//! Which points of a surface cameras see.

use flyrig_types::Camera;
use glam::Vec3;
use rayon::prelude::*;

use super::depth::DepthImage;
use crate::harness::surface::Points;

/// Points farther behind the nearest surface than this are hidden, metres.
const HIDDEN_M: f64 = 0.005;

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

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::surfaces::bounds::cameras_around;

    /// Appends a cube around the origin, outward.
    pub fn add_cube(half: f32, (positions, triangles): &mut (Vec<Vec3>, Vec<[u32; 3]>)) {
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
}
