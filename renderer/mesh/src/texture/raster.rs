//! Triangles in the image of a camera, nearest first.

use flyrig_types::Camera;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// Vertex in the image of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Corner {
    /// Pixel; centres lie at integers.
    pub pixel: Vec2,
    /// Inverse of the depth along the optical axis, 1/metres.
    pub inverse_depth: f32,
}

/// Projects world points, metres, through the camera's lens; `None` for those that it does not show.
pub(super) fn project(camera: &Camera, positions: &[Vec3]) -> Vec<Option<Corner>> {
    let corner = |position: &Vec3| {
        let world = position.as_dvec3();
        let pixel = camera.project(world)?.as_vec2();
        let inverse_depth = (camera.camera_from_world.transform_point(world).z as f32).recip();
        (pixel.is_finite() && inverse_depth.is_finite()).then_some(Corner { pixel, inverse_depth })
    };
    positions.par_iter().with_min_len(1024).map(corner).collect()
}

/// Returns the corners of a triangle; `None` if one is not shown or does not exist.
pub(super) fn corners(projected: &[Option<Corner>], triangle: [u32; 3]) -> Option<[Corner; 3]> {
    let [a, b, c] = triangle.map(|i| projected.get(i as usize).copied().flatten());
    Some([a?, b?, c?])
}

/// Returns twice the signed area of a triangle in the image, square pixels: negative for one that is seen from outside.
pub(super) fn signed_area([a, b, c]: [Corner; 3]) -> f32 {
    (b.pixel - a.pixel).perp_dot(c.pixel - a.pixel)
}

/// Returns depth, metres, and weights on the surface of a point of a triangle, from its weights in the image.
fn in_perspective(corners: [Corner; 3], weights: [f32; 3]) -> (f32, [f32; 3]) {
    let parts: [f32; 3] = std::array::from_fn(|k| weights[k] * corners[k].inverse_depth);
    let sum: f32 = parts.iter().sum();
    (sum.recip(), parts.map(|part| part / sum))
}

/// Draws triangles into a depth buffer of width and height `size`, and calls `visit(pixel, triangle, weights)` wherever one is
/// nearer than those before it. Weights are those of the corners, correct in perspective. Returns the depth of each pixel, metres;
/// infinity where none is.
pub(super) fn draw(
    projected: &[Option<Corner>],
    triangles: &[[u32; 3]],
    [width, height]: [usize; 2],
    mut visit: impl FnMut(usize, usize, [f32; 3]),
) -> Vec<f32> {
    let mut depth = vec![f32::INFINITY; width * height];
    for (t, triangle) in triangles.iter().enumerate() {
        let Some(corners) = corners(projected, *triangle) else { continue };
        let area = signed_area(corners);
        if !area.is_finite() || area.abs() < 1e-9 {
            continue;
        }
        let [a, b, c] = corners.map(|corner| corner.pixel);
        let range = |low: f32, high: f32, end: usize| {
            let first = low.ceil().max(0.0) as usize;
            first..((high.floor() + 1.0).max(0.0) as usize).min(end)
        };
        for y in range(a.y.min(b.y).min(c.y), a.y.max(b.y).max(c.y), height) {
            for x in range(a.x.min(b.x).min(c.x), a.x.max(b.x).max(c.x), width) {
                let point = Vec2::new(x as f32, y as f32);
                let (v, w) = ((point - a).perp_dot(c - a) / area, (b - a).perp_dot(point - a) / area);
                let flat = [1.0 - v - w, v, w];
                // Pixels on an edge belong to both sides, so that no gap opens.
                if flat.iter().any(|weight| *weight < -1e-5) {
                    continue;
                }
                let (z, weights) = in_perspective(corners, flat);
                let pixel = y * width + x;
                if z < depth[pixel] {
                    depth[pixel] = z;
                    visit(pixel, t, weights);
                }
            }
        }
    }
    depth
}
