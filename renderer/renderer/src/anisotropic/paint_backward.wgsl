// Derivative of the colours: one invocation a Gaussian carries dL/d its colour to the coefficients, and through the direction to
// the centre. Adds to the outputs. Nothing flows where a channel is clamped at 0.
// Prefix: camera.wgsl, raster/frame.wgsl, backward/frame.wgsl, the attributes `center` and `harmonics` at bindings 1 and 2,
// their derivatives at bindings 4 and 5, anisotropic/harmonics.wgsl.
@group(0) @binding(0) var<storage, read> frame: Frame;
@group(0) @binding(3) var<storage, read> sums: array<PairSum>;

fn finite(v: vec3<f32>) -> bool {
    return all((bitcast<vec3<u32>>(v) & vec3(0x7f800000u)) != vec3(0x7f800000u));
}

@compute @workgroup_size(64)
fn paint_backward(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                  @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i >= frame.gaussians || !(sums[i].vectors[1].w > 0.0) {
        return;
    }
    let sight = center[i].xyz - frame.camera.position.xyz;
    let inverse_distance = inverseSqrt(dot(sight, sight));
    let direction = sight * inverse_distance;
    let is_open = unclamped_color(i, direction) >= vec3(0.0);
    let d_color = select(vec3(0.0), sums[i].vectors[2].xyz, is_open);
    if !finite(d_color) {
        return;
    }
    let values = basis(direction);
    for (var k = 0u; k < COEFFICIENTS; k++) {
        harmonics_out[i * COEFFICIENTS + k] += vec4(values[k] * d_color, 0.0);
    }
    if COEFFICIENTS > 1u {
        let slope = direction_slope(i, direction, d_color);
        let in_world = (slope - direction * dot(direction, slope)) * inverse_distance;
        if finite(in_world) {
            center_out[i] += vec4(in_world, 0.0);
        }
    }
}
