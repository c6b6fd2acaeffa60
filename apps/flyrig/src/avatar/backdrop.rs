//! Backdrop of videos: a floor with a grid and the contact shadow of the person, which show where the feet stand.

use std::f64::consts::TAU;

use flyrig_body::{BodyError, SurfaceGaussians, Template, sample_surface, skin_point_f64};
use flyrig_types::{Camera, Pose, RenderedView};
use glam::{DVec2, DVec3};
use image::RgbImage;
use rayon::prelude::*;

/// Brightness of the wall and the floor, sRGB, 0..=255.
const WALL: f64 = 226.0;
const FLOOR: f64 = 206.0;
/// Distance and width of the grid's lines, metres, and their brightness relative to the floor.
const GRID_M: f64 = 0.5;
const LINE_M: f64 = 0.008;
const LINE: f64 = 0.93;
/// Radius of the floor: a multiple of the person's reach and a distance more, metres; and the inner part that does not fade.
const REACHES: f64 = 1.3;
const AROUND_M: f64 = 0.9;
const SOLID: f64 = 0.6;
/// Side of a cell of the shadow, metres.
const CELL_M: f64 = 0.015;
/// Height up to which the surface casts a shadow, metres.
const HIGHEST_M: f64 = 0.4;
/// Standard deviation of a point's shadow on the floor, and its growth with height, metres.
const SHARP_M: f64 = 0.018;
const SPREAD: f64 = 0.4;
/// Number of points of the surface, 16 mm apart on an adult, that cast a shadow.
const POINTS: usize = 8000;
/// Largest darkening by the shadow, 0..=1.
const DARKEST: f64 = 0.65;

/// Floor at z = 0, a disc, and the surface that casts a shadow on it.
pub(super) struct FloorDisc {
    middle: DVec2,
    radius_m: f64,
    body: Template,
    /// Points of the body's surface, evenly spaced, and the area of each.
    points: SurfaceGaussians,
    each_m2: f64,
}

impl FloorDisc {
    /// Returns a floor on which everything within `reach_m` of the middle stands.
    ///
    /// # Errors
    /// The body has no surface.
    pub fn new(middle: DVec2, reach_m: f64, body: Template) -> Result<Self, BodyError> {
        let points = sample_surface(&body, POINTS, 1)?;
        let each_m2 = body.area_m2() / POINTS as f64;
        Ok(Self { middle, radius_m: REACHES * reach_m + AROUND_M, body, points, each_m2 })
    }

    /// Paints a view of the body in a pose over the backdrop.
    pub fn paint(&self, camera: &Camera, view: &RenderedView, pose: &Pose) -> RgbImage {
        let matrices = self.body.skeleton.world_from_canonical(pose);
        let points = self.points.positions.iter().zip(&self.points.skin);
        let points = points.map(|(place, skin)| skin_point_f64(&matrices, skin, place.as_dvec3())).collect();
        self.paint_over(camera, view, &Shadow::new(points, self.each_m2))
    }

    fn paint_over(&self, camera: &Camera, view: &RenderedView, shadow: &Shadow) -> RgbImage {
        let world_from_camera = camera.camera_from_world.inverse();
        let (eye, intrinsics) = (world_from_camera.translation, camera.intrinsics);
        let mut image = RgbImage::new(view.width, view.height);
        let width = view.width.max(1) as usize;
        let rows = image.par_chunks_exact_mut(3 * width).zip(view.rgba.par_chunks_exact(4 * width)).enumerate();
        rows.for_each(|(row, (to, from))| {
            for (column, (to, from)) in to.chunks_exact_mut(3).zip(from.chunks_exact(4)).enumerate() {
                let ideal = (DVec2::new(column as f64, row as f64) - intrinsics.center_px) / intrinsics.focal_px;
                let ray = world_from_camera.rotation * ideal.extend(1.0);
                let behind = self.brightness(eye, ray, intrinsics.focal_px.x, shadow);
                let alpha = f64::from(from[3]) / 255.0;
                for (to, from) in to.iter_mut().zip(from) {
                    *to = (alpha * f64::from(*from) + (1.0 - alpha) * behind).round() as u8;
                }
            }
        });
        image
    }

    /// Returns the brightness that a ray meets, sRGB, 0..=255. Its length is that of one unit of depth.
    fn brightness(&self, eye: DVec3, ray: DVec3, focal_px: f64, shadow: &Shadow) -> f64 {
        let depth = -eye.z / ray.z;
        if !(depth.is_finite() && depth > 0.0) {
            return WALL;
        }
        let at = eye.truncate() + ray.truncate() * depth;
        let share = 1.0 - smooth((at.distance(self.middle) / self.radius_m - SOLID) / (1.0 - SOLID));
        if share <= 0.0 {
            return WALL;
        }
        // Size of a pixel on the floor, lengthways: lines become fainter where they are thinner than it.
        let pixel_m = depth / focal_px * ray.length() / (ray.z.abs() / ray.length()).max(1e-3);
        let line = |x: f64| {
            let off = (x / GRID_M - (x / GRID_M).round()).abs() * GRID_M;
            let wide = LINE_M.max(pixel_m);
            (1.0 - off / wide).max(0.0) * LINE_M / wide
        };
        let lines = line(at.x).max(line(at.y));
        let floor = FLOOR * (1.0 - (1.0 - LINE) * lines) * (1.0 - shadow.at(at));
        WALL + (floor - WALL) * share
    }
}

fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

/// Darkening of the floor by surfaces close to it, in square cells.
struct Shadow {
    low: DVec2,
    columns: usize,
    cells: Vec<f64>,
}

impl Shadow {
    /// Returns the shadow of points of `each_m2` each; world, metres.
    fn new(mut points: Vec<DVec3>, each_m2: f64) -> Self {
        points.retain(|place| place.is_finite() && place.z < HIGHEST_M);
        let bounds = |low: DVec2, high: DVec2, at: &DVec3| (low.min(at.truncate()), high.max(at.truncate()));
        let (low, high) = points.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(a, b), at| bounds(a, b, at));
        let size = high - low;
        // A person is not larger than ten metres.
        if !(size.min_element() >= 0.0 && size.max_element() < 10.0) {
            return Self { low: DVec2::ZERO, columns: 0, cells: Vec::new() };
        }
        let margin = 3.0 * (SHARP_M + SPREAD * HIGHEST_M);
        let low = low - margin;
        let [columns, rows] = [size.x, size.y].map(|side| ((side + 2.0 * margin) / CELL_M).ceil() as usize + 1);
        let mut cells = vec![0.0; columns * rows];
        for point in points {
            let height = point.z.max(0.0);
            let deviation = SHARP_M + SPREAD * height;
            let weight = each_m2 / (TAU * deviation * deviation) * (1.0 - height / HIGHEST_M).powi(2);
            let middle = (point.truncate() - low) / CELL_M;
            let radius = 3.0 * deviation / CELL_M;
            let range = |middle: f64, count: usize| {
                (middle - radius).max(0.0) as usize..=((middle + radius).max(0.0) as usize).min(count - 1)
            };
            for row in range(middle.y, rows) {
                for column in range(middle.x, columns) {
                    let off = (DVec2::new(column as f64, row as f64) - middle) * CELL_M / deviation;
                    cells[row * columns + column] += weight * (-0.5 * off.length_squared()).exp();
                }
            }
        }
        cells.iter_mut().for_each(|cell| *cell = DARKEST * (1.0 - (-*cell).exp()));
        Self { low, columns, cells }
    }

    /// Returns the darkening at a place of the floor, 0..=1, interpolated between cells.
    fn at(&self, place: DVec2) -> f64 {
        let at = (place - self.low) / CELL_M;
        let cell = |column: f64, row: f64| {
            let is_inside = column >= 0.0 && row >= 0.0 && (column as usize) < self.columns;
            let index = (row.max(0.0) as usize).saturating_mul(self.columns).saturating_add(column.max(0.0) as usize);
            if is_inside { self.cells.get(index).copied().unwrap_or(0.0) } else { 0.0 }
        };
        let (low, t) = (at.floor(), at - at.floor());
        let along = |row: f64| cell(low.x, row) * (1.0 - t.x) + cell(low.x + 1.0, row) * t.x;
        along(low.y) * (1.0 - t.y) + along(low.y + 1.0) * t.y
    }
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};
    use flyrig_types::{Intrinsics, Isometry};

    use super::*;

    const SIZE: u32 = 120;

    fn floor() -> FloorDisc {
        FloorDisc::new(DVec2::ZERO, 1.0, default_template(&ShapeParams::default()).unwrap()).unwrap()
    }

    fn camera(eye: DVec3) -> Camera {
        Camera::new(
            "view",
            Intrinsics::pinhole(SIZE, SIZE, 1.2 * f64::from(SIZE)),
            Isometry::look_at(eye, DVec3::new(0.0, 0.0, 0.3), DVec3::Z),
        )
    }

    fn empty() -> RenderedView {
        RenderedView { width: SIZE, height: SIZE, rgba: vec![0; 4 * (SIZE * SIZE) as usize] }
    }

    /// Returns the brightness where a point of the world is seen.
    fn seen(image: &RgbImage, camera: &Camera, place: DVec3) -> u8 {
        let pixel = camera.project(place).unwrap().round();
        image.get_pixel(pixel.x as u32, pixel.y as u32).0[0]
    }

    /// Returns points of a sole of 10 x 26 cm at a height, 0.65 cm2 each.
    fn sole(height: f64) -> Vec<DVec3> {
        (0..400).map(|i| DVec3::new(f64::from(i % 20) * 0.005, f64::from(i / 20) * 0.013, height)).collect()
    }

    #[test]
    fn a_shadow_is_below_what_stands_and_fades_with_its_height() {
        let (floor, camera) = (floor(), camera(DVec3::new(0.4, -3.0, 1.6)));
        let below = DVec3::new(0.05, 0.13, 0.0);
        let darkness = |points: Vec<DVec3>| {
            let image = floor.paint_over(&camera, &empty(), &Shadow::new(points, 6.5e-5));
            (seen(&image, &camera, below), seen(&image, &camera, DVec3::new(0.7, 0.13, 0.0)))
        };
        let (bare, _) = darkness(Vec::new());
        let heights = [0.0, 0.1, 0.2, 0.5].map(|height| darkness(sole(height)));
        assert!(heights.is_sorted_by_key(|(under, _)| *under), "{heights:?}");
        assert!(heights[0].0 + 50 < bare && heights[3].0 == bare, "{heights:?} {bare}");
        assert!(heights.iter().all(|(_, aside)| *aside + 8 > bare), "{heights:?}");
        let poisoned = [sole(0.0), vec![DVec3::NAN, DVec3::INFINITY]].concat();
        assert!(darkness(poisoned).0 == heights[0].0);
        assert_eq!(darkness(vec![DVec3::ZERO, DVec3::X * 1e30]).0, bare);
    }

    #[test]
    fn feet_darken_the_floor_where_they_stand_and_not_where_they_float() {
        let (floor, camera) = (floor(), camera(DVec3::new(0.0, -3.0, 1.6)));
        let mut pose = floor.body.skeleton.rest_pose();
        let up = glam::DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
        pose.root_translation = up * pose.root_translation;
        pose.joint_rotations[0] = up * pose.joint_rotations[0];
        let origins = floor.body.skeleton.canonical_origins();
        let foot = origins[floor.body.skeleton.joint("LeftFoot").unwrap()];
        let below = DVec3::new(foot.x, -foot.z - 0.05, 0.0);
        let darkness = |pose: &Pose| seen(&floor.paint(&camera, &empty(), pose), &camera, below);
        let standing = darkness(&pose);
        pose.root_translation.z += 0.3;
        let floating = darkness(&pose);
        assert!(standing + 40 < floating, "{standing} {floating}");
        pose.root_translation = DVec3::NAN;
        assert!(darkness(&pose) >= floating);
    }

    #[test]
    fn the_person_covers_the_backdrop_and_the_sky_is_wall() {
        let (floor, shadow) = (floor(), |points| Shadow::new(points, 6.5e-5));
        let camera = camera(DVec3::new(0.0, -3.0, 1.0));
        let mut view = empty();
        view.rgba[..4].copy_from_slice(&[10, 200, 30, 255]);
        view.rgba[4..8].copy_from_slice(&[10, 200, 30, 128]);
        let image = floor.paint_over(&camera, &view, &shadow(Vec::new()));
        assert_eq!(image.get_pixel(0, 0).0, [10, 200, 30]);
        let half = image.get_pixel(1, 0).0;
        assert!(half[0].abs_diff(118) < 3 && half[1].abs_diff(213) < 3, "{half:?}");
        assert_eq!(image.get_pixel(5, 0).0, [WALL as u8; 3]);
        assert!(f64::from(seen(&image, &camera, DVec3::new(0.2, 0.2, 0.0))) < WALL - 10.0);
        // A camera in the floor, and an image of nothing.
        let level = Camera { camera_from_world: Isometry::look_at(DVec3::NEG_Y, DVec3::ZERO, DVec3::Z), ..camera };
        assert_eq!(floor.paint_over(&level, &empty(), &shadow(sole(0.0))).dimensions(), (SIZE, SIZE));
        let nothing = RenderedView { width: 0, height: 0, rgba: Vec::new() };
        assert_eq!(floor.paint_over(&level, &nothing, &shadow(Vec::new())).dimensions(), (0, 0));
    }
}
