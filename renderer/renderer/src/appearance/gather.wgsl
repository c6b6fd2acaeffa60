// One thread a graph node: the visibility-weighted mean of the Gaussians around it, always in the same order.
@group(0) @binding(0) var<storage, read> seen: array<vec4<f32>>;
// First entry of each node; one more at the end.
@group(0) @binding(1) var<storage, read> entry_start: array<u32>;
// Gaussian, bits of its weight.
@group(0) @binding(2) var<storage, read> entries: array<vec2<u32>>;
// First and number of level 0.
@group(0) @binding(3) var<storage, read> levels: array<vec4<u32>>;
// Mean linear RGB; w: mean visibility, 0..=1.
@group(0) @binding(4) var<storage, read_write> node_seen: array<vec4<f32>>;

@compute @workgroup_size(WORKGROUP)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let node = (group.y * groups.x + group.x) * WORKGROUP + lane;
    if node >= levels[0].y {
        return;
    }
    var sum = vec4(0.0);
    var weights = 0.0;
    for (var e = entry_start[node]; e < entry_start[node + 1u]; e += 1u) {
        let entry = entries[e];
        let weight = bitcast<f32>(entry.y);
        let one = seen[entry.x];
        // Eq. 5: normalised only when the weights add up to more than 1.
        sum += weight * one / max(one.w, 1.0);
        weights += weight;
    }
    var mean = vec4(0.0);
    if sum.w > 0.0 && weights > 0.0 {
        mean = vec4(sum.rgb / sum.w, sum.w / weights);
    }
    node_seen[node] = mean;
}
