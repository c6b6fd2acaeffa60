//! Up direction of rigs whose files do not state it, from the cameras themselves.

use flyrig_types::Camera;
use glam::DVec3;

/// Largest spread of a level rig's right-hand axes out of their common plane, relative to their spread within it.
const LEVEL_SHARE: f64 = 0.2;
/// Angles to a world axis within which it is always up, and beyond which it never is, radians.
const LEAST_SNAP_RAD: f64 = 0.02;
const MOST_SNAP_RAD: f64 = 0.35;
/// Share of the right-hand axes along one direction from which they are parallel.
const PARALLEL_SHARE: f64 = 0.8;
/// Length of the mean of the cameras' own up directions below which parallel right-hand axes are vertical: a ring of cameras on
/// their side. Level cameras above each other would have to look from all sides of a wheel.
const WHEEL: f64 = 0.6;

/// Estimates the up direction of cameras that are held level, at any pitch: normal to their right-hand axes, or the
/// world axis within their scatter about level. Cameras that all stand on the same side, in a ring of more than half a
/// turn, have vertical right-hand axes; up is then away from where they look, or else along the positive world axis.
/// Where right-hand axes are nearly parallel otherwise, the mean of the cameras' own up directions.
///
/// A guess: only a person in the images tells (`flyrig_takes::person_up`).
pub(crate) fn level_up(cameras: &[Camera]) -> DVec3 {
    let axis = |camera: &Camera, axis: DVec3| camera.camera_from_world.rotation.inverse() * axis;
    let sum = |of: DVec3| cameras.iter().map(|camera| axis(camera, of)).sum::<DVec3>();
    let above = sum(DVec3::NEG_Y);
    let mut moments = nalgebra::Matrix3::<f64>::zeros();
    for camera in cameras {
        let right = nalgebra::Vector3::from(axis(camera, DVec3::X).to_array());
        moments += right * right.transpose();
    }
    let eigen = moments.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let vector = |i: usize| {
        let column = eigen.eigenvectors.column(order[i]);
        DVec3::new(column[0], column[1], column[2]).try_normalize()
    };
    let is_wheel = above.length() < WHEEL * cameras.len() as f64;
    if is_wheel
        && eigen.eigenvalues[order[2]] > PARALLEL_SHARE * eigen.eigenvalues.sum()
        && let Some(vertical) = vector(2)
    {
        let up = vertical * -vertical.dot(sum(DVec3::Z)).signum();
        let looks_down = up.dot(sum(DVec3::NEG_Z)) > MOST_SNAP_RAD.sin() * cameras.len() as f64 / 4.0;
        return snapped(if looks_down { up } else { vertical * vertical.element_sum().signum() }, MOST_SNAP_RAD);
    }
    let is_plane = eigen.eigenvalues[order[0]] < LEVEL_SHARE * eigen.eigenvalues[order[1]];
    let Some(normal) = vector(0).filter(|_| is_plane) else {
        return above.try_normalize().unwrap_or(DVec3::Z);
    };
    let up = normal * normal.dot(above).signum();
    let scatter = (eigen.eigenvalues[order[0]].max(0.0) / eigen.eigenvalues[order[1]]).sqrt().atan();
    snapped(up, (2.0 * scatter).clamp(LEAST_SNAP_RAD, MOST_SNAP_RAD))
}

/// Returns the world axis within an angle of a direction (radians), or the direction itself.
fn snapped(up: DVec3, angle_rad: f64) -> DVec3 {
    Some(nearest_axis(up)).filter(|axis| axis.angle_between(up) < angle_rad).unwrap_or(up)
}

/// Returns the world axis, of either sign, that is nearest to a direction.
pub(crate) fn nearest_axis(direction: DVec3) -> DVec3 {
    [DVec3::Z, DVec3::Y, DVec3::X, DVec3::NEG_Z, DVec3::NEG_Y, DVec3::NEG_X]
        .into_iter()
        // Of equal ones the first, z.
        .rev()
        .max_by(|a, b| direction.dot(*a).total_cmp(&direction.dot(*b)))
        .unwrap_or(DVec3::Z)
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry, Rig};
    use glam::DQuat;

    use super::*;

    /// A ring of cameras over an arc of degrees at a height, turned about their optical axes by a roll in degrees.
    fn ring(arc_deg: f64, height: f64, roll_deg: f64, up: DVec3) -> Rig {
        let side = up.any_orthonormal_vector();
        let cameras = (0..6)
            .map(|i| {
                let turn = DQuat::from_axis_angle(up, (arc_deg * f64::from(i) / 6.0).to_radians());
                let pose = Isometry::look_at(turn * side * 3.0 + up * height, up, up);
                let roll = DQuat::from_rotation_z(roll_deg.to_radians());
                Camera {
                    id: format!("{i}").as_str().into(),
                    intrinsics: Intrinsics::pinhole(640, 480, 500.0),
                    camera_from_world: Isometry {
                        rotation: roll * pose.rotation,
                        translation: roll * pose.translation,
                    },
                    time_offset_nanos: 0,
                    color: Default::default(),
                }
            })
            .collect();
        Rig { cameras, world_up: up }
    }

    #[test]
    fn cameras_on_their_side_give_the_vertical_that_they_look_down_from() {
        for up in [DVec3::Z, DVec3::Y, DVec3::NEG_Y] {
            for roll in [90.0, -90.0] {
                for arc in [240.0, 360.0] {
                    let rig = ring(arc, 1.8, roll, up);
                    assert!(
                        level_up(&rig.cameras).angle_between(up) < 0.01,
                        "{up} {roll} {arc}: {}",
                        level_up(&rig.cameras)
                    );
                }
            }
        }
        // At the person's height nothing tells which of both it is: a positive axis.
        assert!(level_up(&ring(360.0, 1.0, 90.0, DVec3::Z).cameras).distance(DVec3::Z) < 1e-9);
    }

    #[test]
    fn level_cameras_give_the_normal_of_their_horizons() {
        for up in [DVec3::Z, DVec3::Y, DVec3::NEG_Y, DVec3::new(0.1, 0.3, 1.0).normalize()] {
            for (arc, height) in [(60.0, 1.0), (120.0, 2.5), (360.0, 1.0), (360.0, 3.0)] {
                let rig = ring(arc, height, 0.0, up);
                assert!(level_up(&rig.cameras).angle_between(up) < 0.03, "{up} {arc}: {}", level_up(&rig.cameras));
            }
        }
        assert_eq!(level_up(&[]), DVec3::Z);
        assert_eq!(nearest_axis(DVec3::ZERO), DVec3::Z);
    }
}
