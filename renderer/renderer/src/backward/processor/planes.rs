//! Derivative of the planes: `backward/planes.wgsl` on the processor.

use glam::{Vec2, Vec3, Vec4};

use crate::backward::processor::project::{add, by_quaternion, through_lens_jacobian};
use crate::raster::kernels::{MOST_REACH, REACH};
use crate::raster::processor::planes::PlaneShape;
use crate::raster::processor::rasterizer::RasterImage;
use crate::raster::processor::shape::{Shape, camera_rotation};

/// Sums over pixels for one Gaussian's plane. With w the blending weight of a pixel at (x, y) from the splat's centre, and
/// t = 1 + slope · (x, y) the ratio of the centre's depth to the plane's: w dL/d normal sum (three), w dL/d depth sum / t, then dL/dt,
/// dL/dt x, dL/dt y where t is not limited, and dL/d reach where it is.
pub(super) type PlaneSum = [f32; 8];

/// Carries the sums of an anisotropic Gaussian's plane to its centre, its scales and its rotation. Nothing flows to the normal
/// through the slope of a plane that is edge-on, nor to the scales where the reach is limited.
#[inline(always)]
pub(super) fn add_plane(
    rendered: &RasterImage,
    sums: &PlaneSum,
    center: &[f32; 4],
    gaussian: &Shape,
    [center_out, scale_out, rotation_out]: [&mut [f32; 4]; 3],
) {
    let camera = &rendered.camera;
    let p = camera.to_camera(Vec4::from(*center).truncate());
    let axes = gaussian.axes_in_camera(camera);
    let shape = PlaneShape::new(camera, p, &axes, gaussian.scale_m);
    let [nx, ny, nz, by_depth, by_inverse, by_slope_x, by_slope_y, by_reach] = *sums;
    let inverse_z = 1.0 / p.z;
    let (normal, slope) = (Vec3::from(shape.plane.normal), Vec2::from(shape.plane.slope));

    // slope = L^-T normal.xy / cosine with L = d pixel / d ideal point.
    let by_slope = Vec2::new(by_slope_x, by_slope_y);
    let by_ideal = shape.ideal_by_pixel * by_slope;
    let by_cosine = if shape.is_edge_on { 0.0 } else { -slope.dot(by_slope) / shape.cosine };
    let d_normal = Vec3::new(nx, ny, nz) + (by_ideal / shape.cosine).extend(0.0) + shape.ideal.extend(1.0) * by_cosine;
    let by_row = -slope * Vec2::from(camera.focal_px);
    let d_ideal = normal.truncate() * by_cosine
        + through_lens_jacobian(camera, shape.ideal, [by_row * by_ideal.x, by_row * by_ideal.y]);
    // t is 1 at the splat's centre, which moves with the Gaussian.
    let d_pixel = -slope * by_inverse;
    let [along_u, along_v] = shape.pixel_by_point(camera, p.z);

    // reach = REACH deviation / z, and the deviation is the length of `along_z`.
    let by_reach = if shape.reach < MOST_REACH { by_reach } else { 0.0 };
    let by_deviation = REACH * inverse_z * by_reach / shape.deviation_m.max(1e-30);
    let axis_z = Vec3::new(axes.x_axis.z, axes.y_axis.z, axes.z_axis.z);
    let along_z = axis_z * gaussian.scale_m;
    let d_scale = axis_z * along_z * by_deviation;
    let d_axis_z = gaussian.scale_m * along_z * by_deviation;

    let d_z = by_depth - (shape.ideal.dot(d_ideal) + shape.reach * by_reach) * inverse_z;
    let in_camera = along_u * d_pixel.x + along_v * d_pixel.y + (d_ideal * inverse_z).extend(d_z);
    // The slope by a small turn, sum of a x dL/da over the axes. Those of the normal have its sign.
    let turn = normal.cross(d_normal)
        + axes.x_axis.cross(Vec3::Z) * d_axis_z.x
        + axes.y_axis.cross(Vec3::Z) * d_axis_z.y
        + axes.z_axis.cross(Vec3::Z) * d_axis_z.z;
    let world_from_camera = camera_rotation(camera).transpose();
    add(center_out, (world_from_camera * in_camera).extend(0.0));
    add(scale_out, d_scale.extend(0.0));
    add(rotation_out, by_quaternion(gaussian, world_from_camera * turn));
}
