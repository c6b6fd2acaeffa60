// Stores a rendered layer of a plate: the mean of each pixel's samples. Prepended: constants and view.wgsl.

@group(0) @binding(0) var<storage, read> view: View;
@group(1) @binding(0) var samples: texture_multisampled_2d<f32>;
@group(1) @binding(1) var<storage, read_write> plate: array<u32>;

// Square roots in 11, 11 and 10 bits: perceptually even steps, up to `PLATE_WHITE`.
fn pack_light(light: vec3<f32>) -> u32 {
    let root = sqrt(clamp(light / PLATE_WHITE, vec3(0.0), vec3(1.0)));
    let q = vec3<u32>(round(root * vec3(2047.0, 2047.0, 1023.0)));
    return q.r | (q.g << 11u) | (q.b << 22u);
}

@compute @workgroup_size(8, 8)
fn keep(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = vec2<u32>(view.size_px);
    if (any(id.xy >= size)) {
        return;
    }
    var sum = vec3(0.0);
    for (var i = 0; i < SAMPLES; i++) {
        sum += textureLoad(samples, id.xy, i).rgb;
    }
    plate[(u32(view.moment.w) * size.y + id.y) * size.x + id.x] = pack_light(sum / f32(SAMPLES));
}
