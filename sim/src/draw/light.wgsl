// Lamps, their shadows, and occlusion of the ambient light by people. Prepended: `LAMPS`, `MAX_LAMPS`, `MAX_CAPSULES`,
// `LAMP_NEAR_M`.

struct Lamp {
    // Transforms of the shadow maps of the room, and of the people alone.
    room_from_world: mat4x4<f32>,
    people_from_world: mat4x4<f32>,
    // World position, metres; w: the lamp's width, metres.
    place: vec4<f32>,
    // Unit direction in which it shines; w: cosine of the angle where its light ends.
    axis: vec4<f32>,
    // Light times squared metres; w: cosine of the angle where its light begins to fall.
    color: vec4<f32>,
    // Tangents of half the angle of the two shadow maps.
    tangents: vec4<f32>,
}

// Two ends; the first one's w is the radius. Metres.
struct Capsule {
    a: vec4<f32>,
    b: vec4<f32>,
}

// An upright cylinder from the floor around a person; without one its radius is far below 0.
struct Bound {
    center: vec2<f32>,
    radius: f32,
    top: f32,
}

struct Light {
    lamps: array<Lamp, MAX_LAMPS>,
    // Fractions of the ambient light from above and below.
    sky: vec4<f32>,
    ground: vec4<f32>,
    people: array<Bound, 2>,
    // Number of capsules, 1 if an object glows by itself, unused, samples of a shadow.
    counts: vec4<u32>,
    capsules: array<Capsule, MAX_CAPSULES>,
}

// Written for Mesa's software adapter as well, which gathers what is loaded by a changing index lane by lane (so lamps
// are handed around by value), and skips nothing of a branch that no lane takes, but leaves loops (so what is seldom
// needed stands in loops whose number of rounds it cannot know).

fn hemisphere(normal: vec3<f32>, sky: vec3<f32>, ground: vec3<f32>) -> vec3<f32> {
    return mix(ground, sky, normal.z * 0.5 + 0.5);
}

// Light of a lamp on a surface that faces it, without shadows.
fn arriving(lamp: Lamp, world: vec3<f32>) -> vec3<f32> {
    let away = world - lamp.place.xyz;
    let d2 = max(dot(away, away), 0.04);
    let angle = dot(away * inverseSqrt(d2), lamp.axis.xyz);
    return lamp.color.rgb / d2 * smoothstep(lamp.axis.w, lamp.color.w, angle);
}

// Reach of a wide lamp's light around a corner.
fn wrap_of(lamp: Lamp, world: vec3<f32>) -> f32 {
    return min(0.5 * lamp.place.w / distance(world, lamp.place.xyz), 0.5);
}

// Fraction of a wide lamp's light by the cosine of the angle to its centre.
fn facing_share(wrap: f32, cosine: f32) -> f32 {
    return max((cosine + wrap) / (1.0 + wrap), 0.0);
}

fn lamp_depth(z: f32) -> f32 {
    return 1.0 - LAMP_NEAR_M / max(z, LAMP_NEAR_M);
}

// Turns by the golden angle, whose multiples fill a circle evenly.
const GOLDEN = mat2x2<f32>(vec2(-0.7373688, 0.6754903), vec2(-0.6754903, -0.7373688));

// Fraction of a lamp's light that reaches a point of its shadow map: the width of the penumbra follows from the lamp's
// width and the distance of the occluder.
fn soft_share(
    map: texture_depth_2d_array,
    compare: sampler_comparison,
    l: u32,
    clip: vec4<f32>,
    bias_m: f32,
    size_m: f32,
    tangent: f32,
    taps: u32,
    turn: f32,
) -> f32 {
    let z = clip.w;
    if (z < LAMP_NEAR_M || any(abs(clip.xy) > vec2(z * 0.995))) {
        return 1.0;
    }
    let at = clip.xy / z * vec2(0.5, -0.5) + 0.5;
    let pixels = vec2<f32>(textureDimensions(map));
    let depth = lamp_depth(z - bias_m);
    // Mean depth of the occluders, searched over the width of the penumbra of one half-way.
    let search = clamp(0.5 * size_m / (2.0 * z * tangent), 2.0 / pixels.x, 0.1);
    let start = vec2(cos(turn), sin(turn));
    var way = 0.0;
    var found = 0.0;
    var direction = start;
    for (var i = 0u; i < taps; i++) {
        let offset = direction * (search * sqrt((f32(i) + 0.5) / f32(taps)));
        let texel = vec2<i32>(clamp((at + offset) * pixels, vec2(0.0), pixels - 1.0));
        let d = textureLoad(map, texel, l, 0);
        if (d < depth) {
            way += LAMP_NEAR_M / (1.0 - d);
            found += 1.0;
        }
        direction = GOLDEN * direction;
    }
    if (found == 0.0) {
        return 1.0;
    }
    let between = way / found;
    let half_m = 0.5 * size_m * max(z - between, 0.0) / between;
    let radius = clamp(half_m / (2.0 * z * tangent), 0.75 / pixels.x, search);
    var sum = 0.0;
    direction = start;
    for (var i = 0u; i < taps; i++) {
        let offset = direction * (radius * sqrt((f32(i) + 0.5) / f32(taps)));
        sum += textureSampleCompareLevel(map, compare, at + offset, l, depth);
        direction = GOLDEN * direction;
    }
    return sum / f32(taps);
}

// A number in 0..1 that differs between neighbours evenly (after Jimenez, "Next generation post processing", 2014).
fn pixel_noise(pixel: vec2<f32>) -> f32 {
    return fract(52.9829189 * fract(dot(pixel, vec2(0.06711056, 0.00583715))));
}
