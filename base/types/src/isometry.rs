//! Rigid motions.

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// A rotation followed by a translation (metres); name variables `dst_from_src`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Isometry {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Metres, in the destination frame.
    pub translation: DVec3,
}

impl Isometry {
    /// Motion that moves nothing.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Creates a motion from a unit quaternion and a translation, metres.
    #[must_use]
    pub fn new(rotation: DQuat, translation: DVec3) -> Self {
        Self { rotation, translation }
    }

    /// Creates a motion from a rotation matrix (orthonormal, determinant 1) and a translation, metres.
    #[must_use]
    pub fn from_matrix(rotation: DMat3, translation: DVec3) -> Self {
        Self { rotation: DQuat::from_mat3(&rotation).normalize(), translation }
    }

    /// Returns `camera_from_world` of a camera at `eye` that looks at `target`, world metres; `up` is a world direction that is
    /// not parallel to the line of sight.
    ///
    /// ```
    /// use flyrig_types::Isometry;
    /// use glam::DVec3;
    ///
    /// let eye = DVec3::new(0.0, -3.0, 1.0);
    /// let camera_from_world = Isometry::look_at(eye, DVec3::Z, DVec3::Z);
    /// assert!(camera_from_world.transform_point(DVec3::Z).distance(DVec3::new(0.0, 0.0, 3.0)) < 1e-12);
    /// let world_from_camera = camera_from_world.inverse();
    /// assert!(world_from_camera.translation.distance(eye) < 1e-12);
    /// ```
    #[must_use]
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3) -> Self {
        let forward = (target - eye).normalize_or(DVec3::X);
        let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
        let down = forward.cross(right);
        let camera_from_world = DMat3::from_cols(right, down, forward).transpose();
        Self::from_matrix(camera_from_world, -(camera_from_world * eye))
    }

    /// Returns the reverse motion.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Transforms a point, metres.
    #[must_use]
    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Returns the homogeneous matrix.
    #[must_use]
    pub fn to_matrix(&self) -> DMat4 {
        DMat4::from_rotation_translation(self.rotation, self.translation)
    }

    /// Returns whether all numbers are finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.rotation.is_finite() && self.translation.is_finite()
    }
}

impl std::ops::Mul for Isometry {
    type Output = Self;

    /// Chains two motions: `a_from_b * b_from_c = a_from_c`.
    fn mul(self, rhs: Self) -> Self {
        Self {
            rotation: (self.rotation * rhs.rotation).normalize(),
            translation: self.transform_point(rhs.translation),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn look_at_puts_the_target_on_the_optical_axis_with_y_down() {
        let camera_from_world = Isometry::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::new(0.0, 0.0, 1.0), DVec3::Z);
        let target = camera_from_world.transform_point(DVec3::new(0.0, 0.0, 1.0));
        assert!((target - DVec3::new(0.0, 0.0, 3.0)).length() < 1e-12);
        // A point above the target is up in the image: negative y. A point to world +x is on the right.
        assert!(camera_from_world.transform_point(DVec3::new(0.0, 0.0, 1.5)).y < -0.49);
        assert!(camera_from_world.transform_point(DVec3::new(0.5, 0.0, 1.0)).x > 0.49);
    }

    #[test]
    fn a_motion_times_its_inverse_is_the_identity() {
        let a_from_b =
            Isometry::new(DQuat::from_rotation_x(0.3) * DQuat::from_rotation_z(1.1), DVec3::new(1.0, 2.0, 3.0));
        let identity = a_from_b * a_from_b.inverse();
        assert!(identity.translation.length() < 1e-12);
        assert!(identity.rotation.angle_between(DQuat::IDENTITY) < 1e-7);
    }
}
