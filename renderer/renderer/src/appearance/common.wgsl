// Written by AppearanceSettings; see there for the meaning.
struct Settings {
    occlusion_per_m: f32,
    memory_weight_max: f32,
    min_mask: f32,
    inpaint_weight: f32,
    smoothness: f32,
    // Extra weight of every view (baseline without spatial aggregation), otherwise 0.
    view_weight: f32,
    space: u32,
    time: u32,
    // 0 where there are no last colours.
    sharpness: f32,
    // Whether colours are corrections of colours known before.
    corrects: u32,
    // Every channel of what nobody saw.
    unseen: f32,
}

// By its bits: compilers may assume that no NaN exists and drop `x != x`.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn all_finite(v: vec4<f32>) -> bool {
    return is_finite(v.x) && is_finite(v.y) && is_finite(v.z) && is_finite(v.w);
}
