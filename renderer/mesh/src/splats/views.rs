//! Virtual cameras on all sides of Gaussians at unit size, and the surface points that their pixels show.

use std::f64::consts::PI;

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{Outputs, PixelPlane, RasterSettings, Rasterizer, RenderTarget, SplatFilter};
use flyrig_types::{Camera, ColorMatch, Intrinsics, Isometry};
use glam::{DVec3, Mat3, Vec2, Vec3};

use crate::OrientedPoint;
use crate::splats::prepare::Prepared;

/// Number of cameras.
pub(super) const VIEWS: usize = 64;
/// Distance of the cameras from the middle, in radii: far, so that perspective hides little.
const DISTANCE: f64 = 4.0;
/// Pixels between neighbouring Gaussians, and between the points that are taken of an image.
const STRIDE: u32 = 2;
/// Pixels along a side of an image: at most 20 bytes each stay in memory, 0.8 GB in all.
const SIDES: std::ops::RangeInclusive<f64> = 64.0..=768.0;
/// Unused pixels along the border.
const BORDER: f64 = 2.0;
/// Least alpha of a pixel that shows a surface.
const SOLID: f32 = 0.5;
/// Alpha below which a line of sight is empty.
const EMPTY: f32 = 0.1;
/// Least cosine between the normal and the line of sight of a point, and of a colour.
const GRAZING: f32 = 0.2;
const COLOR_GRAZING: f32 = 0.3;
/// Largest cosine between normal and line of sight at a contour.
const CONTOUR: f32 = 0.05;
/// Least cosine between the normals of a pixel's Gaussians and of the depths around it, below which the depths decide.
const LIKE: f32 = 0.7;
/// Exponent of the cosine in the weight of a colour: the views that face the surface decide.
const SHARPNESS: i32 = 8;

/// Image of a virtual camera, a pinhole with square pixels.
pub(super) struct View {
    /// Camera axes from unit-size axes.
    rotation: Mat3,
    translation: Vec3,
    focal_px: f32,
    /// Principal point along both axes, pixels.
    center_px: f32,
    /// Pixels along a side.
    pub side: u32,
    /// Width of a pixel at the middle of the Gaussians, unit size.
    pub pixel: f32,
    /// Linear RGB times alpha.
    color: Vec<[f32; 3]>,
    alpha: Vec<f32>,
    /// Camera-space z of the surface; 0 where there is none.
    depth: Vec<f32>,
}

/// Pixels around a place in an image, with their weights.
type Around = [(usize, f32); 4];

/// Renders all virtual cameras, and returns the points of the surface that their pixels show, in metres.
///
/// # Errors
/// [`GpuError`].
pub(super) fn render(
    gpu: &GpuContext,
    prepared: &Prepared,
    filter: SplatFilter,
) -> Result<(Vec<View>, Vec<OrientedPoint>), GpuError> {
    let buffers = prepared.splats.upload(gpu)?;
    let mut rasterizer = Rasterizer::new(gpu, buffers.count())?;
    let pixel = f64::from(prepared.spacing_m) / f64::from(STRIDE) / prepared.unit.scale_m();
    let half_angle = (1.0 / DISTANCE).asin().tan();
    let distance = DISTANCE * prepared.radius;
    let side = (2.0 * (distance / pixel * half_angle + BORDER)).ceil().clamp(*SIDES.start(), *SIDES.end());
    let focal_px = (0.5 * side - BORDER) / half_angle;
    let side = side as u32;
    let target = RenderTarget::of_color(gpu, side, side)?.with_planes(gpu)?;
    let settings = filter.applied(RasterSettings { outputs: Outputs::PLANES, ..RasterSettings::default() });
    let (mut views, mut points) = (Vec::with_capacity(VIEWS), Vec::new());
    for (k, direction) in directions().enumerate() {
        let up = if direction.y.abs() < 0.9 { DVec3::Y } else { DVec3::X };
        let eye = prepared.center + direction * distance;
        let camera = Camera {
            id: "virtual".into(),
            intrinsics: Intrinsics::pinhole(side, side, focal_px),
            camera_from_world: Isometry::look_at(eye, prepared.center, up),
            time_offset_nanos: 0,
            color: ColorMatch::NONE,
        };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        rasterizer.encode(gpu, &mut encoder, &buffers, &camera, &settings, &target)?;
        gpu.queue.submit([encoder.finish()]);
        let color = target.color.read(gpu)?;
        let planes = target.planes.as_ref().map_or(Ok(Vec::new()), |planes| planes.read(gpu))?;
        let (view, normals) = View::new(&camera, (distance / focal_px) as f32, &color, &planes);
        let phase = [k as u32 % STRIDE, k as u32 / STRIDE % STRIDE];
        view.push_points(&normals, phase, prepared, &mut points);
        views.push(view);
    }
    Ok((views, points))
}

/// Returns directions that are spread evenly over a sphere.
fn directions() -> impl Iterator<Item = DVec3> {
    let turn = PI * (3.0 - 5f64.sqrt());
    (0..VIEWS).map(move |k| {
        let y = 1.0 - (2 * k + 1) as f64 / VIEWS as f64;
        let (sin, cos) = (turn * k as f64).sin_cos();
        let across = (1.0 - y * y).sqrt();
        DVec3::new(across * cos, y, across * sin)
    })
}

impl View {
    /// Takes the images of a camera; returns the normals of the pixels too, in unit-size axes.
    fn new(camera: &Camera, pixel: f32, color: &[[f32; 4]], planes: &[[f32; 4]]) -> (Self, Vec<Vec3>) {
        let rotation = Mat3::from_quat(camera.camera_from_world.rotation.as_quat());
        let shown = |(color, sums): (&[f32; 4], &[f32; 4])| match PixelPlane::new(*sums, color[3], SOLID) {
            Some(plane) => (plane.depth_m, rotation.transpose() * Vec3::from(plane.normal)),
            None => (0.0, Vec3::ZERO),
        };
        let (depth, normals) = color.iter().zip(planes).map(shown).unzip();
        let view = Self {
            rotation,
            translation: camera.camera_from_world.translation.as_vec3(),
            focal_px: camera.intrinsics.focal_px.x as f32,
            center_px: camera.intrinsics.center_px.x as f32,
            side: camera.intrinsics.width,
            pixel,
            color: color.iter().map(|[red, green, blue, _]| [*red, *green, *blue]).collect(),
            alpha: color.iter().map(|[.., alpha]| *alpha).collect(),
            depth,
        };
        (view, normals)
    }

    /// Returns the camera's position.
    fn eye(&self) -> Vec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// Returns the place that a pixel shows; `None` where no surface is.
    fn place(&self, x: u32, y: u32) -> Option<Vec3> {
        let z = self.depth[(y * self.side + x) as usize];
        let across = (Vec2::new(x as f32, y as f32) - self.center_px) / self.focal_px;
        (z > 0.0).then(|| self.rotation.transpose() * (across.extend(1.0) * z - self.translation))
    }

    /// Appends every [`STRIDE`]th pixel from `phase` on as a surface point, metres. Pixels seen at a grazing angle and those beside a
    /// border of the surface are left out: their depths mix what lies in front and behind.
    fn push_points(&self, normals: &[Vec3], phase: [u32; 2], prepared: &Prepared, points: &mut Vec<OrientedPoint>) {
        let (eye, scale) = (self.eye(), prepared.unit.scale_m() as f32);
        let far = prepared.spacing_m / scale;
        let inner = |first: u32| (first.max(1)..self.side.saturating_sub(1)).step_by(STRIDE as usize);
        for y in inner(phase[1] + STRIDE) {
            for x in inner(phase[0] + STRIDE) {
                let at = (y * self.side + x) as usize;
                let around = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)].map(|(x, y)| self.place(x, y));
                let (Some(place), [Some(left), Some(right), Some(above), Some(below)]) = (self.place(x, y), around)
                else {
                    continue;
                };
                let sight = (eye - place).normalize_or_zero();
                // Rows go down, so this faces the camera.
                let of_depths = (below - above).cross(right - left).normalize_or_zero();
                // The shortest axis of a Gaussian that is nearly a ball points anywhere.
                let normal = if normals[at].dot(of_depths) < LIKE { of_depths } else { normals[at] };
                let facing = normal.dot(sight);
                let is_smooth = |other: &Vec3| normal.dot(*other - place).abs() < far;
                if facing < GRAZING || ![left, right, above, below].iter().all(is_smooth) {
                    continue;
                }
                points.push(OrientedPoint {
                    position: prepared.unit.restored(place.as_dvec3()),
                    normal,
                    weight: self.alpha[at] * facing,
                    uncertainty_m: 0.5 * self.pixel * scale / facing,
                });
            }
        }
    }

    /// Returns the depth of a place and the pixels around it; `None` outside of the image.
    fn project(&self, place: Vec3) -> Option<(f32, Around)> {
        let in_camera = self.rotation * place + self.translation;
        let pixel = in_camera.truncate() * (self.focal_px / in_camera.z) + self.center_px;
        let last = self.side as f32 - 1.0;
        if !(in_camera.z > 0.0 && pixel.cmpge(Vec2::ZERO).all() && pixel.cmplt(Vec2::splat(last)).all()) {
            return None;
        }
        let (first, part) = (pixel.floor(), pixel - pixel.floor());
        let at = first.y as usize * self.side as usize + first.x as usize;
        let row = self.side as usize;
        let [left, top] = [1.0 - part.x, 1.0 - part.y];
        let around =
            [(at, left * top), (at + 1, part.x * top), (at + row, left * part.y), (at + row + 1, part.x * part.y)];
        Some((in_camera.z, around))
    }

    /// Returns whether a place, unit size, lies on an empty line of sight, or more than `margin` in front of the surface.
    pub fn sees_through(&self, place: Vec3, margin: f32) -> bool {
        let Some((depth, around)) = self.project(place) else { return false };
        let alpha: f32 = around.iter().map(|(i, weight)| self.alpha[*i] * weight).sum();
        alpha < EMPTY || around.iter().all(|(i, _)| self.depth[*i] > 0.0 && depth < self.depth[*i] - margin)
    }

    /// Returns the distance along the unit normal from a point at the contour of the surface to where alpha falls below one half, unit
    /// size; negative where it has fallen before the point. `None` where the camera sees the point face-on or behind another surface by
    /// more than four times `tolerance`, and where alpha does not fall within `farthest`.
    pub fn to_contour(&self, place: Vec3, normal: Vec3, farthest: f32, tolerance: f32) -> Option<f32> {
        let sight = (place - self.eye()).normalize_or_zero();
        if normal.dot(sight).abs() > CONTOUR {
            return None;
        }
        let (depth, around) = self.project(place)?;
        if around.iter().any(|(i, _)| self.depth[*i] > 0.0 && depth > self.depth[*i] + 4.0 * tolerance) {
            return None;
        }
        let alpha = |distance: f32| -> Option<f32> {
            let (_, around) = self.project(place + normal * distance)?;
            Some(around.iter().map(|(i, weight)| self.alpha[*i] * weight).sum())
        };
        let mut before = alpha(0.0)?;
        let is_inside = before >= SOLID;
        let step = if is_inside { 0.5 * self.pixel } else { -0.5 * self.pixel };
        for k in 1..=(farthest / step.abs()) as usize {
            let now = alpha(k as f32 * step)?;
            if (now >= SOLID) != is_inside {
                return Some((k as f32 - 1.0 + (before - SOLID) / (before - now)) * step);
            }
            before = now;
        }
        None
    }

    /// Returns the linear colour of a point of the surface, given by place and unit normal, and its weight. `None` where the camera does
    /// not see it: another surface lies at least `tolerance` in front, or it faces away.
    pub fn color(&self, place: Vec3, normal: Vec3, tolerance: f32) -> Option<(Vec3, f32)> {
        let facing = normal.dot((self.eye() - place).normalize_or_zero());
        if facing < COLOR_GRAZING {
            return None;
        }
        let (depth, around) = self.project(place)?;
        let is_seen =
            |&(i, _): &(usize, f32)| self.depth[i] > 0.0 && (depth - self.depth[i]).abs() < tolerance / facing;
        if !around.iter().all(is_seen) {
            return None;
        }
        let alpha: f32 = around.iter().map(|(i, weight)| self.alpha[*i] * weight).sum();
        let color: Vec3 = around.iter().map(|(i, weight)| Vec3::from(self.color[*i]) * *weight).sum();
        Some((color / alpha, alpha * facing.powi(SHARPNESS)))
    }
}
