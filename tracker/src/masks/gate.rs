//! The region of an image that a posed body and its clothes may cover.

use flyrig_types::{Camera, Mask};
use glam::{DVec2, Vec3};
use rayon::prelude::*;

use crate::image::grid::Grid;

/// Reach of most clothes and hair beyond the fitted body, metres: the unit of a gate's distances.
const REACH_M: f64 = 0.13;
/// Reach of wide skirts and coats in that unit; beyond 1 a mask needs evidence from image and background.
const CLOTHES_REACH: f32 = 2.5;
/// Reach once the clothes are known, in that unit: a skirt is part of the drawn body, hair and loose sleeves remain.
const KNOWN_CLOTHES_REACH: f32 = 1.5;

/// Region of an image around a posed body.
#[derive(Debug, Clone)]
pub struct BodyGate {
    /// Width and height of the image.
    pub(crate) image: [usize; 2],
    /// Bounding box of the region, pixels: x0, y0, x1, y1 (ends excluded).
    pub(crate) bounds: [usize; 4],
    /// Distance to the projected body in units of [`REACH_M`], 0 on the body; covers the box.
    pub(crate) distance: Grid,
    /// Image scale at the body, pixels per metre.
    pub(crate) px_per_m: f64,
    /// Distance beyond which no pixel belongs to the person, in the unit of `distance`.
    pub(crate) reach: f32,
    /// Least and greatest depth of the body in the camera, metres.
    pub(crate) depths_m: [f64; 2],
}

impl BodyGate {
    /// Projects the world vertices (metres) and triangles of one or several bodies; `None` when they are out of the image.
    #[must_use]
    pub fn new(camera: &Camera, vertices: &[Vec3], triangles: &[[u32; 3]]) -> Option<Self> {
        let mut depths: Vec<f64> = vertices
            .iter()
            .step_by(37)
            .map(|v| camera.camera_from_world.transform_point(v.as_dvec3()).z)
            .filter(|z| *z > 0.1)
            .collect();
        let depth = flyrig_solve::median(&mut depths)?;
        let depths_m = depths.iter().fold([f64::INFINITY, 0.0], |[low, high], z| [z.min(low), z.max(high)]);
        let px_per_m = camera.intrinsics.focal_px.x / depth;
        let unit_px = REACH_M * px_per_m;
        let (bounds, body) = drawn_body(camera, vertices, triangles, unit_px * f64::from(CLOTHES_REACH))?;
        let mut distance = body.distance_to_set();
        for value in &mut distance.values {
            *value /= unit_px as f32;
        }
        let image = [camera.intrinsics.width as usize, camera.intrinsics.height as usize];
        Some(Self { image, bounds, distance, px_per_m, reach: CLOTHES_REACH, depths_m })
    }

    /// Returns the narrower gate of a body that was drawn in its known clothes.
    #[must_use]
    pub fn of_known_clothes(self) -> Self {
        Self { reach: KNOWN_CLOTHES_REACH, ..self }
    }

    /// Returns the range of depths along the camera's axis that person and clothes may occupy, metres.
    pub(crate) fn depth_range_m(&self) -> [f64; 2] {
        let reach = REACH_M * f64::from(self.reach);
        [(self.depths_m[0] - reach).max(0.05), self.depths_m[1] + reach]
    }

    /// Returns the unit of [`Self::distance`], pixels.
    pub(crate) fn unit_px(&self) -> f64 {
        REACH_M * self.px_per_m
    }

    /// Whether a pixel may show the body or its clothes.
    pub(crate) fn reaches(&self, x: usize, y: usize) -> bool {
        let [x0, y0, x1, y1] = self.bounds;
        (x0..x1).contains(&x)
            && (y0..y1).contains(&y)
            && self.distance.values[(y - y0) * self.distance.width + x - x0] < self.reach
    }

    /// Whether the pixel of an index, row by row, may show the body or its clothes.
    pub(crate) fn reaches_pixel(&self, pixel: usize) -> bool {
        self.reaches(pixel % self.image[0], pixel / self.image[0])
    }

    /// Returns the gate of a body drawn as 1 in a grid of the image's size.
    #[cfg(test)]
    pub(crate) fn of_grid(body: &Grid, px_per_m: f64) -> Self {
        let mut distance = body.distance_to_set();
        distance.values.iter_mut().for_each(|d| *d /= (REACH_M * px_per_m) as f32);
        Self {
            image: [body.width, body.height],
            bounds: [0, 0, body.width, body.height],
            distance,
            px_per_m,
            reach: CLOTHES_REACH,
            depths_m: [1.0; 2],
        }
    }

    /// Returns the intersection over union of a mask of the whole image and the projected body.
    pub(crate) fn overlap(&self, mask: &Mask) -> f64 {
        let [x0, y0, ..] = self.bounds;
        let (mut both, mut body) = (0usize, 0usize);
        for (i, distance) in self.distance.values.iter().enumerate() {
            let (x, y) = (i % self.distance.width + x0, i / self.distance.width + y0);
            let inside = mask.coverage()[y * mask.width() as usize + x] >= 128;
            let on_body = *distance <= 0.0;
            body += usize::from(on_body);
            both += usize::from(on_body && inside);
        }
        both as f64 / (mask.area_px() + body - both).max(1) as f64
    }
}

/// Vertices per parallel task.
const VERTICES_A_TASK: usize = 2048;

/// Draws a posed body (world vertices, metres). Returns its bounding box with a margin in pixels (x0, y0, x1, y1, ends
/// excluded) and a grid of that box that is 1 on the body; `None` when the body is out of the image.
pub(crate) fn drawn_body(
    camera: &Camera,
    vertices: &[Vec3],
    triangles: &[[u32; 3]],
    margin_px: f64,
) -> Option<([usize; 4], Grid)> {
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let project = |v: &Vec3| camera.project(v.as_dvec3());
    let pixels: Vec<Option<DVec2>> = vertices.par_iter().with_min_len(VERTICES_A_TASK).map(project).collect();
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for pixel in pixels.iter().flatten() {
        (low, high) = (low.min(*pixel), high.max(*pixel));
    }
    let side = |value: f64, limit: usize| value.clamp(0.0, limit as f64) as usize;
    let bounds = [
        side(low.x - margin_px, width),
        side(low.y - margin_px, height),
        side(high.x + margin_px + 1.0, width),
        side(high.y + margin_px + 1.0, height),
    ];
    if bounds[2] <= bounds[0] || bounds[3] <= bounds[1] {
        return None;
    }
    let mut body = Grid::new(bounds[2] - bounds[0], bounds[3] - bounds[1], 0.0);
    let origin = DVec2::new(bounds[0] as f64, bounds[1] as f64);
    let places: Vec<Option<DVec2>> = pixels.iter().map(|pixel| pixel.map(|pixel| pixel - origin)).collect();
    body.fill_mesh(&places, triangles);
    Some((bounds, body))
}
