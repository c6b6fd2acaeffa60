//! Lamps: positions, shadow map views of room and people, and brightness over time.

use glam::{Mat4, Vec3};

use crate::room::scene_config::LightConfig;

/// Half the angle of a lamp's cone, and the angle at which its light begins to fall, degrees.
const CONE_DEG: [f32; 2] = [74.0, 30.0];
/// Near plane of shadow maps, metres.
pub(crate) const LAMP_NEAR_M: f32 = 0.3;
/// Default target of a lamp.
pub(crate) const STAGE: Vec3 = Vec3::new(0.0, 0.0, 0.9);

/// Lamp with its position.
#[derive(Debug, Clone)]
pub(crate) struct Lamp {
    pub place: Vec3,
    /// Unit direction of its light.
    pub axis: Vec3,
    /// Light on a white surface facing it, times the squared distance of that surface.
    pub power: Vec3,
    pub size_m: f32,
    /// Ambient light that the room reflects of it.
    pub bounce: Vec3,
    pub config: LightConfig,
}

impl Lamp {
    /// Creates a lamp aimed at `aim`, in a room that reflects the fraction `bounce`.
    pub(crate) fn new(config: &LightConfig, aim: Vec3, bounce: f32) -> Self {
        let (sin, cos) = (config.elevation_deg.to_radians() as f32).sin_cos();
        let (y, x) = (config.azimuth_deg.to_radians() as f32).sin_cos();
        let towards = Vec3::new(x * cos, y * cos, sin);
        let distance = config.distance_m as f32;
        let colour = Vec3::from(config.colour.map(|part| part as f32));
        let light = colour / colour.max_element().max(1e-3) * config.intensity as f32;
        Self {
            place: aim + towards * distance,
            axis: -towards,
            power: light * distance * distance,
            size_m: config.size_m as f32,
            bounce: light * bounce,
            config: config.clone(),
        }
    }

    /// Returns the factor on its light at a time.
    pub(crate) fn level(&self, secs: f64) -> f32 {
        self.config.level(secs) as f32
    }

    /// Returns the transform of the room's shadow map, and the tangent of half its angle.
    pub(crate) fn room_view(&self) -> (Mat4, f32) {
        let tangent = CONE_DEG[0].to_radians().tan();
        (clip_from_world(self.place, self.axis, tangent), tangent)
    }

    /// Returns the same for the shadow map of a ball.
    pub(crate) fn ball_view(&self, center: Vec3, radius: f32) -> (Mat4, f32) {
        let towards = center - self.place;
        let sine = (radius / towards.length().max(1e-3)).min(0.94);
        let tangent = sine / (1.0 - sine * sine).sqrt();
        (clip_from_world(self.place, towards.normalize_or(self.axis), tangent), tangent)
    }
}

/// Returns the cosines of the angles where a lamp's light ends and where it begins to fall.
pub(crate) fn cone_cosines() -> [f32; 2] {
    CONE_DEG.map(|degrees| degrees.to_radians().cos())
}

/// Returns the perspective from a position in a direction; the device's depth is 1 - near / z.
fn clip_from_world(place: Vec3, forward: Vec3, tangent: f32) -> Mat4 {
    let right = forward.cross(Vec3::Z).normalize_or(Vec3::X);
    let up = right.cross(forward);
    let row = |axis: Vec3, scale: f32, shift: f32| (axis * scale).extend(-axis.dot(place) * scale + shift);
    Mat4::from_cols(
        row(right, 1.0 / tangent, 0.0),
        row(up, 1.0 / tangent, 0.0),
        row(forward, 1.0, -LAMP_NEAR_M),
        row(forward, 1.0, 0.0),
    )
    .transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lamp_sees_what_it_lights_in_the_middle_and_a_ball_fills_its_image() {
        let lamp = Lamp::new(&LightConfig::default(), STAGE, 0.2);
        let (clip, _) = lamp.room_view();
        let middle = clip * STAGE.extend(1.0);
        assert!(middle.truncate().truncate().length() < 1e-4 && (middle.w - 3.6).abs() < 1e-4, "{middle}");
        assert!((middle.z / middle.w - (1.0 - LAMP_NEAR_M / 3.6)).abs() < 1e-5);
        let (ball, _) = lamp.ball_view(STAGE, 1.2);
        for i in 0..100 {
            let angle = i as f32;
            let on_ball = Vec3::new(angle.cos() * angle.sin(), angle.sin() * angle.sin(), angle.cos()) * 1.2;
            let clip = ball * (STAGE + on_ball).extend(1.0);
            assert!(clip.x.abs() <= clip.w * 1.001 && clip.y.abs() <= clip.w * 1.001, "{clip}");
        }
        let light = lamp.power / lamp.place.distance_squared(STAGE);
        assert!((light.max_element() - 0.8).abs() < 1e-5);
    }
}
