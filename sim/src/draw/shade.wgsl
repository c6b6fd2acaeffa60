// Computes the fraction of each lamp's light that furniture lets through to the points of a person. Prepended:
// constants, view.wgsl, light.wgsl and points.wgsl.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> light: Light;
@group(1) @binding(0) var<storage, read> points: array<Point>;
@group(1) @binding(1) var<storage, read_write> shares: array<vec4<f32>>;
@group(1) @binding(2) var room_maps: texture_depth_2d_array;
@group(1) @binding(3) var compare: sampler_comparison;

fn passing(lamp: Lamp, l: u32, world: vec4<f32>, taps: u32) -> f32 {
    let clip = lamp.room_from_world * world;
    return soft_share(room_maps, compare, l, clip, 0.02, lamp.place.w, lamp.tangents.x, taps, 0.0);
}

@compute @workgroup_size(64)
fn shade(@builtin(global_invocation_id) id: vec3<u32>) {
    let lamps = light.lamps;
    let taps = light.counts.w;
    if (id.x >= arrayLength(&shares)) {
        return;
    }
    let point = point_at(id.x, arrayLength(&shares), view.moment.x);
    let world = vec4(point.place.xyz + point.normal.xyz * 0.01, 1.0);
    var share = vec4(1.0);
    share.x = passing(lamps[0], 0u, world, taps);
    if (LAMPS > 1u) {
        share.y = passing(lamps[1], 1u, world, taps);
    }
    if (LAMPS > 2u) {
        share.z = passing(lamps[2], 2u, world, taps);
    }
    shares[id.x] = share;
}
