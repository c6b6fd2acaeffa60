// Puts the people's samples before the plate, lit by the lamps of the moment and shaded by the people, and sums
// sub-frames in linear light. Prepended: constants, view.wgsl and light.wgsl.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> light: Light;
// Light of people; alpha is 1 for the person, a half for others, 0 where the room is seen.
@group(1) @binding(0) var samples: texture_multisampled_2d<f32>;
@group(1) @binding(1) var room_depth: texture_depth_multisampled_2d;
// See plate.wgsl; a layer after the other.
@group(1) @binding(2) var<storage, read> plate: array<u32>;
// Ideal image plane at the corners of cells of pixels.
@group(1) @binding(3) var<storage, read> directions: array<vec2<f32>>;
@group(1) @binding(4) var people_maps: texture_depth_2d_array;
@group(1) @binding(5) var compare: sampler_comparison;
@group(1) @binding(6) var<storage, read_write> sums: array<vec4<f32>>;
// Four halves: linear light, coverage by the person.
@group(1) @binding(7) var<storage, read_write> pixels: array<vec2<u32>>;

fn plate_light(layer: u32, at: vec2<u32>) -> vec3<f32> {
    let size = vec2<u32>(view.size_px);
    let q = plate[(layer * size.y + at.y) * size.x + at.x];
    let root = vec3<f32>(vec3(q, q >> 11u, q >> 22u) & vec3(2047u, 2047u, 1023u)) / vec3(2047.0, 2047.0, 1023.0);
    return root * root * PLATE_WHITE;
}

fn depth_m(device: f32) -> f32 {
    return NEAR_M / max(1.0 - device, 1e-6);
}

// World position of what the room shows at a pixel.
fn room_point(at: vec2<u32>, z: f32) -> vec3<f32> {
    let cell = (vec2<f32>(at) + 0.5) / view.grid.y;
    let low = floor(cell);
    let t = cell - low;
    let columns = u32(view.grid.x);
    let i = u32(low.y) * columns + u32(low.x);
    let above = mix(directions[i], directions[i + 1u], t.x);
    let below = mix(directions[i + columns], directions[i + columns + 1u], t.x);
    let lens = view.lens_point.xyz;
    let camera = vec3((mix(above, below, t.y) - lens.xy * lens.z) * z + lens.xy, z);
    let m = view.camera_from_world;
    let rotation = mat3x3(m[0].xyz, m[1].xyz, m[2].xyz);
    return transpose(rotation) * (camera - m[3].xyz);
}

// How much of the sky people leave free over a point of the floor.
fn floor_openness(world: vec3<f32>) -> f32 {
    var open = 1.0;
    for (var i = 0u; i < light.counts.x; i++) {
        let a = light.capsules[i].a;
        let b = light.capsules[i].b.xyz;
        let along = b - a.xyz;
        let t = clamp(dot(world - a.xyz, along) / max(dot(along, along), 1e-9), 0.0, 1.0);
        let away = a.xyz + along * t - world;
        let d2 = max(dot(away, away), a.w * a.w);
        open *= 1.0 - clamp(away.z * inverseSqrt(d2), 0.0, 1.0) * a.w * a.w / d2 * 0.8;
    }
    return open;
}

fn room_light(at: vec2<u32>, levels: vec4<f32>, noise: f32) -> vec3<f32> {
    let lamps = u32(light.steady.w);
    let world = room_point(at, depth_m(textureLoad(room_depth, at, 0)));
    let near = view.sum.w > 0.5;
    var around = surrounding(levels);
    if (near && world.z < 0.03 && distance(world, light.people.xyz) < light.people.w + 0.8) {
        around *= floor_openness(world);
    }
    var sum = plate_light(0u, at) * around;
    for (var l = 0u; l < lamps; l++) {
        let level = level_of(levels, l);
        if (level <= 0.0) {
            continue;
        }
        var share = 1.0;
        if (near) {
            let clip = light.lamps[l].people_from_world * vec4(world, 1.0);
            share = soft_share(people_maps, compare, l, clip, 0.02, light.lamps[l].tangents.y, 20u, noise * 6.2831853);
        }
        sum += plate_light(l + 1u, at) * (level * share);
    }
    if (light.counts.y > 0u) {
        sum += plate_light(lamps + 1u, at);
    }
    return sum;
}

// A neighbour that shows nothing but the surface at this depth, or the pixel itself.
fn like_minded(at: vec2<u32>, device: f32) -> vec2<u32> {
    let size = vec2<i32>(view.size_px);
    let z = depth_m(device);
    for (var k = 0; k < 9; k++) {
        // The pixel itself first.
        let step = (k + 4) % 9;
        let q = vec2<i32>(at) + vec2(step % 3 - 1, step / 3 - 1);
        if (any(q < vec2(0)) || any(q >= size)) {
            continue;
        }
        var off = 0.0;
        for (var i = 0; i < SAMPLES; i++) {
            off = max(off, abs(depth_m(textureLoad(room_depth, q, i)) - z));
        }
        if (off < 0.03 * z) {
            return vec2<u32>(q);
        }
    }
    return at;
}

@compute @workgroup_size(8, 8)
fn compose(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = vec2<u32>(view.size_px);
    if (any(id.xy >= size)) {
        return;
    }
    let index = id.y * size.x + id.x;
    let levels = view.levels[id.y];
    let noise = pixel_noise(vec2<f32>(id.xy));
    var sum = vec4(0.0);
    var free = 0;
    for (var i = 0; i < SAMPLES; i++) {
        let sample = textureLoad(samples, id.xy, i);
        if (sample.a > 0.25) {
            sum += vec4(sample.rgb, select(0.0, 1.0, sample.a > 0.75));
        } else {
            free += 1;
        }
    }
    if (free == SAMPLES) {
        sum = vec4(room_light(id.xy, levels, noise) * f32(SAMPLES), 0.0);
    } else if (free > 0) {
        // Each free sample shows its own surface: the plate's mean would let what the person hides shine through.
        for (var i = 0; i < SAMPLES; i++) {
            if (textureLoad(samples, id.xy, i).a <= 0.25) {
                let from_pixel = like_minded(id.xy, textureLoad(room_depth, id.xy, i));
                sum += vec4(room_light(from_pixel, levels, noise), 0.0);
            }
        }
    }
    sum *= view.sum.x / f32(SAMPLES);
    if (view.sum.y < 0.5) {
        sum += sums[index];
    }
    if (view.sum.z < 0.5) {
        sums[index] = sum;
        return;
    }
    let held = min(sum, vec4(60000.0));
    pixels[index] = vec2(pack2x16float(held.rg), pack2x16float(held.ba));
}
