// Composes the people's samples with the plate, relit by the lamps of the moment and shaded by the people, and sums
// sub-frames in linear light. Prepended: constants, view.wgsl and light.wgsl.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> light: Light;
// Light of people; alpha is 1 for the person, a half for others, 0 for the room.
@group(1) @binding(0) var samples: texture_multisampled_2d<f32>;
@group(1) @binding(1) var room_depth: texture_depth_multisampled_2d;
// Packed light (see plate.wgsl), layer by layer.
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

// Values common to all pixels, loaded once before any branch.
struct Same {
    camera_from_world: mat4x4<f32>,
    lens: vec3<f32>,
    grid: vec2<f32>,
    size: vec2<u32>,
    people: array<Bound, 2>,
    counts: vec4<u32>,
    lamps: array<Lamp, MAX_LAMPS>,
    near: bool,
}

// World position of the room's surface at a pixel.
fn room_point(same: Same, at: vec2<u32>, z: f32) -> vec3<f32> {
    let cell = (vec2<f32>(at) + 0.5) / same.grid.y;
    let low = floor(cell);
    let t = cell - low;
    let columns = u32(same.grid.x);
    let i = u32(low.y) * columns + u32(low.x);
    let above = mix(directions[i], directions[i + 1u], t.x);
    let below = mix(directions[i + columns], directions[i + columns + 1u], t.x);
    let camera = vec3((mix(above, below, t.y) - same.lens.xy * same.lens.z) * z + same.lens.xy, z);
    let m = same.camera_from_world;
    let rotation = mat3x3(m[0].xyz, m[1].xyz, m[2].xyz);
    return transpose(rotation) * (camera - m[3].xyz);
}

// Fraction of the sky that people leave free over a point of the floor.
fn floor_openness(world: vec3<f32>, count: u32) -> f32 {
    var open = 1.0;
    for (var i = 0u; i < count; i++) {
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

// Whether the light of a lamp to a point may pass through a person's upright cylinder, as wide as the lamp's shadows
// are soft.
fn may_hide(bound: Bound, lamp: Lamp, world: vec3<f32>) -> bool {
    let way = lamp.place.xyz - world;
    let flat_m = max(length(way.xy), 1e-3);
    let wide = bound.radius + 0.5 * lamp.place.w;
    let to_axis = bound.center - world.xy;
    let along = clamp(dot(to_axis, way.xy) / flat_m, 0.0, flat_m);
    let off = to_axis - way.xy * (along / flat_m);
    // Lowest over the cylinder.
    let low = world.z + way.z * max(along - wide, 0.0) / flat_m;
    return dot(off, off) < wide * wide && low < bound.top + 0.5 * lamp.place.w;
}

fn lamp_light(same: Same, l: u32, lamp: Lamp, level: f32, at: vec2<u32>, world: vec4<f32>, turn: f32) -> vec3<f32> {
    var share = 1.0;
    let hides = may_hide(same.people[0], lamp, world.xyz) || may_hide(same.people[1], lamp, world.xyz);
    if (same.near && hides) {
        let clip = lamp.people_from_world * world;
        share = soft_share(people_maps, compare, l, clip, 0.02, lamp.place.w, lamp.tangents.y, same.counts.w, turn);
    }
    return plate_light(l + 1u, at) * (level * share);
}

// Whether a point of the floor is close to a person.
fn under(bound: Bound, at: vec2<f32>) -> bool {
    return distance(bound.center, at) < bound.radius + 0.35;
}

fn room_light(same: Same, at: vec2<u32>, row: Row, turn: f32) -> vec3<f32> {
    let world = vec4(room_point(same, at, depth_m(textureLoad(room_depth, at, 0))), 1.0);
    var around = row.around.rgb;
    if (same.near && world.z < 0.03 && (under(same.people[0], world.xy) || under(same.people[1], world.xy))) {
        around *= floor_openness(world.xyz, same.counts.x);
    }
    var sum = plate_light(0u, at) * around + lamp_light(same, 0u, same.lamps[0], row.levels.x, at, world, turn);
    if (LAMPS > 1u) {
        sum += lamp_light(same, 1u, same.lamps[1], row.levels.y, at, world, turn);
    }
    if (LAMPS > 2u) {
        sum += lamp_light(same, 2u, same.lamps[2], row.levels.z, at, world, turn);
    }
    if (same.counts.y > 0u) {
        sum += plate_light(LAMPS + 1u, at);
    }
    return sum;
}

// A neighbour that shows only the surface at this depth, or the pixel itself.
fn like_minded(at: vec2<u32>, device: f32) -> vec2<u32> {
    let size = vec2<i32>(view.size_px);
    let many = i32(textureNumSamples(room_depth));
    let z = depth_m(device);
    for (var k = 0; k < 9; k++) {
        // The pixel itself first.
        let step = (k + 4) % 9;
        let q = vec2<i32>(at) + vec2(step % 3 - 1, step / 3 - 1);
        if (any(q < vec2(0)) || any(q >= size)) {
            continue;
        }
        var off = 0.0;
        for (var i = 0; i < many; i++) {
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
    let same = Same(
        view.camera_from_world,
        view.lens_point.xyz,
        view.grid,
        vec2<u32>(view.size_px),
        light.people,
        light.counts,
        light.lamps,
        view.sum.w > 0.5,
    );
    let part = view.sum;
    if (any(id.xy >= same.size)) {
        return;
    }
    let index = id.y * same.size.x + id.x;
    let row = view.rows[id.y];
    let turn = pixel_noise(vec2<f32>(id.xy)) * 6.2831853;
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
    // Each uncovered sample shows its own surface: the plate's mean would let hidden surfaces shine through.
    var pixel = array(id.xy, id.xy);
    var count = array(f32(free), 0.0);
    let looked_at = select(0, i32(textureNumSamples(samples)), free > 0 && free < SAMPLES);
    for (var i = 0; i < looked_at; i++) {
        if (textureLoad(samples, id.xy, i).a <= 0.25) {
            let from_pixel = like_minded(id.xy, textureLoad(room_depth, id.xy, i));
            if (count[0] == f32(free) && count[1] == 0.0 && any(from_pixel != pixel[0])) {
                pixel[1] = from_pixel;
            }
            if (any(from_pixel != pixel[0])) {
                count[0] -= 1.0;
                count[1] += 1.0;
            }
        }
    }
    var rounds = select(0u, 1u, free > 0);
    rounds = select(rounds, 2u, count[1] > 0.0);
    for (var k = 0u; k < rounds; k++) {
        let second = k > 0u;
        let light = room_light(same, select(pixel[0], pixel[1], second), row, turn);
        sum += vec4(light * select(count[0], count[1], second), 0.0);
    }
    sum *= part.x / f32(SAMPLES);
    if (part.y < 0.5) {
        sum += sums[index];
    }
    if (part.z < 0.5) {
        sums[index] = sum;
        return;
    }
    let held = min(sum, vec4(60000.0));
    pixels[index] = vec2(pack2x16float(held.rg), pack2x16float(held.ba));
}
