//! Poses of cameras, rays of pixels, and the point nearest to several of them.

use flyrig_solve::RigidMotion;
use flyrig_types::{Camera, Intrinsics, Rig};
use glam::{DMat3, DVec2, DVec3};

/// Distance from a ray at which it loses half its weight, metres.
const ROBUST_M: f64 = 0.05;

/// Ray of an observation in world axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Ray {
    /// Camera centre, metres.
    pub center: DVec3,
    /// Unit direction.
    pub direction: DVec3,
    /// Confidence of the observation, 0 to 1.
    pub confidence: f64,
}

impl Ray {
    /// Returns the ray of a pixel; `None` where the lens model cannot be inverted.
    pub fn new(intrinsics: &Intrinsics, camera: &RigidMotion, pixel: DVec2, confidence: f64) -> Option<Self> {
        let ideal = intrinsics.lens.undistort((pixel - intrinsics.center_px) / intrinsics.focal_px)?;
        let direction = camera.rotation.inverse() * ideal.extend(1.0).normalize();
        Some(Self { center: camera.inverse().translation, direction, confidence })
    }

    /// Returns the projection onto the plane perpendicular to the ray.
    fn across(&self) -> DMat3 {
        let d = self.direction;
        DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z)
    }
}

/// Returns the robust least-squares intersection of rays; `None` for fewer than two, parallel ones, and points behind a camera.
pub(crate) fn nearest(rays: &[Ray]) -> Option<DVec3> {
    if rays.len() < 2 {
        return None;
    }
    let mut weights: Vec<f64> = rays.iter().map(|ray| ray.confidence).collect();
    let mut point = DVec3::ZERO;
    for _ in 0..8 {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (ray, weight) in rays.iter().zip(&weights) {
            normal += ray.across() * *weight;
            right += ray.across() * ray.center * *weight;
        }
        if normal.determinant() < 1e-6 * weights.iter().sum::<f64>().powi(3) {
            return None;
        }
        point = normal.inverse() * right;
        for (ray, weight) in rays.iter().zip(&mut weights) {
            let off = (ray.across() * (point - ray.center)).length();
            *weight = ray.confidence / (1.0 + (off / ROBUST_M).powi(2));
        }
    }
    let is_ahead = rays.iter().all(|ray| ray.direction.dot(point - ray.center) > 0.1);
    (is_ahead && point.is_finite()).then_some(point)
}

/// Returns the poses of a rig's cameras, camera from world.
pub(crate) fn motions(rig: &Rig) -> Vec<RigidMotion> {
    let of = |camera: &Camera| RigidMotion {
        rotation: camera.camera_from_world.rotation,
        translation: camera.camera_from_world.translation,
    };
    rig.cameras.iter().map(of).collect()
}
