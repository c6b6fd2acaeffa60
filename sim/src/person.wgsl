// Draws clothed people. Prepended: constants, view.wgsl and light.wgsl.

// Position and openness, normal.
struct Point {
    place: vec4<f32>,
    normal: vec4<f32>,
}

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> light: Light;
// All points at the first key, at the second, and so on.
@group(1) @binding(0) var<storage, read> points: array<Point>;
@group(2) @binding(0) var textures: texture_2d_array<f32>;
@group(2) @binding(1) var smooth_sampler: sampler;
@group(2) @binding(2) var people_maps: texture_depth_2d_array;
@group(2) @binding(3) var room_maps: texture_depth_2d_array;
@group(2) @binding(4) var compare: sampler_comparison;

struct Vertex {
    @builtin(vertex_index) index: u32,
    // uv, layer, part + 1 (0: somebody else)
    @location(0) paint: vec4<f32>,
    // Canonical position of the carrying body point, number of points a key
    @location(1) truth: vec4<f32>,
}

struct Fragment {
    @builtin(position) clip: vec4<f32>,
    @location(0) @interpolate(perspective, centroid) world: vec3<f32>,
    @location(1) @interpolate(perspective, centroid) normal: vec3<f32>,
    @location(2) @interpolate(perspective, centroid) uv: vec2<f32>,
    @location(3) @interpolate(perspective, centroid) openness: f32,
    @location(4) @interpolate(perspective, centroid) canonical: vec3<f32>,
    @location(5) @interpolate(perspective, centroid) depth_m: f32,
    @location(6) @interpolate(flat) layer_part: vec2<u32>,
}

// A point at a time, on the parabola through the three nearest keys.
fn point_at(vertex: Vertex, secs: f32) -> Point {
    let keys = u32(view.keys.z);
    if (keys < 3u) {
        return points[vertex.index];
    }
    let at = (secs - view.keys.x) * view.keys.y;
    let middle = clamp(floor(at + 0.5), 1.0, view.keys.z - 2.0);
    let s = at - middle;
    let count = u32(vertex.truth.w);
    let first = (u32(middle) - 1u) * count + vertex.index;
    let a = points[first];
    let b = points[first + count];
    let c = points[first + 2u * count];
    let wa = 0.5 * s * (s - 1.0);
    let wb = 1.0 - s * s;
    let wc = 0.5 * s * (s + 1.0);
    return Point(a.place * wa + b.place * wb + c.place * wc, a.normal * wa + b.normal * wb + c.normal * wc);
}

@vertex
fn vs_person(vertex: Vertex) -> Fragment {
    let still = point_at(vertex, view.moment.x);
    var seen = still;
    var camera = (view.camera_from_world * vec4(seen.place.xyz, 1.0)).xyz;
    var pixel = pixel_of(camera);
    if (view.moment.y != 0.0) {
        // The row in which the point is seen at that row's own time: a contraction, since nothing crosses the picture
        // within one readout.
        for (var i = 0; i < ROW_STEPS; i++) {
            let row = clamp(pixel.y, -0.5, view.size_px.y - 0.5);
            seen = point_at(vertex, view.moment.x + (row - view.moment.z) * view.moment.y);
            camera = (view.camera_from_world * vec4(seen.place.xyz, 1.0)).xyz;
            pixel = pixel_of(camera);
        }
    }
    var out: Fragment;
    out.clip = clip_of(pixel, camera.z);
    // Shadows are those of the middle row's time, and so is the place that they are looked up at.
    out.world = still.place.xyz;
    out.normal = seen.normal.xyz;
    out.uv = vertex.paint.xy;
    out.openness = still.place.w;
    out.canonical = vertex.truth.xyz;
    out.depth_m = camera.z;
    out.layer_part = vec2(u32(vertex.paint.z), u32(vertex.paint.w));
    return out;
}

@vertex
fn vs_shadow(vertex: Vertex, @builtin(instance_index) lamp: u32) -> @builtin(position) vec4<f32> {
    return light.lamps[lamp].people_from_world * vec4(point_at(vertex, view.moment.x).place.xyz, 1.0);
}

@fragment
fn fs_color(in: Fragment, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    let painted = textureSampleBias(textures, smooth_sampler, in.uv, in.layer_part.x, -0.5);
    let levels = view.levels[u32(clamp(in.clip.y, 0.0, view.size_px.y - 1.0))];
    var normal = normalize(in.normal);
    if (!front) {
        normal = -normal;
    }
    let gloss = (1.0 - painted.a) * 0.8;
    let to_eye = normalize(view.eye.xyz - in.world);
    let around = surrounding(levels);
    var sum = around * hemisphere(normal) * in.openness;
    let grazing = pow(1.0 - max(dot(normal, to_eye), 0.0), 4.0);
    var shine = around * light.sky.rgb * grazing * 0.35 * in.openness;
    for (var l = 0u; l < u32(light.steady.w); l++) {
        let to_lamp = normalize(light.lamps[l].place.xyz - in.world);
        let facing = facing_share(l, in.world, dot(normal, to_lamp));
        let level = level_of(levels, l);
        if (facing <= 0.0 || level <= 0.0) {
            continue;
        }
        let lifted = vec4(in.world + normal * 0.006, 1.0);
        var share = quick_share(
            people_maps, compare, l, light.lamps[l].people_from_world * lifted, 0.004, 0.008, light.lamps[l].tangents.y);
        if (share > 0.0) {
            share *= quick_share(
                room_maps, compare, l, light.lamps[l].room_from_world * lifted, 0.03, 0.02, light.lamps[l].tangents.x);
        }
        let got = arriving(l, in.world) * (level * share);
        sum += got * facing * mix(1.0, in.openness, 0.4);
        let middle = max(dot(normal, normalize(to_eye + to_lamp)), 0.0);
        shine += got * min(facing * 4.0, 1.0) * pow(middle, 28.0);
    }
    return vec4(painted.rgb * sum + gloss * shine, select(0.5, 1.0, in.layer_part.y > 0u));
}

struct Truth {
    @location(0) canonical_depth: vec4<f32>,
    // World normal towards the camera, part + 1
    @location(1) normal_part: vec4<f32>,
}

@fragment
fn fs_truth(in: Fragment, @builtin(front_facing) front: bool) -> Truth {
    if (in.layer_part.y == 0u) {
        return Truth(vec4(0.0), vec4(0.0));
    }
    let normal = normalize(in.normal) * select(-1.0, 1.0, front);
    return Truth(vec4(in.canonical, in.depth_m), vec4(normal, f32(in.layer_part.y)));
}
