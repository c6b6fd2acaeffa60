//! Virtual cameras on a circle around the person.

use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Rig};
use glam::DQuat;

/// Returns a virtual camera on a circle around the person: `turn` whole turns from the rig's first camera, with its field of view. `None` for
/// a rig without cameras.
///
/// # Example
/// ```
/// use flyrig_fusion::{orbit, types::{Camera, Intrinsics, Isometry, Rig}};
/// use glam::DVec3;
///
/// let camera = Camera {
///     id: "front".into(),
///     intrinsics: Intrinsics::pinhole(640, 480, 500.0),
///     camera_from_world: Isometry::look_at(DVec3::new(0.0, 1.0, 3.0), DVec3::Y, DVec3::Y),
///     time_offset_nanos: 0,
///     color: Default::default(),
/// };
/// let rig = Rig { cameras: vec![camera], world_up: DVec3::Y };
/// let side = orbit(&rig, 0.25, 320, 240, "side").expect("the rig has a camera");
/// assert_eq!(side.size(), [320, 240]);
/// ```
#[must_use]
pub fn orbit(rig: &Rig, turn: f64, width: u32, height: u32, name: &str) -> Option<Camera> {
    let first = rig.cameras.first()?;
    let center = rig.center_of_attention();
    let arm = DQuat::from_axis_angle(rig.world_up, turn * std::f64::consts::TAU) * (first.position() - center);
    let i = &first.intrinsics;
    // The whole height of the first camera's image fits the height of ours.
    let focal = i.focal_px.y * f64::from(height) / f64::from(i.height);
    Some(Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: CameraId::from(name),
        intrinsics: Intrinsics::pinhole(width, height, focal),
        camera_from_world: Isometry::look_at(center + arm, center, rig.world_up),
    })
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};

    use super::*;

    fn rig(eyes: &[DVec3]) -> Rig {
        let target = DVec3::new(0.2, 0.1, 1.0);
        let camera = |eye: &DVec3| Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: format!("{eye}").into(),
            intrinsics: Intrinsics::pinhole(640, 480, 500.0),
            camera_from_world: Isometry::look_at(*eye, target, DVec3::Z),
        };
        Rig { cameras: eyes.iter().map(camera).collect(), world_up: DVec3::Z }
    }

    #[test]
    fn the_orbit_looks_at_what_the_rig_looks_at() {
        let rig = rig(&[DVec3::new(3.0, 0.0, 1.2), DVec3::new(0.0, 3.0, 1.0), DVec3::new(-2.0, -2.0, 1.4)]);
        assert!(rig.center_of_attention().distance(DVec3::new(0.2, 0.1, 1.0)) < 1e-4);
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
