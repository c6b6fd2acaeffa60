// Axes of an anisotropic Gaussian. Needs struct Camera.

// A shorter quaternion than 1e-15 has no direction in f32, and the square of a longer one than 1e15 overflows.
fn is_rotation(q: vec4<f32>) -> bool {
    return dot(q, q) > 1e-30 && dot(q, q) < 1e30;
}

fn camera_rotation(camera: Camera) -> mat3x3<f32> {
    let m = camera.camera_from_world;
    return mat3x3(m[0].xyz, m[1].xyz, m[2].xyz);
}

// Columns: unit vectors along the axes of a Gaussian of rotation `q` (x, y, z, w of any length) in camera axes.
fn axes_in_camera(camera: Camera, q: vec4<f32>) -> mat3x3<f32> {
    let u = q * inverseSqrt(dot(q, q));
    let x = u.x;
    let y = u.y;
    let z = u.z;
    let w = u.w;
    let in_world = mat3x3(
        vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
    return camera_rotation(camera) * in_world;
}
