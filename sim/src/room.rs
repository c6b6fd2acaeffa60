//! The room behind the person: planks, four walls, and light from above.

use flyrig_types::{Camera, Intrinsics};
use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;

use crate::noise::{Noise, smoothstep};
use crate::texture::{linear_from_srgb, mix3, scale3, srgb_from_linear};
use crate::wardrobe::Srgb;

/// Ceiling height, metres.
const HEIGHT_M: f32 = 3.4;
/// Samples a pixel side.
const SAMPLES: usize = 2;
/// Marks pixels that do not show the floor.
pub(crate) const NO_FLOOR: [f32; 2] = [1e9, 1e9];

/// A square room around the world's origin.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Room {
    half_m: f32,
    noise: Noise,
    walls: [Srgb; 4],
}

/// A camera's view of the empty room.
pub(crate) struct Plate {
    /// sRGB.
    pub rgba: Vec<[u8; 4]>,
    /// World x, y of the floor at the pixel's centre, or [`NO_FLOOR`].
    pub floor: Vec<[f32; 2]>,
}

/// Directions through the lens, on a grid of pixels; the same for all cameras of a ring.
pub(crate) struct LensGrid {
    columns: usize,
    ideal: Vec<DVec2>,
}

impl LensGrid {
    const CELL_PX: f64 = 8.0;

    /// Inverts the lens at every eighth pixel; `None` where it folds.
    pub(crate) fn new(intrinsics: &Intrinsics) -> Option<Self> {
        let cells = |side: u32| (f64::from(side) / Self::CELL_PX).ceil() as usize + 2;
        let (columns, rows) = (cells(intrinsics.width), cells(intrinsics.height));
        let ideal: Option<Vec<DVec2>> = (0..columns * rows)
            .into_par_iter()
            .map(|i| {
                let pixel = DVec2::new((i % columns) as f64, (i / columns) as f64) * Self::CELL_PX - 0.5;
                intrinsics.lens.undistort((pixel - intrinsics.center_px) / intrinsics.focal_px)
            })
            .collect();
        Some(Self { columns, ideal: ideal? })
    }

    /// Ideal image plane at a pixel of the picture.
    fn at(&self, pixel: DVec2) -> DVec2 {
        let cell = (pixel + 0.5) / Self::CELL_PX;
        let low = cell.floor();
        let t = cell - low;
        let at = |dx: usize, dy: usize| self.ideal[(low.y as usize + dy) * self.columns + low.x as usize + dx];
        at(0, 0).lerp(at(1, 0), t.x).lerp(at(0, 1).lerp(at(1, 1), t.x), t.y)
    }
}

impl Room {
    pub(crate) fn new(seed: u64, radius_m: f64) -> Self {
        let walls = [[0.70, 0.66, 0.58], [0.52, 0.60, 0.62], [0.66, 0.58, 0.54], [0.58, 0.62, 0.55]];
        Self { half_m: radius_m as f32 + 1.3, noise: Noise::new(seed, 40), walls }
    }

    /// The room as a camera sees it.
    pub(crate) fn plate(&self, camera: &Camera, grid: &LensGrid) -> Plate {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let eye = camera.position();
        let world_from_camera = camera.camera_from_world.rotation.inverse();
        let ray = |pixel: DVec2| (world_from_camera * grid.at(pixel).extend(1.0)).normalize_or(DVec3::NEG_Z).as_vec3();
        let eye = eye.as_vec3();
        let (rgba, floor) = (0..width * height)
            .into_par_iter()
            .map(|i| {
                let pixel = DVec2::new((i % width) as f64, (i / width) as f64);
                let mut light = Vec3::ZERO;
                for s in 0..SAMPLES * SAMPLES {
                    let step = 1.0 / SAMPLES as f64;
                    let offset = DVec2::new((s % SAMPLES) as f64, (s / SAMPLES) as f64) * step + 0.5 * step - 0.5;
                    light += self.radiance(eye, ray(pixel + offset));
                }
                let [r, g, b] = (light / (SAMPLES * SAMPLES) as f32)
                    .to_array()
                    .map(|c| (srgb_from_linear(c.clamp(0.0, 1.0)) * 255.0).round() as u8);
                let centre = ray(pixel);
                let floor = match self.hit(eye, centre) {
                    (0, point) => [point.x, point.y],
                    _ => NO_FLOOR,
                };
                ([r, g, b, 255], floor)
            })
            .unzip();
        Plate { rgba, floor }
    }

    /// First surface along a ray: 0 floor, 1 ceiling, 2 to 5 walls.
    fn hit(&self, eye: Vec3, ray: Vec3) -> (usize, Vec3) {
        let h = self.half_m;
        let distances = [
            (0.0 - eye.z) / ray.z,
            (HEIGHT_M - eye.z) / ray.z,
            (h - eye.x) / ray.x,
            (-h - eye.x) / ray.x,
            (h - eye.y) / ray.y,
            (-h - eye.y) / ray.y,
        ];
        let mut first = (1, f32::INFINITY);
        for (surface, &t) in distances.iter().enumerate() {
            if t > 1e-4 && t < first.1 {
                first = (surface, t);
            }
        }
        (first.0, eye + ray * first.1.min(100.0))
    }

    /// Linear light along a ray.
    fn radiance(&self, eye: Vec3, ray: Vec3) -> Vec3 {
        let (surface, p) = self.hit(eye, ray);
        let (colour, light) = match surface {
            0 => (self.planks(p), 0.55 + 0.55 * smoothstep(3.6, 0.0, Vec2::new(p.x, p.y).length())),
            1 => ([0.80, 0.80, 0.79], 0.75),
            wall => {
                let along = if wall < 4 { p.y } else { p.x };
                let wash = 0.55 + 0.40 * smoothstep(0.0, 2.6, p.z) * (0.8 + 0.2 * (along * 1.3).cos());
                let corner = smoothstep(0.0, 0.9, self.half_m - along.abs());
                (self.wall(wall - 2, along, p.z), wash * (0.72 + 0.28 * corner))
            }
        };
        // Where surfaces meet less light arrives.
        let meet = if surface > 1 {
            smoothstep(0.0, 0.35, p.z)
        } else {
            smoothstep(0.0, 0.6, self.half_m - p.x.abs().max(p.y.abs()))
        };
        Vec3::from(colour.map(linear_from_srgb)) * light * (0.70 + 0.30 * meet)
    }

    fn planks(&self, p: Vec3) -> Srgb {
        const WIDTH_M: f32 = 0.16;
        const LENGTH_M: f32 = 1.4;
        let row = (p.x / WIDTH_M).floor();
        let shifted = p.y / LENGTH_M + 0.5 + 0.37 * row;
        let plank = shifted.floor();
        let tone = self.noise.cell(row as i32, plank as i32, 7);
        let grain = self.noise.sum(Vec3::new(p.x * 60.0, p.y * 3.0 + 9.0 * tone, 10.0 * tone), 3);
        let wood = mix3([0.55, 0.42, 0.30], [0.68, 0.54, 0.39], 0.5 + 0.5 * tone);
        let across = (p.x / WIDTH_M - row - 0.5).abs() * WIDTH_M;
        let along = (shifted - plank - 0.5).abs() * LENGTH_M;
        let gap = smoothstep(WIDTH_M / 2.0 - 0.004, WIDTH_M / 2.0 - 0.001, across).max(smoothstep(
            LENGTH_M / 2.0 - 0.004,
            LENGTH_M / 2.0 - 0.001,
            along,
        ));
        scale3(wood, (1.0 + 0.14 * grain) * (1.0 - 0.45 * gap))
    }

    fn wall(&self, wall: usize, along: f32, z: f32) -> Srgb {
        let base = self.walls[wall];
        let plaster = 1.0 + 0.03 * self.noise.sum(Vec3::new(along * 6.0, z * 6.0, wall as f32 * 9.0), 3);
        let mut colour = scale3(base, plaster);
        // A darker dado with a rail, and a skirting board.
        colour = mix3(colour, scale3(base, 0.80), smoothstep(0.905, 0.900, z));
        colour = mix3(colour, [0.86, 0.84, 0.80], smoothstep(0.035, 0.030, (z - 0.92).abs()));
        colour = mix3(colour, [0.86, 0.84, 0.80], smoothstep(0.125, 0.120, z));
        // Framed pictures, different on each wall.
        for k in -1i32..=1 {
            let centre = k as f32 * 2.1 + 0.45 * self.noise.cell(k, wall as i32, 3);
            let size = Vec2::new(0.42 + 0.14 * self.noise.cell(k, wall as i32, 4), 0.36);
            let q = Vec2::new((along - centre).abs(), (z - 1.75).abs()) - size;
            let edge = q.x.max(q.y);
            if edge < 0.05 {
                let tint = [5, 6, 8].map(|c| 0.52 + 0.11 * self.noise.cell(k, wall as i32, c));
                let scene = self.noise.sum(Vec3::new(along * 3.0, z * 4.0, 20.0 + wall as f32), 4);
                let picture = mix3(tint, scale3(tint, 0.5), smoothstep(-0.15, 0.2, scene + 1.6 * (z - 1.75)));
                colour = if edge < 0.0 { picture } else { [0.22, 0.18, 0.15] };
            }
        }
        colour
    }
}
