// Derivative of the projection: one invocation a Gaussian carries its sums through the filtered ellipse, the lens and the
// camera to the world. Adds to the outputs, so that views can follow each other.
//
// Complete where the image is smooth: position in the image, depth, and the ellipse's size and shape (with the
// lens's second derivatives). Nothing flows through what jumps: the cut at CUT, the end at OPAQUE, the order by depth,
// back-face culling.
// Lines between "// only isotropic" or "// only anisotropic" and "// end" belong to Gaussians of that kind, those after "// only
// planes" to images with planes.
// Prefix: camera.wgsl, raster/frame.wgsl, backward/frame.wgsl; for isotropic Gaussians const LIFT, for anisotropic ones
// anisotropic/axes.wgsl, with planes anisotropic/plane.wgsl and backward/planes.wgsl, their first three attributes at bindings 2 to 4 and derivatives at 5 to 7.
@group(0) @binding(0) var<storage, read> frame: Frame;
@group(0) @binding(1) var<storage, read> sums: array<PairSum>;
// only isotropic
@group(0) @binding(2) var<storage, read> center_scale: array<vec4<f32>>;
// xyz: dL/d centre; w: blending weight over the pixels that matter.
@group(0) @binding(3) var<storage, read_write> center_out: array<vec4<f32>>;
// Two elements a Gaussian: carried numbers (LIFT false), or xx xy xz yy | yz zz of the lifted matrix.
@group(0) @binding(4) var<storage, read_write> carried_out: array<vec4<f32>>;
// end

// 1 / (2 ln 2): the conics are for exp2.
const HALF_LOG2_E = 0.72134752;

fn finite(v: vec4<f32>) -> bool {
    return all((bitcast<vec4<u32>>(v) & vec4(0x7f800000u)) != vec4(0x7f800000u));
}

// dL/d ideal through the lens's Jacobian, given dL/d Jacobian (columns as those of the Jacobian).
fn through_lens_jacobian(camera: Camera, ideal: vec2<f32>, d: mat2x2<f32>) -> vec2<f32> {
    let x = ideal.x;
    let y = ideal.y;
    let r2 = dot(ideal, ideal);
    let k = camera.coefficients_a;
    // A radial factor s(r): first = s'/r, second = (s'/r)'/r.
    var first = 0.0;
    var second = 0.0;
    var p1 = 0.0;
    var p2 = 0.0;
    if camera.lens == 0u {
        // s = above / below, polynomials of q = r^2: first = 2 ds/dq, second = 4 d2s/dq2.
        let d = camera.coefficients_b.yzw;
        let below = 1.0 / (1.0 + r2 * (d.x + r2 * (d.y + r2 * d.z)));
        let below_slope = d.x + r2 * (2.0 * d.y + r2 * 3.0 * d.z);
        let s = (1.0 + r2 * (k.x + r2 * (k.y + r2 * k.z))) * below;
        let slope = (k.x + r2 * (2.0 * k.y + r2 * 3.0 * k.z) - s * below_slope) * below;
        first = 2.0 * slope;
        second = 4.0 * (2.0 * k.y + 6.0 * k.z * r2 - 2.0 * slope * below_slope - s * (2.0 * d.y + 6.0 * d.z * r2)) * below;
        p1 = k.w;
        p2 = camera.coefficients_b.x;
    } else if r2 < 1e-4 {
        // Taylor: s = 1 + (k1 - 1/3) r^2 + O(r^4); the formulas below cancel here.
        first = 2.0 * (k.x - 1.0 / 3.0);
    } else {
        let r = sqrt(r2);
        let theta = atan(r);
        let t2 = theta * theta;
        let n = 1.0 + t2 * (3.0 * k.x + t2 * (5.0 * k.y + t2 * (7.0 * k.z + t2 * 9.0 * k.w)));
        let dn = theta * (6.0 * k.x + t2 * (20.0 * k.y + t2 * (42.0 * k.z + t2 * 72.0 * k.w)));
        let s = theta * (1.0 + t2 * (k.x + t2 * (k.y + t2 * (k.z + t2 * k.w)))) / r;
        let inverse = 1.0 / (1.0 + r2);
        first = (n * inverse - s) / r2;
        let bend = (dn - 2.0 * r * n) * inverse * inverse;
        second = (bend / r - 3.0 * first) / r2;
    }
    let u_xx = 3.0 * x * first + x * x * x * second + 6.0 * p2;
    let u_xy = y * first + x * x * y * second + 2.0 * p1;
    let u_yy = x * first + x * y * y * second + 2.0 * p2;
    let v_yy = 3.0 * y * first + y * y * y * second + 6.0 * p1;
    // v_xx = u_xy and v_xy = u_yy for all lenses.
    return vec2(
        d[0].x * u_xx + (d[1].x + d[0].y) * u_xy + d[1].y * u_yy,
        d[0].x * u_xy + (d[1].x + d[0].y) * u_yy + d[1].y * v_yy,
    );
}

@compute @workgroup_size(64)
fn project_backward(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                    @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i >= frame.gaussians {
        return;
    }
    let sums_a = sums[i].vectors[0];
    let sums_b = sums[i].vectors[1];
    if !(sums_b.w > 0.0) {
        return;
    }
    // only isotropic
    let world = center_scale[i].xyz;
    let scale_m = center_scale[i].w;
    // end
    // only anisotropic
    let world = center[i].xyz;
    let scale_m = scale_opacity[i].xyz;
    // end
    let p = (frame.camera.camera_from_world * vec4(world, 1.0)).xyz;
    let inverse_z = 1.0 / p.z;
    let ideal = p.xy * inverse_z;
    let lens = distort(frame.camera, ideal).jacobian;
    let f = frame.camera.focal_px * inverse_z;
    // Columns of d pixel / d camera-space point.
    let along_x = lens[0] * f;
    let along_y = lens[1] * f;
    let along_z = -(ideal.x * along_x + ideal.y * along_y);
    // only isotropic
    let row_x = vec3(along_x.x, along_y.x, along_z.x) * scale_m;
    let row_y = vec3(along_x.y, along_y.y, along_z.y) * scale_m;
    // end
    // only anisotropic
    let axes = axes_in_camera(frame.camera, rotation[i]);
    let along_axes = mat3x2(along_x, along_y, along_z) * axes;
    let row_x = vec3(along_axes[0].x, along_axes[1].x, along_axes[2].x) * scale_m;
    let row_y = vec3(along_axes[0].y, along_axes[1].y, along_axes[2].y) * scale_m;
    // end
    let xx = dot(row_x, row_x);
    let xy = dot(row_x, row_y);
    let yy = dot(row_y, row_y);
    let normal_of_rows = cross(row_x, row_y);
    let det = dot(normal_of_rows, normal_of_rows);
    let s = frame.filter_variance_px2;
    let filtered_det = det + s * (xx + yy) + s * s;
    // Inverse covariances after and before the filter.
    let filtered_inverse = mat2x2(yy + s, -xy, -xy, xx + s) * (1.0 / filtered_det);
    // An opacity that the filter keeps does not depend on the covariance.
    let is_kept = frame.filter_keeps_opacity != 0u;
    let by_opacity = select(s, 0.0, is_kept);
    let plain_inverse = mat2x2(yy, -xy, -xy, xx) * (1.0 / select(det, 1.0, is_kept));
    let d_pixel = filtered_inverse * sums_a.yz * (2.0 * HALF_LOG2_E);
    // dL/d covariance: through the conic, and through the opacity sqrt(det / filtered_det).
    let moments = mat2x2(sums_b.x, sums_b.y, sums_b.y, sums_b.z);
    let d_covariance =
        (filtered_inverse * moments * filtered_inverse + plain_inverse * filtered_inverse * (by_opacity * sums_a.x)) * HALF_LOG2_E;
    // dL/d the columns of the projection's Jacobian J.
    // only isotropic
    // Covariance = scale^2 J J^T.
    let twice = d_covariance * (2.0 * scale_m * scale_m);
    let d_along_z = twice * along_z;
    let d_along_x = twice * along_x - ideal.x * d_along_z;
    let d_along_y = twice * along_y - ideal.y * d_along_z;
    // end
    // only anisotropic
    // Covariance = M M^T with M = J A and A = axes * scales; dL/dM = `d_rows`, dL/dJ = dL/dM A^T.
    let d_rows = d_covariance * mat3x2(vec2(row_x.x, row_y.x), vec2(row_x.y, row_y.y), vec2(row_x.z, row_y.z)) * 2.0;
    let scaled = mat3x3(axes[0] * scale_m.x, axes[1] * scale_m.y, axes[2] * scale_m.z);
    let d_jacobian = d_rows * transpose(scaled);
    let d_along_z = d_jacobian[2];
    let d_along_x = d_jacobian[0] - ideal.x * d_along_z;
    let d_along_y = d_jacobian[1] - ideal.y * d_along_z;
    // end
    let d_lens = mat2x2(d_along_x * f, d_along_y * f);
    let d_ideal = through_lens_jacobian(frame.camera, ideal, d_lens)
        - vec2(dot(d_along_z, along_x), dot(d_along_z, along_y));
    let d_z = sums_a.w - (dot(d_along_x, along_x) + dot(d_along_y, along_y) + dot(ideal, d_ideal)) * inverse_z;
    let in_camera = vec3(
        dot(d_pixel, along_x) + d_ideal.x * inverse_z,
        dot(d_pixel, along_y) + d_ideal.y * inverse_z,
        dot(d_pixel, along_z) + d_z,
    );
    let m = frame.camera.camera_from_world;
    let camera_from_world = mat3x3(m[0].xyz, m[1].xyz, m[2].xyz);
    let in_world = vec4(in_camera * camera_from_world, sums_b.w);
    if finite(in_world) {
        center_out[i] += in_world;
    }
    // only isotropic
    let carried = sums[i].vectors[2];
    if LIFT {
        // J^T C J with C = (xx, xy, yy) of the image, J = d pixel / d world.
        let du = vec3(along_x.x, along_y.x, along_z.x) * camera_from_world;
        let dv = vec3(along_x.y, along_y.y, along_z.y) * camera_from_world;
        let column_u = carried.x * du + carried.y * dv;
        let column_v = carried.y * du + carried.z * dv;
        let first = vec4(dot(vec2(du.x, dv.x), vec2(column_u.x, column_v.x)),
                         dot(vec2(du.x, dv.x), vec2(column_u.y, column_v.y)),
                         dot(vec2(du.x, dv.x), vec2(column_u.z, column_v.z)),
                         dot(vec2(du.y, dv.y), vec2(column_u.y, column_v.y)));
        let second = vec4(dot(vec2(du.y, dv.y), vec2(column_u.z, column_v.z)),
                          dot(vec2(du.z, dv.z), vec2(column_u.z, column_v.z)), 0.0, 0.0);
        if finite(first) && finite(second) {
            carried_out[2u * i] += first;
            carried_out[2u * i + 1u] += second;
        }
    } else if finite(carried) {
        carried_out[2u * i] += carried;
    }
    // end
    // only anisotropic
    // An opacity above 1 counts as 1. The moments are those of the exponent log2(alpha).
    let own_opacity = scale_opacity[i].w;
    let d_opacity = select(0.0, 2.0 * HALF_LOG2_E * sums_a.x / own_opacity, own_opacity <= 1.0);
    let d_scale = vec3(dot(along_axes[0], d_rows[0]), dot(along_axes[1], d_rows[1]), dot(along_axes[2], d_rows[2]));
    if finite(vec4(d_scale, d_opacity)) {
        scale_opacity_out[i] += vec4(d_scale, d_opacity);
    }
    // dL/dA = J^T dL/dM. The slope by a small turn, sum of a x dL/da over the columns, is carried to the quaternion u of unit
    // length: du = (turn, 0) u / 2.
    let d_scaled = transpose(mat3x2(along_x, along_y, along_z)) * d_rows;
    let turn = (cross(scaled[0], d_scaled[0]) + cross(scaled[1], d_scaled[1]) + cross(scaled[2], d_scaled[2]))
        * camera_from_world;
    let inverse_length = inverseSqrt(dot(rotation[i], rotation[i]));
    let u = rotation[i] * inverse_length;
    let d_rotation = vec4(turn * u.w + cross(turn, u.xyz), -dot(turn, u.xyz)) * (2.0 * inverse_length);
    if finite(d_rotation) {
        rotation_out[i] += d_rotation;
    }
    // end
    // only planes
    let slopes = plane_slopes(frame.camera, p, axes, scale_m, sums[i].vectors[3], sums[i].vectors[4]);
    let by_plane = slopes.center * camera_from_world;
    if finite(vec4(by_plane, 0.0)) {
        center_out[i] += vec4(by_plane, 0.0);
    }
    if finite(vec4(slopes.scale, 0.0)) {
        scale_opacity_out[i] += vec4(slopes.scale, 0.0);
    }
    let plane_turn = slopes.turn * camera_from_world;
    let by_turn = vec4(plane_turn * u.w + cross(plane_turn, u.xyz), -dot(plane_turn, u.xyz)) * (2.0 * inverse_length);
    if finite(by_turn) {
        rotation_out[i] += by_turn;
    }
    // end
}
