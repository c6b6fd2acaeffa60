// Straight-alpha sRGB bytes of premultiplied linear colour, as rgba8_from_target (color.rs) makes them: one invocation a pixel.
// After srgb_from_linear of flyrig_model.
@group(0) @binding(0) var<storage, read> color: array<vec4<f32>>;
// Red in the lowest byte.
@group(0) @binding(1) var<storage, read_write> bytes: array<u32>;
// x: pixels.
@group(0) @binding(2) var<storage, read> count: vec4<u32>;

// On the bits, since compilers may assume that no float is NaN.
fn is_nan(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7fffffffu) > 0x7f800000u;
}

fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// Nearest byte of 0..=1; clamps, NaN becomes 0.
fn byte(value: f32) -> u32 {
    return select(u32(clamp(value, 0.0, 1.0) * 255.0 + 0.5), 0u, is_nan(value));
}

fn encoded(linear: f32) -> u32 {
    return select(byte(srgb_from_linear(clamp(linear, 0.0, 1.0))), 0u, is_nan(linear));
}

@compute @workgroup_size(256)
fn write_bytes(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) lane: u32) {
    let i = (group.y * groups.x + group.x) * 256u + lane;
    if i >= count.x {
        return;
    }
    let c = color[i];
    let alpha = byte(c.a);
    var word = 0u;
    if alpha > 0u && is_finite(c.a) {
        word = encoded(c.r / c.a) | (encoded(c.g / c.a) << 8u) | (encoded(c.b / c.a) << 16u) | (alpha << 24u);
    }
    bytes[i] = word;
}
