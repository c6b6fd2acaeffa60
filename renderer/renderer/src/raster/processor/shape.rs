//! Shape of an anisotropic Gaussian: `anisotropic/axes.wgsl` on the processor.

use flyrig_gpu::CameraConstants;
use glam::{Mat3, Mat4, Quat, Vec2, Vec3, Vec4};

/// Valid scales, opacity and rotation of an anisotropic Gaussian.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shape {
    /// Standard deviations along the axes, metres.
    pub scale_m: Vec3,
    pub opacity: f32,
    /// Quaternion x, y, z, w of length 1.
    pub unit: Vec4,
    /// 1 / length of the stored quaternion.
    pub inverse_length: f32,
}

impl Shape {
    /// Checks and normalises the stored attributes; `None` where a number is not finite, a scale not above 0, or the
    /// quaternion too short or too long for f32.
    #[inline(always)]
    pub fn new(scale_opacity: &[f32; 4], rotation: &[f32; 4]) -> Option<Self> {
        let size = Vec4::from(*scale_opacity);
        let rotation = Vec4::from(*rotation);
        let squared = rotation.length_squared();
        let is_valid = size.is_finite() && size.truncate().min_element() > 0.0 && squared > 1e-30 && squared < 1e30;
        is_valid.then(|| {
            let inverse_length = 1.0 / squared.sqrt();
            Self { scale_m: size.truncate(), opacity: size.w, unit: rotation * inverse_length, inverse_length }
        })
    }

    /// Returns the unit vectors along the Gaussian's axes as columns, in camera axes.
    #[inline(always)]
    pub fn axes_in_camera(&self, camera: &CameraConstants) -> Mat3 {
        camera_rotation(camera) * Mat3::from_quat(Quat::from_vec4(self.unit))
    }
}

/// Returns the rotation, camera from world.
#[inline(always)]
pub(crate) fn camera_rotation(camera: &CameraConstants) -> Mat3 {
    Mat3::from_mat4(Mat4::from_cols_array_2d(&camera.camera_from_world))
}

/// Returns the rows of the projection's Jacobian, given its columns d/dx, d/dy and d/dz.
#[inline(always)]
pub(crate) fn rows_of(&[dx, dy, dz]: &[Vec2; 3]) -> [Vec3; 2] {
    [Vec3::new(dx.x, dy.x, dz.x), Vec3::new(dx.y, dy.y, dz.y)]
}

/// Returns the rows of the Jacobian in the basis of `axes`.
#[inline(always)]
pub(crate) fn rows_along(jacobian: &[Vec2; 3], axes: &Mat3) -> [Vec3; 2] {
    rows_of(jacobian).map(|row| Vec3::new(axes.x_axis.dot(row), axes.y_axis.dot(row), axes.z_axis.dot(row)))
}
