// Colours of coarse Gaussians: means over the fine ones that each stands for, taken over little by little.
@group(0) @binding(0) var<storage, read> first_child: array<u32>;
@group(0) @binding(1) var<storage, read> children: array<u32>;
@group(0) @binding(2) var<storage, read> fine: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> coarse: array<vec4<f32>>;
// Share of the means in the colours; the rest stays as it was.
@group(0) @binding(4) var<storage, read> rate: array<f32>;

@compute @workgroup_size(64)
fn mean_colors(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i + 1u >= arrayLength(&first_child) || i >= arrayLength(&coarse) {
        return;
    }
    let begin = first_child[i];
    // Bounded: see ARCHITECTURE.md about software adapters.
    let end = min(first_child[i + 1u], begin + 10000u);
    var sum = vec4(0.0);
    for (var k = begin; k < end; k++) {
        sum += fine[children[k]];
    }
    let mean = sum / f32(max(end - begin, 1u));
    // Not mix(): what was there may be no number when all of it goes.
    if rate[0] < 1.0 {
        coarse[i] += rate[0] * (mean - coarse[i]);
    } else {
        coarse[i] = mean;
    }
}
