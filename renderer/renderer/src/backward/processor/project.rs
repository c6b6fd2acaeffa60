//! Derivative of the projection: `backward/project.wgsl` on the processor.

use flyrig_gpu::CameraConstants;
use glam::{Mat2, Mat3, Vec2, Vec3, Vec4};

use crate::backward::gradients::Carry;
use crate::raster::processor::rasterizer::RasterImage;
use crate::raster::processor::shape::{Shape, camera_rotation, rows_along, rows_of};

/// 1 / (2 ln 2): the conics are for exp2.
const HALF_LOG2_E: f32 = 0.5 * std::f32::consts::LOG2_E;

/// Sums over pixels for one Gaussian. With e the exponent log2(alpha), s = dL/de of a pixel, (x, y) the pixel from the
/// splat's centre and w its blending weight: s, s x, s y, w dL/d(depth sum), s x x, s x y, s y y, w, w carried.
pub(super) type PairSum = [f32; 11];

/// Carries an isotropic Gaussian's sums through the filtered ellipse, the lens and the camera to the world.
pub(super) fn add_isotropic(
    rendered: &RasterImage,
    sums: &PairSum,
    center_scale: &[f32; 4],
    carry: Carry,
    center_out: &mut [f32; 4],
    carried_out: &mut [[f32; 4]],
) {
    let [.., weight, a, b, c] = *sums;
    let carried = [a, b, c];
    let [x, y, z, scale] = *center_scale;
    let view = ProjectedPoint::new(&rendered.camera, Vec3::new(x, y, z));
    let rows = rows_of(&view.jacobian).map(|row| row * scale);
    let (d_pixel, d_covariance) = through_ellipse(rendered, sums, rows);
    // Covariance = scale^2 J J^T.
    let twice = d_covariance * (2.0 * scale * scale);
    let in_world = view.to_world(d_pixel, view.jacobian.map(|column| twice * column), sums[3]);
    add(center_out, in_world.extend(weight));
    let [first, second] = match carry {
        Carry::Sum => [Vec4::new(carried[0], carried[1], carried[2], 0.0), Vec4::ZERO],
        Carry::Lift => {
            // J^T C J with C = (xx, xy, yy) of the image, J = d pixel / d world.
            let [du, dv] = rows_of(&view.jacobian).map(|row| view.world_from_camera * row);
            let (u, v) = (carried[0] * du + carried[1] * dv, carried[1] * du + carried[2] * dv);
            let entry = |i: usize, j: usize| du[i] * u[j] + dv[i] * v[j];
            [
                Vec4::new(entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1)),
                Vec4::new(entry(1, 2), entry(2, 2), 0.0, 0.0),
            ]
        }
    };
    if let ([out_first, out_second], true) = (carried_out, first.is_finite() && second.is_finite()) {
        *out_first = (Vec4::from(*out_first) + first).to_array();
        *out_second = (Vec4::from(*out_second) + second).to_array();
    }
}

/// Carries an anisotropic Gaussian's sums to its centre, its scales and opacity, and its rotation.
#[inline(always)]
pub(super) fn add_anisotropic(
    rendered: &RasterImage,
    sums: &PairSum,
    center: &[f32; 4],
    shape: &Shape,
    [center_out, scale_out, rotation_out]: [&mut [f32; 4]; 3],
) {
    let view = ProjectedPoint::new(&rendered.camera, Vec4::from(*center).truncate());
    let axes = shape.axes_in_camera(&rendered.camera);
    let along_axes = rows_along(&view.jacobian, &axes);
    let rows = along_axes.map(|row| row * shape.scale_m);
    let (d_pixel, d_covariance) = through_ellipse(rendered, sums, rows);
    // Covariance = M M^T with M = J A and A = axes * scales; dL/dM = `d_rows` by columns, dL/dJ = dL/dM A^T.
    let columns = |rows: [Vec3; 2]| [0, 1, 2].map(|k| Vec2::new(rows[0][k], rows[1][k]));
    let d_rows = columns(rows).map(|column| d_covariance * column * 2.0);
    let scaled =
        Mat3::from_cols(axes.x_axis * shape.scale_m.x, axes.y_axis * shape.scale_m.y, axes.z_axis * shape.scale_m.z);
    let d_jacobian =
        [0, 1, 2].map(|i| scaled.row(i).x * d_rows[0] + scaled.row(i).y * d_rows[1] + scaled.row(i).z * d_rows[2]);
    add(center_out, view.to_world(d_pixel, d_jacobian, sums[3]).extend(sums[7]));

    // An opacity above 1 counts as 1. The moments are those of the exponent log2(alpha).
    let d_opacity = if shape.opacity <= 1.0 { 2.0 * HALF_LOG2_E * sums[0] / shape.opacity } else { 0.0 };
    let by_axis = columns(along_axes);
    let d_scale = Vec3::from([0, 1, 2].map(|k| by_axis[k].dot(d_rows[k])));
    add(scale_out, d_scale.extend(d_opacity));

    // dL/dA = J^T dL/dM. The slope by a small turn, sum of a x dL/da over the columns, is carried to the quaternion u of unit
    // length: du = (turn, 0) u / 2.
    let turn: Vec3 =
        [0, 1, 2].map(|k| scaled.col(k).cross(view.jacobian.map(|along| along.dot(d_rows[k])).into())).iter().sum();
    add(rotation_out, by_quaternion(shape, view.world_from_camera * turn));
}

/// Carries the slope by a small turn in the world to the stored quaternion.
#[inline(always)]
pub(super) fn by_quaternion(shape: &Shape, turn: Vec3) -> Vec4 {
    let (u, w) = (shape.unit.truncate(), shape.unit.w);
    (turn * w + turn.cross(u)).extend(-turn.dot(u)) * (2.0 * shape.inverse_length)
}

/// Adds finite values only.
#[inline(always)]
pub(super) fn add(out: &mut [f32; 4], more: Vec4) {
    if more.is_finite() {
        *out = (Vec4::from(*out) + more).to_array();
    }
}

/// Returns dL/d pixel and dL/d covariance before the filter, whose matrix root has these rows: through the conic, and
/// through the opacity sqrt(det / filtered_det).
#[inline(always)]
fn through_ellipse(rendered: &RasterImage, sums: &PairSum, [row_x, row_y]: [Vec3; 2]) -> (Vec2, Mat2) {
    let [slope, slope_x, slope_y, _, xx_moment, xy_moment, yy_moment, ..] = *sums;
    let (xx, xy, yy) = (row_x.dot(row_x), row_x.dot(row_y), row_y.dot(row_y));
    let det = row_x.cross(row_y).length_squared();
    let s = rendered.settings.filter_variance_px2;
    let filtered_det = det + s * (xx + yy) + s * s;
    // Inverse covariances after and before the filter.
    let filtered_inverse = Mat2::from_cols_array(&[yy + s, -xy, -xy, xx + s]) * (1.0 / filtered_det);
    // An opacity that the filter keeps does not depend on the covariance.
    let is_kept = rendered.settings.filter_keeps_opacity;
    let (by_opacity, plain_det) = if is_kept { (0.0, 1.0) } else { (s, det) };
    let plain_inverse = Mat2::from_cols_array(&[yy, -xy, -xy, xx]) * (1.0 / plain_det);
    let d_pixel = filtered_inverse * Vec2::new(slope_x, slope_y) * (2.0 * HALF_LOG2_E);
    let moments = Mat2::from_cols_array(&[xx_moment, xy_moment, xy_moment, yy_moment]);
    let d_covariance = (filtered_inverse * moments * filtered_inverse
        + plain_inverse * filtered_inverse * (by_opacity * slope))
        * HALF_LOG2_E;
    (d_pixel, d_covariance)
}

/// Projection of a point and its derivatives.
struct ProjectedPoint<'a> {
    camera: &'a CameraConstants,
    ideal: Vec2,
    inverse_z: f32,
    /// Columns of d pixel / d camera-space point.
    jacobian: [Vec2; 3],
    world_from_camera: Mat3,
}

impl<'a> ProjectedPoint<'a> {
    #[inline(always)]
    fn new(camera: &'a CameraConstants, world: Vec3) -> Self {
        let p = camera.to_camera(world);
        let inverse_z = 1.0 / p.z;
        let jacobian = camera.projection_jacobian(p);
        let world_from_camera = camera_rotation(camera).transpose();
        Self { camera, ideal: p.truncate() * inverse_z, inverse_z, jacobian, world_from_camera }
    }

    /// Returns dL/d world position, given dL/d pixel, dL/d Jacobian by columns and dL/d depth.
    #[inline(always)]
    fn to_world(&self, d_pixel: Vec2, d_jacobian: [Vec2; 3], by_depth: f32) -> Vec3 {
        let Self { camera, ideal, inverse_z, jacobian: [along_x, along_y, along_z], .. } = *self;
        let focal = Vec2::from(camera.focal_px) * inverse_z;
        let [d_along_x, d_along_y, d_along_z] = d_jacobian;
        let d_along_x = d_along_x - ideal.x * d_along_z;
        let d_along_y = d_along_y - ideal.y * d_along_z;
        let d_lens = [d_along_x * focal, d_along_y * focal];
        let d_ideal =
            through_lens_jacobian(camera, ideal, d_lens) - Vec2::new(d_along_z.dot(along_x), d_along_z.dot(along_y));
        let d_z = by_depth - (d_along_x.dot(along_x) + d_along_y.dot(along_y) + ideal.dot(d_ideal)) * inverse_z;
        let in_camera = Vec3::new(
            d_pixel.dot(along_x) + d_ideal.x * inverse_z,
            d_pixel.dot(along_y) + d_ideal.y * inverse_z,
            d_pixel.dot(along_z) + d_z,
        );
        self.world_from_camera * in_camera
    }
}

/// Returns dL/d ideal image point through the lens's Jacobian, given dL/d Jacobian by columns.
#[inline(always)]
pub(super) fn through_lens_jacobian(camera: &CameraConstants, ideal: Vec2, d: [Vec2; 2]) -> Vec2 {
    let Vec2 { x, y } = ideal;
    let r2 = ideal.length_squared();
    let [k1, k2, k3, k4, ..] = camera.coefficients;
    // A radial factor s(r): first = s'/r, second = (s'/r)'/r.
    let (first, second, p1, p2);
    if camera.lens == 0 {
        // s = above / below, polynomials of q = r^2: first = 2 ds/dq, second = 4 d2s/dq2.
        let [d1, d2, d3] = [camera.coefficients[5], camera.coefficients[6], camera.coefficients[7]];
        let below = 1.0 / (1.0 + r2 * (d1 + r2 * (d2 + r2 * d3)));
        let below_slope = d1 + r2 * (2.0 * d2 + r2 * 3.0 * d3);
        let s = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * below;
        let slope = (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - s * below_slope) * below;
        first = 2.0 * slope;
        second = 4.0 * (2.0 * k2 + 6.0 * k3 * r2 - 2.0 * slope * below_slope - s * (2.0 * d2 + 6.0 * d3 * r2)) * below;
        (p1, p2) = (camera.coefficients[3], camera.coefficients[4]);
    } else if r2 < 1e-4 {
        // Taylor: s = 1 + (k1 - 1/3) r^2 + O(r^4); the formulas below cancel here.
        first = 2.0 * (k1 - 1.0 / 3.0);
        (second, p1, p2) = (0.0, 0.0, 0.0);
    } else {
        let r = r2.sqrt();
        let theta = r.atan();
        let t2 = theta * theta;
        let n = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
        let dn = theta * (6.0 * k1 + t2 * (20.0 * k2 + t2 * (42.0 * k3 + t2 * 72.0 * k4)));
        let s = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r;
        let inverse = 1.0 / (1.0 + r2);
        first = (n * inverse - s) / r2;
        let bend = (dn - 2.0 * r * n) * inverse * inverse;
        second = (bend / r - 3.0 * first) / r2;
        (p1, p2) = (0.0, 0.0);
    }
    let u_xx = 3.0 * x * first + x * x * x * second + 6.0 * p2;
    let u_xy = y * first + x * x * y * second + 2.0 * p1;
    let u_yy = x * first + x * y * y * second + 2.0 * p2;
    let v_yy = 3.0 * y * first + y * y * y * second + 6.0 * p1;
    // v_xx = u_xy and v_xy = u_yy for all lenses.
    let off_diagonal = d[1].x + d[0].y;
    Vec2::new(d[0].x * u_xx + off_diagonal * u_xy + d[1].y * u_yy, d[0].x * u_xy + off_diagonal * u_yy + d[1].y * v_yy)
}
