//! Planes of anisotropic Gaussians: `anisotropic/plane.wgsl` and `raster/planes.wgsl` on the processor.

use flyrig_gpu::CameraConstants;
use glam::{Mat2, Mat3, Vec2, Vec3, Vec4};

use crate::raster::kernels::{LEAST_COSINE, MOST_REACH, REACH};
use crate::raster::processor::lanes::{LANES, Lanes};
use crate::raster::processor::project::ProjectedSplat;
use crate::raster::processor::shape::{Shape, rows_of};

/// Plane of a Gaussian. Along the ray of the pixel at the offset d from the splat's centre, the plane's depth is the centre's over
/// t = 1 + slope · d, with t kept within `least` and `most`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Plane {
    /// Unit normal in camera axes, towards the camera.
    pub normal: [f32; 3],
    /// Change of t per pixel.
    pub slope: [f32; 2],
    pub least: f32,
    pub most: f32,
}

impl Plane {
    /// Computes t at the pixels of a row, before it is limited.
    #[inline(always)]
    pub fn inverse_ratios(&self, splat: &ProjectedSplat, origin: [f32; 2], row: usize) -> Lanes {
        let dy = origin[1] + row as f32 - splat.pixel.y;
        let mut inverse_ratios = [0.0; LANES];
        for (lane, inverse_ratio) in inverse_ratios.iter_mut().enumerate() {
            let dx = origin[0] + lane as f32 - splat.pixel.x;
            *inverse_ratio = 1.0 + self.slope[0] * dx + self.slope[1] * dy;
        }
        inverse_ratios
    }

    /// Limits t; NaN becomes the least.
    #[inline(always)]
    pub fn limit(&self, inverse_ratio: f32) -> f32 {
        let above = if inverse_ratio > self.least { inverse_ratio } else { self.least };
        if above < self.most { above } else { self.most }
    }

    /// Computes the plane's depths at the pixels of a row, metres.
    #[inline(always)]
    pub fn depths(&self, splat: &ProjectedSplat, origin: [f32; 2], row: usize) -> Lanes {
        let mut depths = self.inverse_ratios(splat, origin, row);
        for depth in &mut depths {
            *depth = splat.depth / self.limit(*depth);
        }
        depths
    }
}

/// Plane of a Gaussian with the numbers that its derivative needs.
pub(crate) struct PlaneShape {
    pub plane: Plane,
    /// x/z and y/z of the centre.
    pub ideal: Vec2,
    /// Derivative of the lens by the ideal point; columns, without the focal length.
    pub lens: Mat2,
    /// Inverse of d pixel / d ideal point.
    pub ideal_by_pixel: Mat2,
    /// Product of the normal and the ray through the centre with z = 1, at most `-LEAST_COSINE`.
    pub cosine: f32,
    pub is_edge_on: bool,
    /// Standard deviation along camera z, metres.
    pub deviation_m: f32,
    /// Limit of the depth's distance from that of the centre, as a share of the latter.
    pub reach: f32,
}

impl PlaneShape {
    /// Computes the plane of a Gaussian at camera-space `p`, with unit axes in camera axes as columns. A slope that is not finite
    /// (where the lens folds) becomes 0.
    #[inline(always)]
    pub fn new(camera: &CameraConstants, p: Vec3, axes: &Mat3, scale_m: Vec3) -> Self {
        let inverse_z = 1.0 / p.z;
        let ideal = p.truncate() * inverse_z;
        let lens = camera.distort(ideal).jacobian;
        let focal = Vec2::from(camera.focal_px);
        let (by_x, by_y) = (lens.x_axis * focal, lens.y_axis * focal);
        let inverse_det = 1.0 / (by_x.x * by_y.y - by_y.x * by_x.y);
        let ideal_by_pixel = Mat2::from_cols(Vec2::new(by_y.y, -by_x.y), Vec2::new(-by_y.x, by_x.x)) * inverse_det;
        let along = axes.col(smallest(scale_m));
        let normal = if along.dot(p) > 0.0 { -along } else { along };
        let facing = normal.x * ideal.x + normal.y * ideal.y + normal.z;
        let is_edge_on = facing.is_nan() || facing > -LEAST_COSINE;
        let cosine = if is_edge_on { -LEAST_COSINE } else { facing };
        let slope = Vec2::new(
            ideal_by_pixel.x_axis.dot(normal.truncate()) / cosine,
            ideal_by_pixel.y_axis.dot(normal.truncate()) / cosine,
        );
        let slope = if slope.is_finite() { slope } else { Vec2::ZERO };
        let deviation_m = (Vec3::new(axes.x_axis.z, axes.y_axis.z, axes.z_axis.z) * scale_m).length();
        let reach = REACH * deviation_m * inverse_z;
        let reach = if reach < MOST_REACH { reach } else { MOST_REACH };
        let (least, most) = (1.0 / (1.0 + reach), 1.0 / (1.0 - reach));
        let plane = Plane { normal: normal.to_array(), slope: slope.to_array(), least, most };
        Self { plane, ideal, lens, ideal_by_pixel, cosine, is_edge_on, deviation_m, reach }
    }

    /// Returns the rows of d pixel / d camera-space point.
    #[inline(always)]
    pub fn pixel_by_point(&self, camera: &CameraConstants, z: f32) -> [Vec3; 2] {
        let focal = Vec2::from(camera.focal_px) / z;
        let (by_x, by_y) = (self.lens.x_axis * focal, self.lens.y_axis * focal);
        rows_of(&[by_x, by_y, -(self.ideal.x * by_x + self.ideal.y * by_y)])
    }
}

/// Returns the index of the smallest scale, the first of equal ones.
#[inline(always)]
fn smallest(scale: Vec3) -> usize {
    let first = usize::from(scale.y < scale.x);
    if scale.z < scale[first] { 2 } else { first }
}

/// Planes of a chunk of Gaussians.
pub(super) struct PlaneChunk<'a> {
    pub camera: &'a CameraConstants,
    /// Index of the chunk's first Gaussian.
    pub first: usize,
    pub center: &'a [[f32; 4]],
    pub scale_opacity: &'a [[f32; 4]],
    pub rotation: &'a [[f32; 4]],
    /// Receives the planes. Those of Gaussians that are not drawn have no meaning.
    pub planes: &'a mut [Plane],
}

impl pulp::NullaryFnOnce for PlaneChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (at, plane) in self.planes.iter_mut().enumerate() {
            let i = self.first + at;
            let Some(shape) = Shape::new(&self.scale_opacity[i], &self.rotation[i]) else { continue };
            let p = self.camera.to_camera(Vec4::from(self.center[i]).truncate());
            *plane = PlaneShape::new(self.camera, p, &shape.axes_in_camera(self.camera), shape.scale_m).plane;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_of_equal_scales_is_the_smallest() {
        let cases = [([1.0; 3], 0), ([2.0, 1.0, 1.0], 1), ([2.0, 2.0, 1.0], 2), ([1.0, 2.0, 1.0], 0)];
        for (scale, expected) in cases {
            assert_eq!(smallest(Vec3::from(scale)), expected, "{scale:?}");
        }
    }
}
