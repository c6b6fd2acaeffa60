// What the passes of one picture share.

struct View {
    camera_from_world: mat4x4<f32>,
    light_from_world: mat4x4<f32>,
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    size_px: vec2<f32>,
    // k1, k2; beyond the radius z the lens is continued linearly; w is 1 for a fisheye.
    lens: vec4<f32>,
    // k1 to k4 of a fisheye.
    fisheye: vec4<f32>,
    // Unit vector towards the key light.
    to_light: vec4<f32>,
    key: vec4<f32>,
    sky: vec4<f32>,
    ground: vec4<f32>,
    // World x, y of both feet, and how close to the floor they are (0..1).
    feet: array<vec4<f32>, 2>,
}

