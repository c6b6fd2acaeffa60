//! Depth of a mesh in a camera's pixels. It shares no code with the renderer or the mesh crate, which it judges.

use flyrig_types::Camera;
use glam::{DVec2, DVec3, Vec3};

/// Depth along the optical axis in each pixel, and the triangle that is seen.
pub(super) struct DepthImage {
    width: usize,
    height: usize,
    /// Metres; infinite where nothing is seen.
    depths: Vec<f64>,
    triangles: Vec<u32>,
}

impl DepthImage {
    /// Renders a mesh in world metres. Triangles with a corner that the camera cannot see are left out; edges are straight in the image,
    /// also with a distorting lens.
    pub fn render(camera: &Camera, positions: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let [width, height] = camera.size().map(|side| side as usize);
        let mut image = Self {
            width,
            height,
            depths: vec![f64::INFINITY; width * height],
            triangles: vec![u32::MAX; width * height],
        };
        let projected: Vec<Option<(DVec2, f64)>> = positions
            .iter()
            .map(|position| {
                let depth = camera.camera_from_world.transform_point(position.as_dvec3()).z;
                Some((camera.project(position.as_dvec3())?, depth))
            })
            .collect();
        for (index, triangle) in (0u32..).zip(triangles) {
            let corners = triangle.map(|i| projected.get(i as usize).copied().flatten());
            if let [Some(a), Some(b), Some(c)] = corners {
                image.draw(index, [a, b, c]);
            }
        }
        image
    }

    fn draw(&mut self, index: u32, corners: [(DVec2, f64); 3]) {
        let [a, b, c] = corners.map(|corner| corner.0);
        let area = (b - a).perp_dot(c - a);
        if area.abs() < 1e-12 {
            return;
        }
        let low = a.min(b).min(c).ceil().max(DVec2::ZERO);
        let high = a.max(b).max(c).floor().min(DVec2::new(self.width as f64, self.height as f64) - 1.0);
        if !(low.cmple(high)).all() {
            return;
        }
        for y in low.y as usize..=high.y as usize {
            for x in low.x as usize..=high.x as usize {
                let pixel = DVec2::new(x as f64, y as f64);
                let shares =
                    [(b - pixel).perp_dot(c - pixel), (c - pixel).perp_dot(a - pixel), (a - pixel).perp_dot(b - pixel)]
                        .map(|part| part / area);
                if shares.iter().any(|share| *share < 0.0) {
                    continue;
                }
                // Inverse depth is linear in the image.
                let inverse: f64 = shares.iter().zip(corners).map(|(share, corner)| share / corner.1).sum();
                let at = y * self.width + x;
                if 1.0 / inverse < self.depths[at] {
                    (self.depths[at], self.triangles[at]) = (1.0 / inverse, index);
                }
            }
        }
    }

    /// Returns whether a world point, metres, is inside the image and at most `tolerance_m` behind the surface that is seen there.
    pub fn shows(&self, camera: &Camera, point: DVec3, tolerance_m: f64) -> bool {
        let Some(pixel) = camera.project(point).map(DVec2::round) else { return false };
        if !(pixel.cmpge(DVec2::ZERO).all() && pixel.x < self.width as f64 && pixel.y < self.height as f64) {
            return false;
        }
        let depth = self.depths[pixel.y as usize * self.width + pixel.x as usize];
        camera.camera_from_world.transform_point(point).z <= depth + tolerance_m
    }

    /// Returns the depth of each pixel along the optical axis, metres, row by row; infinite where nothing is seen.
    pub fn depths(&self) -> Vec<f32> {
        self.depths.iter().map(|depth| *depth as f32).collect()
    }

    /// Returns the world position, metres, and the triangle in each pixel that sees one.
    pub fn points(&self, camera: &Camera) -> Vec<(DVec3, u32)> {
        let forward = camera.camera_from_world.rotation.inverse() * DVec3::Z;
        let pixels = self.depths.iter().zip(&self.triangles).enumerate().filter(|(_, (depth, _))| depth.is_finite());
        let point = |(at, (depth, triangle)): (usize, (&f64, &u32))| {
            let ray = camera.ray(DVec2::new((at % self.width) as f64, (at / self.width) as f64))?;
            Some((camera.position() + ray * (depth / ray.dot(forward)), *triangle))
        };
        pixels.filter_map(point).collect()
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry};

    use super::*;

    #[test]
    fn the_nearest_surface_is_seen_and_points_return_to_it() {
        let camera_from_world = Isometry::look_at(DVec3::new(0.3, -3.0, 0.5), DVec3::ZERO, DVec3::Z);
        let camera = Camera::new("00", Intrinsics::pinhole(160, 120, 150.0), camera_from_world);
        // A tilted square, a smaller one behind it, and a triangle with a corner that does not exist.
        let square = |side: f32, y: f32| {
            [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
                .map(|[x, z]: [f32; 2]| Vec3::new(x * side, y + 0.4 * z * side, z * side))
        };
        let positions: Vec<Vec3> = square(0.5, 0.0).into_iter().chain(square(0.2, 0.5)).collect();
        let triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [0, 1, 99]];
        let image = DepthImage::render(&camera, &positions, &triangles);
        let points = image.points(&camera);
        assert!(points.len() > 1000, "{}", points.len());
        for (point, triangle) in &points {
            // Vertices are rounded to single precision.
            assert!(*triangle < 2, "the front hides the rest");
            assert!((point.y - 0.4 * point.z).abs() < 1e-6, "{point} is not on the front");
            assert!(image.shows(&camera, *point, 1e-6));
        }
        assert!(!image.shows(&camera, DVec3::new(0.0, 0.5, 0.0), 0.005), "the back is hidden");
        assert!(!image.shows(&camera, DVec3::new(0.0, -9.0, 0.0), 0.005), "behind the camera");
        assert!(!image.shows(&camera, DVec3::new(9.0, 0.0, 0.0), 0.005), "outside the image");
        assert!(!image.shows(&camera, DVec3::splat(f64::NAN), 0.005));
    }
}
