//! A guess at the third dimension from one image.

use flyrig_types::Camera;
use glam::{DMat3, DVec2, DVec3};

use crate::LANDMARK_COUNT;
use crate::sighting::Sighting;
use crate::view::{View, observe};

/// World points from one view: the network's hip-centred landmarks (in metres, for a trunk of half a
/// metre; times `scale`), turned by the crop, moved to where they explain the image best (linear least squares).
/// `None` when that place is behind the camera or not finite.
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
