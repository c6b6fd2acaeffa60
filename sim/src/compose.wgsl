// Averages the samples of each pixel in linear light and puts them before the plate, which the person
// shades. Prepended: view.wgsl and `SUPERSAMPLES`.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var samples: texture_2d<f32>;
@group(0) @binding(2) var plate: texture_2d<f32>;
// World x, y of the floor at each pixel; huge where something else is seen.
@group(0) @binding(3) var<storage, read> floor_position: array<vec2<f32>>;
@group(0) @binding(4) var shadow_map: texture_depth_2d;
@group(0) @binding(5) var shadow_sampler: sampler_comparison;
// sRGB and coverage, 8 bits each, red lowest.
@group(0) @binding(6) var<storage, read_write> pixels: array<u32>;

fn srgb_from_linear(c: vec3<f32>) -> vec3<f32> {
    let low = c * 12.92;
    let high = 1.055 * pow(max(c, vec3(0.0)), vec3(1.0 / 2.4)) - 0.055;
    return select(high, low, c <= vec3(0.0031308));
}

fn floor_light(at: vec2<f32>) -> f32 {
    // Soft shadow of the key light, and darkness under the feet.
    let clip = view.light_from_world * vec4(at, 0.0, 1.0);
    let center = clip.xy * vec2(0.5, -0.5) + 0.5;
    var share = 1.0;
    if (all(abs(clip.xy) < vec2(0.98))) {
        var sum = 0.0;
        for (var i = 0; i < 9; i++) {
            let offset = vec2(f32(i % 3 - 1), f32(i / 3 - 1)) * 0.0085;
            sum += textureSampleCompareLevel(shadow_map, shadow_sampler, center + offset, clip.z - 0.002);
        }
        share = sum / 9.0;
    }
    var contact = 1.0;
    for (var foot = 0; foot < 2; foot++) {
        let d = at - view.feet[foot].xy;
        contact *= 1.0 - 0.55 * view.feet[foot].z * exp(-dot(d, d) / 0.018);
    }
    return mix(0.52, 1.0, share) * contact;
}

@compute @workgroup_size(8, 8)
fn compose(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = vec2<u32>(view.size_px);
    if (any(id.xy >= size)) {
        return;
    }
    var sum = vec4(0.0);
    for (var y = 0u; y < SUPERSAMPLES; y++) {
        for (var x = 0u; x < SUPERSAMPLES; x++) {
            sum += textureLoad(samples, id.xy * SUPERSAMPLES + vec2(x, y), 0);
        }
    }
    let person = sum / f32(SUPERSAMPLES * SUPERSAMPLES);
    var room = textureLoad(plate, id.xy, 0).rgb;
    let at = floor_position[id.y * size.x + id.x];
    if (at.x < 1e8 && person.a < 1.0) {
        room *= floor_light(at);
    }
    let linear = person.rgb + room * (1.0 - person.a);
    let bytes = vec4<u32>(round(clamp(vec4(srgb_from_linear(linear), person.a), vec4(0.0), vec4(1.0)) * 255.0));
    pixels[id.y * size.x + id.x] = bytes.r | (bytes.g << 8u) | (bytes.b << 16u) | (bytes.a << 24u);
}
