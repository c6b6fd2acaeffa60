// Draws the clothed person. Prepended: view.wgsl.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var textures: texture_2d_array<f32>;
@group(0) @binding(2) var smooth_sampler: sampler;
@group(0) @binding(3) var shadow_map: texture_depth_2d;
@group(0) @binding(4) var shadow_sampler: sampler_comparison;

struct Vertex {
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    // uv, layer, openness
    @location(2) paint: vec4<f32>,
    // Canonical position of the carrying body point, part index
    @location(3) truth: vec4<f32>,
}

struct Fragment {
    @builtin(position) clip: vec4<f32>,
    @location(0) world: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(3) openness: f32,
    @location(4) canonical: vec3<f32>,
    @location(5) depth_m: f32,
    @location(6) @interpolate(flat) layer_part: vec2<u32>,
}

@vertex
fn vs_person(vertex: Vertex) -> Fragment {
    let camera = (view.camera_from_world * vec4(vertex.position, 1.0)).xyz;
    var ideal = camera.xy / max(camera.z, NEAR_M * 0.5);
    let r = min(length(ideal), view.lens.z);
    let r2 = r * r;
    if (view.lens.w > 0.5) {
        let theta = atan(r);
        let t2 = theta * theta;
        let k = view.fisheye;
        let bent = theta * (1.0 + t2 * (k.x + t2 * (k.y + t2 * (k.z + t2 * k.w))));
        ideal *= bent / max(length(ideal), 1e-9);
    } else {
        ideal *= 1.0 + r2 * (view.lens.x + r2 * view.lens.y);
    }
    let pixel = ideal * view.focal_px + view.center_px;
    let device = (pixel + 0.5) / view.size_px * vec2(2.0, -2.0) + vec2(-1.0, 1.0);
    var out: Fragment;
    // w = z makes the interpolation perspective-correct; z_device = 1 - near / z.
    out.clip = vec4(device * camera.z, camera.z - NEAR_M, camera.z);
    out.world = vertex.position;
    out.normal = vertex.normal;
    out.uv = vertex.paint.xy;
    out.openness = vertex.paint.w;
    out.canonical = vertex.truth.xyz;
    out.depth_m = camera.z;
    out.layer_part = vec2(u32(vertex.paint.z), u32(vertex.truth.w));
    return out;
}

@vertex
fn vs_shadow(vertex: Vertex) -> @builtin(position) vec4<f32> {
    return view.light_from_world * vec4(vertex.position, 1.0);
}

// Share of the key light that reaches a point, four samples `spread` shadow texels apart.
fn lit(world: vec3<f32>, spread: f32, bias: f32) -> f32 {
    let clip = view.light_from_world * vec4(world, 1.0);
    let at = clip.xy * vec2(0.5, -0.5) + 0.5;
    let step = spread / vec2<f32>(textureDimensions(shadow_map));
    var sum = 0.0;
    for (var i = 0u; i < 4u; i++) {
        let offset = vec2(f32(i & 1u), f32(i >> 1u)) * 2.0 - 1.0;
        sum += textureSampleCompareLevel(shadow_map, shadow_sampler, at + offset * step, clip.z - bias);
    }
    return sum * 0.25;
}

@fragment
fn fs_color(in: Fragment, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    let painted = textureSample(textures, smooth_sampler, in.uv, in.layer_part.x);
    let albedo = painted.rgb;
    var normal = normalize(in.normal);
    if (!front) {
        normal = -normal;
    }
    let facing = dot(normal, view.to_light.xyz);
    var key = max(facing, 0.0);
    if (key > 0.0) {
        key *= lit(in.world + normal * 0.006, 0.8, 0.0015);
    }
    // Light of the room: brighter from above, some bounce from the floor, more from the walls facing the key.
    let up = normal.z * 0.5 + 0.5;
    let ambient = mix(view.ground.rgb, view.sky.rgb, up) * in.openness;
    let bounce = view.sky.rgb * 0.18 * max(-facing, 0.0);
    let light = view.key.rgb * key * mix(1.0, in.openness, 0.4) + ambient + bounce;
    // Gloss: a wide highlight of the key light, and the sky at grazing angles.
    let gloss = 1.0 - painted.a;
    let camera = view.camera_from_world;
    let eye = -(vec3(dot(camera[0].xyz, camera[3].xyz), dot(camera[1].xyz, camera[3].xyz), dot(camera[2].xyz, camera[3].xyz)));
    let to_eye = normalize(eye - in.world);
    let middle = max(dot(normal, normalize(to_eye + view.to_light.xyz)), 0.0);
    let grazing = pow(1.0 - max(dot(normal, to_eye), 0.0), 4.0);
    let shine = view.key.rgb * min(key * 4.0, 1.0) * pow(middle, 28.0) + view.sky.rgb * grazing * 0.35 * in.openness;
    return vec4(albedo * light + gloss * 0.8 * shine, 1.0);
}

struct Truth {
    @location(0) canonical_depth: vec4<f32>,
    @location(1) part: u32,
}

@fragment
fn fs_truth(in: Fragment) -> Truth {
    return Truth(vec4(in.canonical, in.depth_m), in.layer_part.y + 1u);
}
