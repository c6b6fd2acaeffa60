// The lamps, their shadows, and what people take of the room's light. Prepended: `MAX_LAMPS`, `MAX_CAPSULES`,
// `LAMP_NEAR_M`.

struct Lamp {
    // The lamp's picture of the room, and of the people alone.
    room_from_world: mat4x4<f32>,
    people_from_world: mat4x4<f32>,
    // World position, metres; w: the lamp's width, metres.
    place: vec4<f32>,
    // Unit direction in which it shines; w: cosine of the angle where its light ends.
    axis: vec4<f32>,
    // Light times squared metres; w: cosine of the angle where its light begins to fall.
    color: vec4<f32>,
    // Tangents of half the angle of the two pictures; what of it comes back from the room is in `bounce`.
    tangents: vec4<f32>,
    bounce: vec4<f32>,
}

// Two ends; the first one's w is the radius. Metres.
struct Capsule {
    a: vec4<f32>,
    b: vec4<f32>,
}

struct Light {
    lamps: array<Lamp, MAX_LAMPS>,
    // Light from everywhere at all times; w: number of lamps.
    steady: vec4<f32>,
    // Shares of that light and of the bounced light from above and below.
    sky: vec4<f32>,
    ground: vec4<f32>,
    // Middle of the people and their distance from it, metres.
    people: vec4<f32>,
    // x: number of capsules.
    counts: vec4<u32>,
    capsules: array<Capsule, MAX_CAPSULES>,
}

fn level_of(levels: vec4<f32>, lamp: u32) -> f32 {
    return levels[lamp];
}

// Light from everywhere.
fn surrounding(levels: vec4<f32>) -> vec3<f32> {
    var sum = light.steady.rgb;
    for (var l = 0u; l < u32(light.steady.w); l++) {
        sum += light.lamps[l].bounce.rgb * level_of(levels, l);
    }
    return sum;
}

fn hemisphere(normal: vec3<f32>) -> vec3<f32> {
    return mix(light.ground.rgb, light.sky.rgb, normal.z * 0.5 + 0.5);
}

// What a surface facing a lamp would get at a point, without shadows.
fn arriving(l: u32, world: vec3<f32>) -> vec3<f32> {
    let away = world - light.lamps[l].place.xyz;
    let d2 = max(dot(away, away), 0.04);
    let angle = dot(away * inverseSqrt(d2), light.lamps[l].axis.xyz);
    return light.lamps[l].color.rgb / d2 * smoothstep(light.lamps[l].axis.w, light.lamps[l].color.w, angle);
}

// Share of a wide lamp's light by the cosine of the angle to its middle.
fn facing_share(l: u32, world: vec3<f32>, cosine: f32) -> f32 {
    let wrap = min(0.5 * light.lamps[l].place.w / distance(world, light.lamps[l].place.xyz), 0.5);
    return max((cosine + wrap) / (1.0 + wrap), 0.0);
}

fn lamp_depth(z: f32) -> f32 {
    return 1.0 - LAMP_NEAR_M / max(z, LAMP_NEAR_M);
}

// Point of a disc that fills evenly with growing index.
fn disc(index: u32, count: u32, turn: f32) -> vec2<f32> {
    let r = sqrt((f32(index) + 0.5) / f32(count));
    let angle = f32(index) * 2.3999632 + turn;
    return r * vec2(cos(angle), sin(angle));
}

// Share of a lamp's light that passes, at a point of its picture; few taps, `spread_m` wide.
fn quick_share(
    map: texture_depth_2d_array,
    compare: sampler_comparison,
    l: u32,
    clip: vec4<f32>,
    spread_m: f32,
    bias_m: f32,
    tangent: f32,
) -> f32 {
    if (clip.w < LAMP_NEAR_M || any(abs(clip.xy) > vec2(clip.w * 0.995))) {
        return 1.0;
    }
    let at = clip.xy / clip.w * vec2(0.5, -0.5) + 0.5;
    let step = vec2(spread_m / (2.0 * clip.w * tangent));
    let depth = lamp_depth(clip.w - bias_m);
    var sum = 0.0;
    for (var i = 0u; i < 4u; i++) {
        let offset = vec2(f32(i & 1u), f32(i >> 1u)) * 2.0 - 1.0;
        sum += textureSampleCompareLevel(map, compare, at + offset * step, l, depth);
    }
    return sum * 0.25;
}

// The same with a penumbra as wide as the lamp and the distance to what is in its way make it.
fn soft_share(
    map: texture_depth_2d_array,
    compare: sampler_comparison,
    l: u32,
    clip: vec4<f32>,
    bias_m: f32,
    tangent: f32,
    taps: u32,
    turn: f32,
) -> f32 {
    let z = clip.w;
    if (z < LAMP_NEAR_M || any(abs(clip.xy) > vec2(z * 0.995))) {
        return 1.0;
    }
    let at = clip.xy / z * vec2(0.5, -0.5) + 0.5;
    let size = light.lamps[l].place.w;
    let pixels = vec2<f32>(textureDimensions(map));
    let depth = lamp_depth(z - bias_m);
    // What lies in the way, on average: looked for as wide as something half-way would be.
    let search = clamp(0.5 * size / (2.0 * z * tangent), 2.0 / pixels.x, 0.1);
    var way = 0.0;
    var found = 0.0;
    for (var i = 0u; i < 12u; i++) {
        let texel = vec2<i32>(clamp((at + disc(i, 12u, turn) * search) * pixels, vec2(0.0), pixels - 1.0));
        let d = textureLoad(map, texel, l, 0);
        if (d < depth) {
            way += LAMP_NEAR_M / (1.0 - d);
            found += 1.0;
        }
    }
    if (found == 0.0) {
        return 1.0;
    }
    let between = way / found;
    let half_m = 0.5 * size * max(z - between, 0.0) / between;
    let radius = clamp(half_m / (2.0 * z * tangent), 0.75 / pixels.x, search);
    var sum = 0.0;
    for (var i = 0u; i < taps; i++) {
        sum += textureSampleCompareLevel(map, compare, at + disc(i, taps, turn) * radius, l, depth);
    }
    return sum / f32(taps);
}

// A number in 0..1 that differs between neighbours evenly (after Jimenez, "Next generation post processing", 2014).
fn pixel_noise(pixel: vec2<f32>) -> f32 {
    return fract(52.9829189 * fract(dot(pixel, vec2(0.06711056, 0.00583715))));
}
