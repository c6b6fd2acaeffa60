//! Errors of a calibration with known truth.

use flyrig_solve::{PointPair, align_similarity};
use flyrig_types::Camera;
use glam::{DMat3, DVec3};

use super::Random;

/// Error of one camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigError {
    /// Mean reprojection error in its image of points placed by all cameras together, pixels.
    pub px: f64,
    /// Orientation error after the best motion and scale of the whole rig, degrees.
    pub deg: f64,
    /// Position error after the same alignment, millimetres.
    pub mm: f64,
}

/// Returns the errors in the order of the true cameras, over a volume of 1.2 x 1.2 x 1.8 m on the middle of the floor;
/// `None` where the cameras differ, or see nothing there.
#[must_use]
pub fn rig_errors(found: &[Camera], truth: &[Camera]) -> Option<Vec<RigError>> {
    let found: Vec<&Camera> =
        truth.iter().map(|camera| found.iter().find(|other| other.id == camera.id)).collect::<Option<_>>()?;
    let mut random = Random(1);
    let mut pairs = Vec::new();
    for _ in 0..300 {
        let place = DVec3::new(random.between(-0.6, 0.6), random.between(-0.6, 0.6), random.between(0.0, 1.8));
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (camera, other) in truth.iter().zip(&found) {
            let Some(ray) = camera.project(place).and_then(|pixel| other.ray(pixel)) else { continue };
            let across = DMat3::IDENTITY - DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
            normal += across;
            right += across * other.position();
        }
        if normal.determinant() > 1e-3 {
            pairs.push(PointPair { from: place, to: normal.inverse() * right, weight: 1.0 });
        }
    }
    let alignment = align_similarity(&pairs)?;
    let errors = truth.iter().zip(&found).map(|(camera, other)| {
        let off = pairs.iter().filter_map(|pair| Some(camera.project(pair.from)?.distance(other.project(pair.to)?)));
        let off: Vec<f64> = off.collect();
        let turned = camera.camera_from_world.rotation * alignment.rotation.inverse();
        RigError {
            px: off.iter().sum::<f64>() / off.len() as f64,
            deg: other.camera_from_world.rotation.angle_between(turned).to_degrees(),
            mm: 1e3 * alignment.apply(camera.position()).distance(other.position()),
        }
    });
    Some(errors.collect())
}
