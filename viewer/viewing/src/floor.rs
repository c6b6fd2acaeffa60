//! Floor under the people: a disc of light, and the shadow that people cast where they are close to it.
//!
//! Neither is measured: they show where a person stands. The floor is level with the lowest Gaussians; the shadow darkens by the area of
//! the Gaussians above each place, less with their height (ambient occlusion in its simplest form). The page draws the same with its own
//! shaders (`viewer/web/assets`).

use flyrig_types::{Camera, Rig};
use glam::{DVec3, Vec3, Vec4};

/// Number of places of the shadow along each side.
pub const SHADOW_SIDE: usize = 128;
/// Half the side of the shadow, metres.
const SHADOW_HALF_M: f32 = 3.0;
/// Least radius of the disc, metres.
const LEAST_RADIUS_M: f32 = 1.6;
/// Radius of the disc relative to the distance of the nearest camera from the centre, and its bound, metres.
const RADIUS_SHARE: f32 = 0.75;
const MOST_RADIUS_M: f32 = 2.6;
/// Height over which Gaussians cast no shadow any more, by a factor of e, metres.
const SHADOW_HEIGHT_M: f32 = 0.16;
/// Fraction of the Gaussians that may lie below the floor: the lowest are noise.
const BELOW: f64 = 0.002;
/// Fractions by which the floor follows lower and higher people per update: somebody who jumps takes no floor along.
const SINKS: f32 = 0.3;
const RISES: f32 = 0.004;
/// Number of Gaussians per one that is looked at.
const EVERY: usize = 2;
/// Brightness of the disc's centre relative to the backdrop, sRGB codes; and factor of the darkest shadow.
const LIGHT: f32 = 46.0;
const DARKEST: f32 = 0.3;

/// Floor of a rig.
#[derive(Debug, Clone, PartialEq)]
pub struct Floor {
    /// Two horizontal axes, and up.
    axes: [Vec3; 3],
    /// Centre of the disc, on the horizontal plane through the origin, metres.
    center: Vec3,
    radius: f32,
    /// Height of the floor along up, metres; `None` before the first person.
    level: Option<f32>,
    /// Darkness, 0..=255, by rows along the second axis.
    shadow: Vec<u8>,
    sums: Vec<f32>,
    heights: Vec<f32>,
}

impl Floor {
    /// Creates the floor of a rig, which is shown once a person stands on it.
    #[must_use]
    pub fn new(rig: &Rig) -> Self {
        let up = rig.world_up.try_normalize().unwrap_or(DVec3::Z);
        let x = if up.cross(DVec3::X).length() > 0.1 { DVec3::X } else { DVec3::Y };
        let x = (x - up * x.dot(up)).normalize();
        let center = rig.center_of_attention();
        let level = center - up * center.dot(up);
        let reach = |eye: DVec3| ((eye - center) - up * (eye - center).dot(up)).length() as f32;
        let nearest = rig.cameras.iter().map(|camera| reach(camera.position())).fold(f32::INFINITY, f32::min);
        Self {
            axes: [x, up.cross(x), up].map(DVec3::as_vec3),
            center: level.as_vec3(),
            radius: (RADIUS_SHARE * nearest).clamp(LEAST_RADIUS_M, MOST_RADIUS_M),
            level: None,
            shadow: vec![0; SHADOW_SIDE * SHADOW_SIDE],
            sums: Vec::new(),
            heights: Vec::new(),
        }
    }

    /// Follows the people: centres and standard deviations of all Gaussians, metres, world.
    pub fn update(&mut self, center_scale: &[[f32; 4]]) {
        let [x, y, up] = self.axes;
        let gaussians = || center_scale.iter().step_by(EVERY).map(|row| Vec4::from(*row)).filter(|row| row.is_finite());
        self.heights.clear();
        self.heights.extend(gaussians().map(|row| row.truncate().dot(up)));
        self.sums.clear();
        self.sums.resize(SHADOW_SIDE * SHADOW_SIDE, 0.0);
        let lowest = (BELOW * self.heights.len() as f64) as usize;
        if lowest < self.heights.len() {
            let low = *self.heights.select_nth_unstable_by(lowest, f32::total_cmp).1;
            let level = self.level.get_or_insert(low);
            *level += (low - *level) * if low < *level { SINKS } else { RISES };
        }
        let level = self.level.unwrap_or_default();
        let per_m = SHADOW_SIDE as f32 / (2.0 * SHADOW_HALF_M);
        let side = SHADOW_SIDE as f32;
        for row in gaussians() {
            let from_center = row.truncate() - self.center;
            let height = (from_center.dot(up) - level).max(0.0);
            let [u, v] = [x, y].map(|axis| (from_center.dot(axis) + SHADOW_HALF_M) * per_m);
            if height < 5.0 * SHADOW_HEIGHT_M && u >= 0.0 && v >= 0.0 && u < side && v < side {
                let area = EVERY as f32 * std::f32::consts::PI * row.w * row.w * per_m * per_m;
                self.sums[v as usize * SHADOW_SIDE + u as usize] += area * (-height / SHADOW_HEIGHT_M).exp();
            }
        }
        for _ in 0..2 {
            soften(&mut self.sums);
        }
        for (shadow, sum) in self.shadow.iter_mut().zip(&self.sums) {
            *shadow = (255.0 * (1.0 - (-sum).exp())) as u8;
        }
    }

    /// Forgets the people; the disc is shown again once one is seen.
    pub fn clear(&mut self) {
        self.level = None;
        self.shadow.fill(0);
    }

    /// Returns numbers for shaders: centre and radius of the disc, the first axis and half the side of the shadow, the second axis and 0,
    /// metres; a radius of 0 shows nothing.
    #[must_use]
    pub fn numbers(&self) -> [f32; 12] {
        let [x, y, up] = self.axes;
        let center = self.center + up * self.level.unwrap_or_default();
        let radius = if self.level.is_some() { self.radius } else { 0.0 };
        let rows = [center.extend(radius), x.extend(SHADOW_HALF_M), y.extend(0.0)];
        std::array::from_fn(|i| rows[i / 4][i % 4])
    }

    /// Returns the darkness of the shadow, 0..=255, [`SHADOW_SIDE`] rows along the second axis.
    #[must_use]
    pub fn shadow(&self) -> &[u8] {
        &self.shadow
    }

    /// Draws the floor over a grey backdrop, as a camera sees it; sRGB bytes.
    #[must_use]
    pub fn backdrop(&self, camera: &Camera, grey: u8) -> Vec<u8> {
        let [width, height] = camera.size().map(|side| side as usize);
        let mut rgb = vec![grey; 3 * width * height];
        let [x, y, up] = self.axes;
        let numbers = self.numbers();
        let (center, radius) = (Vec3::from_slice(&numbers), numbers[3]);
        let eye = camera.position().as_vec3();
        let above = (eye - center).dot(up);
        if radius <= 0.0 || above <= 0.0 {
            return rgb;
        }
        let world_from_camera = camera.camera_from_world.rotation.inverse().as_quat();
        let lens = &camera.intrinsics;
        let (focal, middle) = (lens.focal_px.as_vec2(), lens.center_px.as_vec2());
        for (at, pixel) in rgb.chunks_exact_mut(3).enumerate() {
            let place = glam::Vec2::new((at % width) as f32, (at / width) as f32);
            let sight = world_from_camera * ((place - middle) / focal).extend(1.0);
            let down = -sight.dot(up);
            if down > 1e-4 {
                let hit = eye + sight * (above / down) - center;
                let (light, shadow) = self.light([hit.dot(x), hit.dot(y)], radius);
                pixel.fill(((f32::from(grey) + light) * shadow + 0.5) as u8);
            }
        }
        rgb
    }

    /// Returns the light that the disc adds, sRGB codes, and the factor of the shadow at a place.
    fn light(&self, [u, v]: [f32; 2], radius: f32) -> (f32, f32) {
        let away = u.hypot(v) / radius;
        if away >= 1.0 {
            return (0.0, 1.0);
        }
        let fade = 1.0 - away * away;
        let dark = self.darkness([u, v]) * fade.sqrt();
        (LIGHT * fade * fade, 1.0 - (1.0 - DARKEST) * dark)
    }

    /// Returns the darkness at a place, interpolated, 0..=1.
    fn darkness(&self, place: [f32; 2]) -> f32 {
        let per_m = SHADOW_SIDE as f32 / (2.0 * SHADOW_HALF_M);
        let [u, v] = place.map(|along| (along + SHADOW_HALF_M) * per_m - 0.5);
        let last = SHADOW_SIDE as f32 - 1.0;
        if !(u >= 0.0 && v >= 0.0 && u < last && v < last) {
            return 0.0;
        }
        let (column, row) = (u as usize, v as usize);
        let at = |dx: usize, dy: usize| f32::from(self.shadow[(row + dy) * SHADOW_SIDE + column + dx]) / 255.0;
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        mix(mix(at(0, 0), at(1, 0), u.fract()), mix(at(0, 1), at(1, 1), u.fract()), v.fract())
    }
}

/// Blurs by [1 2 1] / 4 along both sides; the border stays dark.
fn soften(values: &mut [f32]) {
    for (step, other) in [(1, SHADOW_SIDE), (SHADOW_SIDE, 1)] {
        for line in 0..SHADOW_SIDE {
            let mut before = 0.0;
            for place in 0..SHADOW_SIDE - 1 {
                let at = line * other + place * step;
                let (value, after) = (values[at], values[at + step]);
                values[at] = 0.25 * before + 0.5 * value + 0.25 * after;
                before = value;
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry};

    use super::*;

    fn camera(eye: DVec3) -> Camera {
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: format!("{eye}").into(),
            intrinsics: Intrinsics::pinhole(160, 120, 100.0),
            camera_from_world: Isometry::look_at(eye, DVec3::new(0.5, 0.2, 1.0), DVec3::Z),
        }
    }

    /// Gaussians of a post at a place, from a height on, 1.8 m tall.
    fn post(x: f32, y: f32, bottom: f32) -> Vec<[f32; 4]> {
        (0..6000)
            .map(|i| {
                let turn = i as f32 * 2.4;
                [x + 0.15 * turn.cos(), y + 0.15 * turn.sin(), bottom + 1.8 * i as f32 / 6000.0, 0.02]
            })
            .collect()
    }

    #[test]
    fn the_floor_is_under_the_feet_and_dark_only_there() {
        let rig = Rig {
            cameras: vec![camera(DVec3::new(3.0, 0.0, 1.4)), camera(DVec3::new(0.0, 3.0, 1.4))],
            world_up: DVec3::Z,
        };
        let view = camera(DVec3::new(3.0, -1.0, 1.6));
        let mut floor = Floor::new(&rig);
        assert!(floor.backdrop(&view, 30).iter().all(|code| *code == 30), "no floor before the first person");
        floor.update(&post(0.6, 0.1, -0.25));
        let level = floor.level.unwrap();
        assert!((level + 0.25).abs() < 0.02, "{level}");
        let rgb = floor.backdrop(&view, 30);
        let code = |place: DVec3| {
            let at = view.project(place).unwrap().round();
            rgb[3 * (at.y as usize * 160 + at.x as usize)]
        };
        let at = |x: f64, y: f64| DVec3::new(x, y, f64::from(level));
        let (under, beside) = (code(at(0.6, 0.1)), code(at(0.6, 0.9)));
        assert!(under + 15 < beside && beside > 45, "{under} {beside}");
        assert_eq!(rgb[0], 30, "above the horizon");
        // From below there is no floor.
        let below = camera(DVec3::new(3.0, -1.0, -0.6));
        assert!(floor.backdrop(&below, 30).iter().all(|code| *code == 30));
        // A jump leaves the floor behind, and the shadow fades.
        let dark = |floor: &Floor| floor.shadow.iter().map(|code| u32::from(*code)).sum::<u32>();
        let standing = dark(&floor);
        for _ in 0..10 {
            floor.update(&post(0.6, 0.1, 0.15));
        }
        assert!(floor.level.unwrap() < -0.2 && dark(&floor) < standing / 2);
        floor.clear();
        assert!(floor.numbers()[3] <= 0.0 && dark(&floor) == 0);
    }

    #[test]
    fn poisoned_gaussians_and_rigs_are_no_panic() {
        let mut floor = Floor::new(&Rig { cameras: Vec::new(), world_up: DVec3::NAN });
        floor.update(&[]);
        assert!(floor.level.is_none());
        floor.update(&[[f32::NAN; 4], [f32::INFINITY, 0.0, 0.0, 1.0], [1e30, -1e30, 0.0, 1e30], [0.0; 4]]);
        assert!(floor.numbers().iter().all(|number| number.is_finite()));
        let view = camera(DVec3::new(3.0, -1.0, 1.6));
        assert_eq!(floor.backdrop(&view, 30).len(), 160 * 120 * 3);
    }
}
