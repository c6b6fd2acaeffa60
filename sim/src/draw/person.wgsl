// Draws clothed people. Prepended: constants, view.wgsl, light.wgsl and points.wgsl.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> light: Light;
// All points at the first key, at the second, and so on.
@group(1) @binding(0) var<storage, read> points: array<Point>;
// Fraction of each lamp's light that furniture lets through, see shade.wgsl.
@group(1) @binding(1) var<storage, read> shares: array<vec4<f32>>;
@group(2) @binding(0) var textures: texture_2d_array<f32>;
@group(2) @binding(1) var smooth_sampler: sampler;
@group(2) @binding(2) var people_maps: texture_depth_2d_array;
@group(2) @binding(3) var compare: sampler_comparison;

struct Vertex {
    @builtin(vertex_index) index: u32,
    // uv, layer, part + 1 (0: another person)
    @location(0) paint: vec4<f32>,
    // Canonical position of the carrying body point
    @location(1) truth: vec4<f32>,
}

// A point as a camera sees it.
struct Seen {
    // At the time of the middle row: shadows are those of that time.
    still: Point,
    // At the time of the row in which it is seen.
    point: Point,
    pixel: vec2<f32>,
    depth_m: f32,
}

fn look(index: u32) -> Seen {
    let count = arrayLength(&shares);
    let camera_from_world = view.camera_from_world;
    let still = point_at(index, count, view.moment.x);
    var seen = still;
    var camera = (camera_from_world * vec4(seen.place.xyz, 1.0)).xyz;
    var pixel = pixel_of(camera);
    // The row in which the point is seen at that row's own time: a contraction, since nothing crosses the image
    // within one readout.
    let steps = select(0, ROW_STEPS, view.moment.y != 0.0);
    for (var i = 0; i < steps; i++) {
        let row = clamp(pixel.y, -0.5, view.size_px.y - 0.5);
        seen = point_at(index, count, view.moment.x + (row - view.moment.z) * view.moment.y);
        camera = (camera_from_world * vec4(seen.place.xyz, 1.0)).xyz;
        pixel = pixel_of(camera);
    }
    return Seen(still, seen, pixel, camera.z);
}

@vertex
fn vs_shadow(vertex: Vertex, @builtin(instance_index) lamp: u32) -> @builtin(position) vec4<f32> {
    let place = point_at(vertex.index, arrayLength(&shares), view.moment.x).place.xyz;
    return light.lamps[lamp].people_from_world * vec4(place, 1.0);
}

// Contribution of one lamp: diffuse light with the ratio of gloss to it, and shadow map coordinates (x, y and w).
struct Beam {
    light: vec4<f32>,
    place: vec3<f32>,
}

fn beam(lamp: Lamp, world: vec3<f32>, normal: vec3<f32>, to_eye: vec3<f32>, share: f32) -> Beam {
    let clip = lamp.people_from_world * vec4(world + normal * 0.006, 1.0);
    let to_lamp = normalize(lamp.place.xyz - world);
    let facing = facing_share(wrap_of(lamp, world), dot(normal, to_lamp));
    let middle = max(dot(normal, normalize(to_eye + to_lamp)), 0.0);
    let shine = min(facing * 4.0, 1.0) * pow(middle, 28.0) / max(facing, 1e-3);
    return Beam(vec4(arriving(lamp, world) * (share * facing), shine), clip.xyw);
}

// The points lie so close together that their light is good enough for what is between them, and all that a fragment
// needs comes with it: loads in fragments are slow on Mesa's software adapter.
struct Lit {
    @builtin(position) clip: vec4<f32>,
    // uv, alpha
    @location(0) @interpolate(perspective, centroid) paint: vec3<f32>,
    // Ambient light, its glossy fraction
    @location(1) @interpolate(perspective, centroid) around: vec4<f32>,
    @location(2) @interpolate(perspective, centroid) light_a: vec4<f32>,
    @location(3) @interpolate(perspective, centroid) light_b: vec4<f32>,
    @location(4) @interpolate(perspective, centroid) light_c: vec4<f32>,
    @location(5) @interpolate(perspective, centroid) place_a: vec3<f32>,
    @location(6) @interpolate(perspective, centroid) place_b: vec3<f32>,
    @location(7) @interpolate(perspective, centroid) place_c: vec3<f32>,
    // Layer of the textures. Rounded down in the fragment instead, NVIDIA's driver took every second layer's neighbour: it rounds the index
    // once more, to even.
    @location(8) @interpolate(flat) layer: u32,
}

@vertex
fn vs_lit(vertex: Vertex) -> Lit {
    let lamps = light.lamps;
    let sky = light.sky.rgb;
    let ground = light.ground.rgb;
    let seen = look(vertex.index);
    let share = shares[vertex.index];
    let row = view.rows[u32(clamp(seen.pixel.y + 0.5, 0.0, view.size_px.y - 1.0))];
    let world = seen.still.place.xyz;
    let openness = seen.still.place.w;
    let normal = normalize(seen.still.normal.xyz);
    let to_eye = normalize(view.eye.xyz - world);
    let direct = row.levels.xyz * mix(1.0, openness, 0.4);
    let a = beam(lamps[0], world, normal, to_eye, share.x * direct.x);
    var b = Beam(vec4(0.0), vec3(1.0));
    var c = b;
    if (LAMPS > 1u) {
        b = beam(lamps[1], world, normal, to_eye, share.y * direct.y);
    }
    if (LAMPS > 2u) {
        c = beam(lamps[2], world, normal, to_eye, share.z * direct.z);
    }
    let grazing = pow(1.0 - max(dot(normal, to_eye), 0.0), 4.0);
    let around = row.around.rgb * openness;
    var out: Lit;
    out.clip = clip_of(seen.pixel, seen.depth_m);
    out.paint = vec3(vertex.paint.xy, select(0.5, 1.0, vertex.paint.w > 0.5));
    out.layer = u32(vertex.paint.z + 0.5);
    out.around = vec4(around * hemisphere(normal, sky, ground), grazing * 0.35);
    out.light_a = a.light;
    out.light_b = b.light;
    out.light_c = c.light;
    out.place_a = a.place;
    out.place_b = b.place;
    out.place_c = c.place;
    return out;
}

// Fraction of a lamp's light that reaches a point: one filtered sample of its map, whose texels are as wide as the edges of
// soft shadows on a body.
fn reaching(l: u32, place: vec3<f32>) -> f32 {
    let at = place.xy / place.z * vec2(0.5, -0.5) + 0.5;
    return textureSampleCompareLevel(people_maps, compare, at, l, lamp_depth(place.z - 0.008));
}

@fragment
fn fs_lit(in: Lit, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    var painted = textureSampleBias(textures, smooth_sampler, in.paint.xy, in.layer, -0.5);
    painted = vec4(painted.rgb * painted.rgb, painted.a);
    let gloss = (1.0 - painted.a) * 0.8;
    var sum = in.around.rgb * (painted.rgb + gloss * in.around.a);
    // The inner side of a hem has ambient light only.
    if (front) {
        let a = in.light_a.rgb * reaching(0u, in.place_a);
        sum += painted.rgb * a + gloss * a * in.light_a.a;
        if (LAMPS > 1u) {
            let b = in.light_b.rgb * reaching(1u, in.place_b);
            sum += painted.rgb * b + gloss * b * in.light_b.a;
        }
        if (LAMPS > 2u) {
            let c = in.light_c.rgb * reaching(2u, in.place_c);
            sum += painted.rgb * c + gloss * c * in.light_c.a;
        }
    }
    return vec4(sum, in.paint.z);
}

struct Told {
    @builtin(position) clip: vec4<f32>,
    // Canonical position, depth in metres
    @location(0) canonical_depth: vec4<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) @interpolate(flat) part: f32,
}

@vertex
fn vs_truth(vertex: Vertex) -> Told {
    let seen = look(vertex.index);
    let clip = clip_of(seen.pixel, seen.depth_m);
    return Told(clip, vec4(vertex.truth.xyz, seen.depth_m), seen.point.normal.xyz, vertex.paint.w);
}

struct Truth {
    @location(0) canonical_depth: vec4<f32>,
    // World normal towards the camera, part + 1
    @location(1) normal_part: vec4<f32>,
}

@fragment
fn fs_truth(in: Told, @builtin(front_facing) front: bool) -> Truth {
    if (in.part < 0.5) {
        return Truth(vec4(0.0), vec4(0.0));
    }
    return Truth(in.canonical_depth, vec4(normalize(in.normal) * select(-1.0, 1.0, front), in.part));
}
