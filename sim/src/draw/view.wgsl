// Sub-frame of a camera, and its projection of points to pixels. Prepended: `NEAR_M`.

// Light at a row's time: each lamp's level, and the ambient light.
struct Row {
    levels: vec4<f32>,
    around: vec4<f32>,
}

struct View {
    camera_from_world: mat4x4<f32>,
    // World position of the lens's centre.
    eye: vec4<f32>,
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    size_px: vec2<f32>,
    // Columns of the grid of directions, and the side of its cells in pixels.
    grid: vec2<f32>,
    // k1, k2, k3; w: beyond this radius the lens is continued linearly.
    radial: vec4<f32>,
    // p1, p2; z is 1 for a fisheye.
    tangential: vec4<f32>,
    // k1 to k4 of a fisheye; else k4, k5, k6 of a rational lens.
    fisheye: vec4<f32>,
    // xy: point on the lens in camera axes, metres; z: 1 / focal distance.
    lens_point: vec4<f32>,
    // x: the middle row's seconds from the shot's instant; y: seconds from row to row; z: the middle row;
    // w: layer of the plate that is being baked.
    moment: vec4<f32>,
    // First key's seconds from the shot's instant, keys per second, number of keys.
    keys: vec4<f32>,
    // x: weight of this sub-frame in its image; y, z: 1 for the first and for the last sub-frame;
    // w: 1 if people are rendered.
    sum: vec4<f32>,
    rows: array<Row>,
}

// Ideal image plane of a point in camera axes, seen through a point of the lens.
fn ideal_of(camera: vec3<f32>, view_lens: vec3<f32>) -> vec2<f32> {
    // Behind the camera the sign stays: times z it is then right for the clipping of triangles that reach behind it.
    let z = select(camera.z, select(-1e-4, 1e-4, camera.z >= 0.0), abs(camera.z) < 1e-4);
    return (camera.xy - view_lens.xy) / z + view_lens.xy * view_lens.z;
}

fn pixel_of(camera: vec3<f32>) -> vec2<f32> {
    let ideal = ideal_of(camera, view.lens_point.xyz);
    let radius = length(ideal);
    let r = min(radius, view.radial.w);
    let r2 = r * r;
    var bent = ideal;
    if (view.tangential.z > 0.5) {
        let theta = atan(r);
        let t2 = theta * theta;
        let k = view.fisheye;
        bent *= theta * (1.0 + t2 * (k.x + t2 * (k.y + t2 * (k.z + t2 * k.w)))) / max(radius, 1e-9);
    } else {
        let k = view.radial.xyz;
        let d = view.fisheye.xyz;
        bent *= (1.0 + r2 * (k.x + r2 * (k.y + r2 * k.z))) / (1.0 + r2 * (d.x + r2 * (d.y + r2 * d.z)));
        let p = view.tangential.xy;
        let q = ideal * (r / max(radius, 1e-9));
        bent += 2.0 * p * q.x * q.y + p.yx * (vec2(r2) + 2.0 * q * q);
    }
    return bent * view.focal_px + view.center_px;
}

// w = z makes the interpolation perspective-correct; the device's depth is 1 - near / z.
fn clip_of(pixel: vec2<f32>, z: f32) -> vec4<f32> {
    let device = (pixel + 0.5) / view.size_px * vec2(2.0, -2.0) + vec2(-1.0, 1.0);
    return vec4(device * z, z - NEAR_M, z);
}
