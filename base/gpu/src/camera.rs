//! Camera model of `flyrig-types` as constants of a kernel, and its WGSL.

use bytemuck::{Pod, Zeroable};
use flyrig_types::{Camera, Lens};
use glam::{Mat2, Mat4, Vec2, Vec3, Vec4};

/// WGSL of `struct Camera`, `fn project_point`, `fn distort` and `fn projection_jacobian`, for a kernel that declares a binding of type
/// `Camera`; it declares no bindings itself.
pub const CAMERA_WGSL: &str = include_str!("camera.wgsl");

/// [`Camera`] in the layout of `struct Camera` in [`CAMERA_WGSL`] (std140, 144 bytes).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct CameraConstants {
    /// Columns of the homogeneous matrix, camera axes from world axes.
    pub camera_from_world: [[f32; 4]; 4],
    /// Camera centre in the world, metres; w is unused.
    pub position: [f32; 4],
    /// Focal lengths fx, fy, pixels.
    pub focal_px: [f32; 2],
    /// Principal point, pixels; pixel centres lie at integers.
    pub center_px: [f32; 2],
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Lens model: 0 radial-tangential or rational, 1 fisheye.
    pub lens: u32,
    /// Radius of [`Lens::valid_radius`].
    pub valid_radius: f32,
    /// Coefficients k1 k2 k3 p1 p2 k4 k5 k6, or the fisheye's k1 to k4.
    pub coefficients: [f32; 8],
}

impl From<&Camera> for CameraConstants {
    fn from(camera: &Camera) -> Self {
        let i = &camera.intrinsics;
        let (lens, c) = match i.lens {
            Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } => {
                (0, [k1, k2, k3, p1, p2, 0.0, 0.0, 0.0])
            }
            Lens::Rational { radial: [k1, k2, k3, k4, k5, k6], tangential: [p1, p2] } => {
                (0, [k1, k2, k3, p1, p2, k4, k5, k6])
            }
            Lens::Fisheye { coefficients: [k1, k2, k3, k4] } => (1, [k1, k2, k3, k4, 0.0, 0.0, 0.0, 0.0]),
        };
        Self {
            camera_from_world: camera.camera_from_world.to_matrix().as_mat4().to_cols_array_2d(),
            position: camera.position().as_vec3().extend(1.0).to_array(),
            focal_px: i.focal_px.as_vec2().to_array(),
            center_px: i.center_px.as_vec2().to_array(),
            size: [i.width, i.height],
            lens,
            valid_radius: i.lens.valid_radius() as f32,
            coefficients: c.map(|value| value as f32),
        }
    }
}

/// Distorted point of the image plane with its derivative.
#[derive(Debug, Clone, Copy)]
pub struct Distorted {
    /// Distorted point.
    pub point: Vec2,
    /// Derivative by the ideal point: columns d/dx and d/dy.
    pub jacobian: Mat2,
}

/// Functions of [`CAMERA_WGSL`] for kernels on the processor, with the same operations.
impl CameraConstants {
    /// Transforms a world point to camera axes (x right, y down, z forward), metres.
    #[must_use]
    #[inline(always)]
    pub fn to_camera(&self, world: Vec3) -> Vec3 {
        Mat4::from_cols_array_2d(&self.camera_from_world).transform_point3(world)
    }

    /// Distorts a point of the ideal image plane.
    #[must_use]
    #[inline(always)]
    pub fn distort(&self, ideal: Vec2) -> Distorted {
        let Vec2 { x, y } = ideal;
        let r2 = ideal.length_squared();
        if self.lens == 0 {
            let [k1, k2, k3, p1, p2, k4, k5, k6] = self.coefficients;
            // Without k4 to k6 the division is by 1 and changes no bit.
            let below = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
            let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * below;
            // d radial / d r2, times 2 for d r2 / dx = 2 x.
            let above_slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
            let below_slope = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
            let slope = 2.0 * (above_slope - radial * below_slope) * below;
            let point = Vec2::new(
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            );
            let cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
            let jacobian = Mat2::from_cols(
                Vec2::new(radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, cross),
                Vec2::new(cross, radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x),
            );
            return Distorted { point, jacobian };
        }
        let [k1, k2, k3, k4, ..] = self.coefficients;
        let r = r2.sqrt();
        if r < 1e-4 {
            return Distorted { point: ideal, jacobian: Mat2::IDENTITY };
        }
        let theta = r.atan();
        let t2 = theta * theta;
        let distorted = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
        let slope = (1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))) / (1.0 + r2);
        let scale = distorted / r;
        // d(scale)/dr / r
        let bend = (slope - scale) / r2;
        let jacobian = Mat2::from_cols(
            Vec2::new(scale + bend * x * x, bend * x * y),
            Vec2::new(bend * x * y, scale + bend * y * y),
        );
        Distorted { point: ideal * scale, jacobian }
    }

    /// Projects a point in camera axes to a pixel. `None` closer than `near` to the camera's plane or behind it, farther than 1e9 m,
    /// beyond the lens's valid radius, and for NaN.
    #[must_use]
    #[inline(always)]
    pub fn project(&self, in_camera: Vec3, near: f32) -> Option<Vec2> {
        self.project_with_jacobian(in_camera, near).map(|(pixel, _)| pixel)
    }

    /// Projects as [`Self::project`] does and returns the [`Self::projection_jacobian`] as well.
    #[must_use]
    #[inline(always)]
    pub fn project_with_jacobian(&self, in_camera: Vec3, near: f32) -> Option<(Vec2, [Vec2; 3])> {
        // Each comparison is false for NaN.
        let inverse_z = 1.0 / in_camera.z;
        let ideal = in_camera.truncate() * inverse_z;
        let is_valid =
            in_camera.z > near && in_camera.z < 1e9 && ideal.length_squared() <= self.valid_radius * self.valid_radius;
        is_valid.then(|| {
            let distorted = self.distort(ideal);
            let pixel = distorted.point * Vec2::from(self.focal_px) + Vec2::from(self.center_px);
            (pixel, self.jacobian_of(ideal, inverse_z, distorted.jacobian))
        })
    }

    /// Returns the derivative of the pixel by the point in camera axes (z > 0): columns d/dx, d/dy, d/dz.
    #[must_use]
    #[inline(always)]
    pub fn projection_jacobian(&self, in_camera: Vec3) -> [Vec2; 3] {
        let inverse_z = 1.0 / in_camera.z;
        let ideal = in_camera.truncate() * inverse_z;
        self.jacobian_of(ideal, inverse_z, self.distort(ideal).jacobian)
    }

    #[inline(always)]
    fn jacobian_of(&self, ideal: Vec2, inverse_z: f32, lens: Mat2) -> [Vec2; 3] {
        let focal = Vec2::from(self.focal_px) * inverse_z;
        let (dx, dy) = (lens.x_axis * focal, lens.y_axis * focal);
        [dx, dy, -(ideal.x * dx + ideal.y * dy)]
    }

    /// Returns the camera's centre in the world, metres.
    #[must_use]
    #[inline(always)]
    pub fn center(&self) -> Vec3 {
        Vec4::from(self.position).truncate()
    }
}
