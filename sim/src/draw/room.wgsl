// Draws the room and its furniture: shadow maps, depth, and the layers of a plate. Prepended: constants, view.wgsl and
// light.wgsl.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> light: Light;
@group(1) @binding(0) var textures: texture_2d_array<f32>;
@group(1) @binding(1) var smooth_sampler: sampler;
@group(1) @binding(2) var room_maps: texture_depth_2d_array;
@group(1) @binding(3) var compare: sampler_comparison;

struct Vertex {
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    // uv, layer, openness
    @location(2) paint: vec4<f32>,
    // Linear factor on the texture, gloss
    @location(3) tint: vec4<f32>,
    // Emitted light, and the layer of the plate that it belongs to
    @location(4) glow: vec2<f32>,
}

struct Fragment {
    @invariant @builtin(position) clip: vec4<f32>,
    @location(0) @interpolate(perspective, centroid) world: vec3<f32>,
    @location(1) @interpolate(perspective, centroid) normal: vec3<f32>,
    @location(2) @interpolate(perspective, centroid) uv: vec2<f32>,
    @location(3) @interpolate(perspective, centroid) tint_openness: vec4<f32>,
    @location(4) @interpolate(flat) layer_gloss_glow: vec4<f32>,
}

@vertex
fn vs_room(vertex: Vertex) -> Fragment {
    let camera = (view.camera_from_world * vec4(vertex.position, 1.0)).xyz;
    var out: Fragment;
    out.clip = clip_of(pixel_of(camera), camera.z);
    out.world = vertex.position;
    out.normal = vertex.normal;
    out.uv = vertex.paint.xy;
    out.tint_openness = vec4(vertex.tint.rgb, vertex.paint.w);
    out.layer_gloss_glow = vec4(vertex.paint.z, vertex.tint.w, vertex.glow);
    return out;
}

@vertex
fn vs_room_shadow(vertex: Vertex, @builtin(instance_index) lamp: u32) -> @builtin(position) vec4<f32> {
    return light.lamps[lamp].room_from_world * vec4(vertex.position, 1.0);
}

// Light of the plate's layer `view.moment.w`: 0 is ambient light, then one lamp per layer, then objects that always
// glow.
@fragment
fn fs_layer(in: Fragment, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    // Four samples of the pixel: floors are seen at grazing angles.
    let dx = dpdx(in.uv) * 0.5;
    let dy = dpdy(in.uv) * 0.5;
    var painted = vec3(0.0);
    for (var i = 0; i < 4; i++) {
        let at = in.uv + dx * (f32(i & 1) - 0.5) + dy * (f32(i >> 1u) - 0.5);
        let root = textureSampleGrad(textures, smooth_sampler, at, u32(in.layer_gloss_glow.x), dx, dy).rgb;
        painted += root * root * 0.25;
    }
    let albedo = painted * in.tint_openness.rgb;
    let openness = in.tint_openness.a;
    let layer = u32(view.moment.w);
    let glow = select(0.0, in.layer_gloss_glow.z, u32(in.layer_gloss_glow.w) == layer);
    var sum = albedo * glow;
    let normal = normalize(in.normal) * select(-1.0, 1.0, front);
    let gloss = in.layer_gloss_glow.y;
    let to_eye = normalize(view.eye.xyz - in.world);
    if (layer == 0u) {
        let grazing = pow(1.0 - max(dot(normal, to_eye), 0.0), 4.0);
        let sky = light.sky.rgb;
        sum += albedo * hemisphere(normal, sky, light.ground.rgb) * openness + gloss * sky * grazing * 0.3 * openness;
    } else if (layer <= LAMPS) {
        let l = layer - 1u;
        let lamp = light.lamps[l];
        let to_lamp = normalize(lamp.place.xyz - in.world);
        let facing = facing_share(wrap_of(lamp, in.world), dot(normal, to_lamp));
        if (facing > 0.0) {
            let at = lamp.room_from_world * vec4(in.world + normal * 0.012, 1.0);
            let turn = pixel_noise(in.clip.xy) * 6.2831853;
            let share = soft_share(room_maps, compare, l, at, 0.015, lamp.place.w, lamp.tangents.x, 2u * light.counts.w, turn);
            let got = arriving(lamp, in.world) * share;
            let middle = max(dot(normal, normalize(to_eye + to_lamp)), 0.0);
            sum += albedo * got * facing * mix(1.0, openness, 0.5);
            sum += gloss * got * min(facing * 4.0, 1.0) * pow(middle, 40.0);
        }
    }
    return vec4(sum, 1.0);
}
