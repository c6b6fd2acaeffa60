//! Depth from a single camera: landmarks from the network's own estimate, and the height of people who stand on the floor.
//!
//! A single camera measures only a person's height, by where the feet stand.

use flyrig_types::Camera;
use glam::{DMat3, DVec2, DVec3, Vec3};

use crate::image::view::{View, observe};
use crate::landmarks::keypoints::LANDMARK_COUNT;
use crate::landmarks::sighting::Sighting;

/// Returns world points in metres from one view: the network's hip-centred landmarks (metres, for a trunk of half a metre,
/// times `scale`), rotated as the crop, at the place where they explain the image best (linear least squares). `None` when
/// that place is behind the camera or not finite.
pub(crate) fn lift(
    camera: &Camera,
    sighting: &Sighting,
    confidence_threshold: f64,
    scale: f64,
) -> Option<[Option<DVec3>; LANDMARK_COUNT]> {
    let view = View::new(camera);
    let seen = observe(camera, &view, &sighting.keypoints, confidence_threshold);
    let turn = sighting.crop.turn;
    let local = sighting.output.landmarks.map(|landmark| {
        let [x, y, z] = landmark.world?;
        Some((turn.rotate(DVec2::new(x, y)) * scale).extend(z * scale))
    });
    // (x + t_x) = u (z + t_z), the same for v.
    let mut normal = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    let mut count = 0;
    for (local, seen) in local.iter().zip(&seen) {
        let (Some(local), Some(seen)) = (local, seen) else { continue };
        let u = seen.ideal_px / view.focal_px;
        for (row, value) in [
            (DVec3::new(1.0, 0.0, -u.x), u.x * local.z - local.x),
            (DVec3::new(0.0, 1.0, -u.y), u.y * local.z - local.y),
        ] {
            normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * seen.confidence;
            right += row * (value * seen.confidence);
        }
        count += 1;
    }
    if count < 6 || normal.determinant().abs() < 1e-9 {
        return None;
    }
    let translation = normal.inverse() * right;
    if !translation.is_finite() || translation.z < 0.3 {
        return None;
    }
    let world_from_camera = view.rotation.transpose();
    Some(std::array::from_fn(|i| {
        let place = |local| world_from_camera * (local + translation - view.translation);
        seen[i].and(local[i]).map(place).filter(|p| p.is_finite())
    }))
}

/// Share of the frame sets in which the feet may be in the air, where the person seems to stand farther away.
const IN_THE_AIR: f64 = 0.6;

/// Returns the ratio of a person's size to that of bodies that fill the same pixels (world vertices in metres, one body per
/// frame set): bodies grow along the lines of sight until their lowest points meet the floor at height `floor_m` along
/// `up`. `None` unless the camera looks down on the feet.
pub(crate) fn growth_to_floor(camera: &Camera, up: DVec3, floor_m: f64, bodies: &[Vec<Vec3>]) -> Option<f64> {
    let up = up.try_normalize()?;
    let above = |at: DVec3| at.dot(up) - floor_m;
    let eye = above(camera.position());
    let growth = |body: &Vec<Vec3>| {
        let lowest = body.iter().map(|at| above(at.as_dvec3())).fold(f64::INFINITY, f64::min);
        let growth = eye / (eye - lowest);
        (growth > 0.0 && growth.is_finite()).then_some(growth)
    };
    let mut growths: Vec<f64> = bodies.iter().filter_map(growth).collect();
    growths.sort_by(f64::total_cmp);
    growths.get(((1.0 - IN_THE_AIR) * growths.len() as f64) as usize).copied().filter(|_| eye > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{body, ring};
    use flyrig_body::skin_mesh;
    use glam::DQuat;

    /// The built-in body on the floor at a place, `height` above it, as a body of `size` times its size that fills the same
    /// pixels.
    fn seen_as(camera: &Camera, place: [f64; 2], height: f64, size: f64) -> Vec<Vec3> {
        let body = body();
        let mut pose = body.skeleton.rest_pose();
        pose.joint_rotations[0] = DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
        pose.root_translation = DVec3::ZERO;
        let (vertices, _) = skin_mesh(&body, &pose);
        let lowest = vertices.iter().map(|at| at.z).fold(f32::INFINITY, f32::min);
        let moved = DVec3::new(place[0], place[1], height - f64::from(lowest));
        let eye = camera.position();
        vertices.iter().map(|at| eye.lerp(at.as_dvec3() + moved, size).as_vec3()).collect()
    }

    #[test]
    fn bodies_grow_to_the_floor_that_they_stand_on() {
        let camera = &ring(1).cameras[0];
        for floor_m in [0.0, -0.8] {
            for size in [0.8, 1.0, 1.15] {
                // Three of eight jump.
                let bodies: Vec<Vec<Vec3>> = (0..8)
                    .map(|i| {
                        seen_as(camera, [0.1 * f64::from(i), -0.2], floor_m + [0.0, 0.3][usize::from(i < 3)], size)
                    })
                    .collect();
                let growth = growth_to_floor(camera, 2.0 * DVec3::Z, floor_m, &bodies).unwrap();
                assert!((growth * size - 1.0).abs() < 0.02, "{growth} for a body of {size} on a floor at {floor_m}");
            }
        }
    }

    #[test]
    fn nothing_is_measured_without_a_floor_below_the_camera() {
        let camera = &ring(1).cameras[0];
        let body = seen_as(camera, [0.0, 0.0], 0.0, 1.0);
        let of = |up: DVec3, floor_m: f64, bodies: &[Vec<Vec3>]| growth_to_floor(camera, up, floor_m, bodies);
        assert_eq!(of(DVec3::Z, 0.0, &[]), None);
        assert_eq!(of(DVec3::Z, 0.0, &[Vec::new()]).filter(|growth| *growth > 0.0), None, "a body without vertices");
        assert_eq!(of(DVec3::Z, 5.0, std::slice::from_ref(&body)), None, "a floor above the camera");
        assert_eq!(of(DVec3::ZERO, 0.0, std::slice::from_ref(&body)), None);
        assert_eq!(of(DVec3::NAN, 0.0, std::slice::from_ref(&body)), None);
        assert_eq!(of(DVec3::Z, f64::NAN, std::slice::from_ref(&body)), None);
        assert_eq!(of(DVec3::Z, 0.0, &[vec![Vec3::new(0.0, 0.0, 9.0)]]), None, "all of it above the camera");
        let growth = of(DVec3::Z, 0.0, &[vec![Vec3::NAN], body]).unwrap();
        assert!((growth - 1.0).abs() < 0.01);
    }
}
