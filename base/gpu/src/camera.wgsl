// Camera model of flyrig-types: OpenCV axes, pixel centres at integers.
struct Camera {
    camera_from_world: mat4x4<f32>,
    position: vec4<f32>,
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    size: vec2<u32>,
    lens: u32,
    valid_radius: f32,
    // k1 k2 k3 p1 | p2 k4 k5 k6 (radial-tangential, rational), or k1 k2 k3 k4 (fisheye)
    coefficients_a: vec4<f32>,
    coefficients_b: vec4<f32>,
}

struct Projected {
    // Position in the image, pixels.
    pixel: vec2<f32>,
    // z in camera axes, metres.
    depth: f32,
    // False behind the camera, within `near` of its plane, beyond the lens's valid radius, or not finite.
    valid: bool,
}

// Distortion of a point of the ideal image plane, and its 2x2 Jacobian (columns d/dx, d/dy).
struct Distorted {
    point: vec2<f32>,
    jacobian: mat2x2<f32>,
}

fn distort(camera: Camera, ideal: vec2<f32>) -> Distorted {
    let x = ideal.x;
    let y = ideal.y;
    let r2 = dot(ideal, ideal);
    let k = camera.coefficients_a;
    var out: Distorted;
    if camera.lens == 0u {
        let k3 = k.z;
        let p1 = k.w;
        let p2 = camera.coefficients_b.x;
        let d = camera.coefficients_b.yzw;
        // Without k4 to k6 the division is by 1 and changes no bit.
        let below = 1.0 / (1.0 + r2 * (d.x + r2 * (d.y + r2 * d.z)));
        let radial = (1.0 + r2 * (k.x + r2 * (k.y + r2 * k3))) * below;
        // d radial / d r2, times 2 for d r2 / dx = 2 x.
        let above_slope = k.x + r2 * (2.0 * k.y + r2 * 3.0 * k3);
        let below_slope = d.x + r2 * (2.0 * d.y + r2 * 3.0 * d.z);
        let slope = 2.0 * (above_slope - radial * below_slope) * below;
        out.point = vec2(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        out.jacobian = mat2x2(
            vec2(radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, cross),
            vec2(cross, radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x),
        );
    } else {
        let r = sqrt(r2);
        if r < 1e-4 {
            out.point = ideal;
            out.jacobian = mat2x2(1.0, 0.0, 0.0, 1.0);
            return out;
        }
        let theta = atan(r);
        let t2 = theta * theta;
        let distorted = theta * (1.0 + t2 * (k.x + t2 * (k.y + t2 * (k.z + t2 * k.w))));
        let slope = (1.0 + t2 * (3.0 * k.x + t2 * (5.0 * k.y + t2 * (7.0 * k.z + t2 * 9.0 * k.w)))) / (1.0 + r2);
        let scale = distorted / r;
        // d(scale)/dr / r
        let bend = (slope - scale) / r2;
        out.point = ideal * scale;
        out.jacobian = mat2x2(
            vec2(scale + bend * x * x, bend * x * y),
            vec2(bend * x * y, scale + bend * y * y),
        );
    }
    return out;
}

// Pixel and depth of a world point.
fn project_point(camera: Camera, world: vec3<f32>, near: f32) -> Projected {
    let p = (camera.camera_from_world * vec4(world, 1.0)).xyz;
    var out: Projected;
    out.depth = p.z;
    out.pixel = vec2(0.0);
    out.valid = false;
    // Written so that NaN fails every comparison.
    if !(p.z > near && p.z < 1e9) {
        return out;
    }
    let ideal = p.xy / p.z;
    if !(dot(ideal, ideal) <= camera.valid_radius * camera.valid_radius) {
        return out;
    }
    out.pixel = distort(camera, ideal).point * camera.focal_px + camera.center_px;
    out.valid = true;
    return out;
}

// d pixel / d camera-space point at camera-space `p` (p.z > 0): columns d/dx, d/dy, d/dz.
fn projection_jacobian(camera: Camera, p: vec3<f32>) -> mat3x2<f32> {
    let inverse_z = 1.0 / p.z;
    let ideal = p.xy * inverse_z;
    let j = distort(camera, ideal).jacobian;
    let f = camera.focal_px * inverse_z;
    let dx = j[0] * f;
    let dy = j[1] * f;
    return mat3x2(dx, dy, -(ideal.x * dx + ideal.y * dy));
}
