// Gaussians of one person copied behind those of others.
struct Copy {
    // Rows or Gaussians to copy.
    count: u32,
    // First Gaussian of the destination.
    first: u32,
    // Coefficients per Gaussian in source and destination.
    rows_in: u32,
    rows_out: u32,
    factor: f32,
}
@group(0) @binding(0) var<storage, read> copy: Copy;
@group(0) @binding(1) var<storage, read> source: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> out: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> color: array<vec4<f32>>;

fn index(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    return (group.y * groups.x + group.x) * 64u + local;
}

// One invocation a coefficient of the destination: harmonics of a lower order, or colours.
@compute @workgroup_size(64)
fn spread(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) local: u32) {
    let i = index(group, groups, local);
    let k = i % copy.rows_out;
    let at = copy.first * copy.rows_out + i;
    if i / copy.rows_out >= copy.count || at >= arrayLength(&out) {
        return;
    }
    if k < copy.rows_in {
        out[at] = vec4(copy.factor * source[(i / copy.rows_out) * copy.rows_in + k].rgb, 0.0);
    } else {
        out[at] = vec4(0.0);
    }
}

// One invocation an isotropic Gaussian: its scale along all axes, and its opacity.
@compute @workgroup_size(64)
fn scales(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) local: u32) {
    let i = index(group, groups, local);
    if i >= copy.count || copy.first + i >= arrayLength(&out) {
        return;
    }
    out[copy.first + i] = vec4(vec3(source[i].w), color[i].w);
}
