//! The camera model of `flyrig-types` as a uniform, and its WGSL.

use bytemuck::{Pod, Zeroable};
use flyrig_types::{Camera, Lens};

/// WGSL: `struct Camera`, `fn project_point`, `fn distort`, `fn projection_jacobian`. Prepend it to a
/// kernel that declares a `Camera` binding; it declares no bindings itself.
pub const CAMERA_WGSL: &str = include_str!("camera.wgsl");

/// [`Camera`] for the GPU; layout of `struct Camera` in [`CAMERA_WGSL`] (std140, 144 bytes).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct CameraConstants {
    /// Columns of the homogeneous matrix.
    pub camera_from_world: [[f32; 4]; 4],
    /// Camera centre in the world, metres; w is unused.
    pub position: [f32; 4],
    /// Pixels.
    pub focal_px: [f32; 2],
    /// Pixels, centres at integers.
    pub center_px: [f32; 2],
    /// Pixels.
    pub size: [u32; 2],
    /// 0 radial-tangential, 1 fisheye.
    pub lens: u32,
    /// See [`Lens::valid_radius`].
    pub valid_radius: f32,
    /// k1 k2 k3 p1 p2, or the fisheye's k1 to k4.
    pub coefficients: [f32; 8],
}

impl From<&Camera> for CameraConstants {
    fn from(camera: &Camera) -> Self {
        let i = &camera.intrinsics;
        let (lens, c) = match i.lens {
            Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } => (0, [k1, k2, k3, p1, p2]),
            Lens::Fisheye { coefficients: [k1, k2, k3, k4] } => (1, [k1, k2, k3, k4, 0.0]),
        };
        let mut coefficients = [0.0; 8];
        for (to, from) in coefficients.iter_mut().zip(c) {
            *to = from as f32;
        }
        Self {
            camera_from_world: camera.camera_from_world.to_matrix().as_mat4().to_cols_array_2d(),
            position: camera.position().as_vec3().extend(1.0).to_array(),
            focal_px: i.focal_px.as_vec2().to_array(),
            center_px: i.center_px.as_vec2().to_array(),
            size: [i.width, i.height],
            lens,
            valid_radius: i.lens.valid_radius() as f32,
            coefficients,
        }
    }
}
