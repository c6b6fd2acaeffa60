//! Cameras of our own: a circle around the person.

use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Lens, Rig};
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Returns the point that the rig's cameras look at: closest to all optical axes, in the least-squares sense; world metres.
#[must_use]
pub fn center_of_attention(rig: &Rig) -> DVec3 {
    let mut normal = DMat3::from_diagonal(DVec3::splat(1e-6));
    let mut right = DVec3::ZERO;
    for camera in &rig.cameras {
        let axis = camera.camera_from_world.rotation.inverse() * DVec3::Z;
        let projector = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        normal += projector;
        right += projector * camera.position();
    }
    let center = normal.inverse() * right;
    // A single camera, or parallel ones, fix no point: take one 3 m in front.
    let Some(first) = rig.cameras.first() else { return DVec3::ZERO };
    if rig.cameras.len() < 2 || !center.is_finite() || center.distance(first.position()) > 1e3 {
        return first.position() + first.camera_from_world.rotation.inverse() * DVec3::Z * 3.0;
    }
    center
}

/// Returns a camera on a circle around the person, starting beside the rig's first camera. `turn` in whole turns. The field
/// of view is that of the rig's first camera.
#[must_use]
pub fn orbit(rig: &Rig, turn: f64, width: u32, height: u32, name: &str) -> Option<Camera> {
    let first = rig.cameras.first()?;
    let center = center_of_attention(rig);
    let arm = DQuat::from_axis_angle(rig.world_up, turn * std::f64::consts::TAU) * (first.position() - center);
    let i = &first.intrinsics;
    // The whole height of the first camera's picture fits the height of ours.
    let focal = i.focal_px.y * f64::from(height) / f64::from(i.height);
    Some(Camera {
        id: CameraId::from(name),
        intrinsics: Intrinsics {
            width,
            height,
            focal_px: DVec2::splat(focal),
            center_px: DVec2::new(f64::from(width) - 1.0, f64::from(height) - 1.0) / 2.0,
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry::look_at(center + arm, center, rig.world_up),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig(eyes: &[DVec3]) -> Rig {
        let target = DVec3::new(0.2, 0.1, 1.0);
        let camera = |eye: &DVec3| Camera {
            id: format!("{eye}").into(),
            intrinsics: Intrinsics {
                width: 640,
                height: 480,
                focal_px: DVec2::splat(500.0),
                center_px: DVec2::new(319.5, 239.5),
                lens: Lens::PINHOLE,
            },
            camera_from_world: Isometry::look_at(*eye, target, DVec3::Z),
        };
        Rig { cameras: eyes.iter().map(camera).collect(), world_up: DVec3::Z }
    }

    #[test]
    fn the_orbit_looks_at_what_the_rig_looks_at() {
        let rig = rig(&[DVec3::new(3.0, 0.0, 1.2), DVec3::new(0.0, 3.0, 1.0), DVec3::new(-2.0, -2.0, 1.4)]);
        assert!(center_of_attention(&rig).distance(DVec3::new(0.2, 0.1, 1.0)) < 1e-4);
        for turn in [0.0, 0.25, 0.7] {
            let camera = orbit(&rig, turn, 512, 512, "main").unwrap();
            camera.validate().unwrap();
            let pixel = camera.project(DVec3::new(0.2, 0.1, 1.0)).unwrap();
            assert!(pixel.distance(DVec2::splat(255.5)) < 0.1, "{pixel}");
        }
    }

    #[test]
    fn one_camera_or_none_is_no_catastrophe() {
        let one = rig(&[DVec3::new(3.0, 0.0, 1.2)]);
        assert!(orbit(&one, 0.3, 64, 64, "main").unwrap().validate().is_ok());
        assert!(orbit(&rig(&[]), 0.3, 64, 64, "main").is_none());
    }
}
