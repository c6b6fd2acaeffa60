// One invocation a Gaussian: adds a correction to its constant harmonic and to the colour of the surface.
// Prefix: const C0, COEFFICIENTS.
// Constant harmonics without correction.
@group(0) @binding(0) var<storage, read> constant: array<vec4<f32>>;
// Linear RGB of any sign.
@group(0) @binding(1) var<storage, read> correction: array<vec4<f32>>;
// Linear RGB of the surface without correction.
@group(0) @binding(2) var<storage, read> look: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> harmonics: array<vec4<f32>>;
// Linear RGB of the surface; w: 1.
@group(0) @binding(4) var<storage, read_write> color: array<vec4<f32>>;

@compute @workgroup_size(64)
fn recolor(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
           @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i >= min(arrayLength(&constant), arrayLength(&correction)) {
        return;
    }
    harmonics[i * COEFFICIENTS] = vec4(constant[i].rgb + correction[i].rgb / C0, 0.0);
    color[i] = vec4(max(look[i].rgb + correction[i].rgb, vec3(0.0)), 1.0);
}
