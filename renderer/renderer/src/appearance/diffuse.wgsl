// One workgroup for all: colours go up the hierarchy as visibility-weighted means, come down as first guesses, and
// a few damped Jacobi steps a level bring each close to the minimum of
//   sum_i c_i |x_i - seen_i|^2 + smoothness * sum_ij e_ij |x_i - x_j|^2.
@group(0) @binding(0) var<storage, read> settings: Settings;
// First node and number of nodes, finest level first.
@group(0) @binding(1) var<storage, read> levels: array<vec4<u32>>;
// Ranges in `edges` (x..y) and `children` (z..w).
@group(0) @binding(2) var<storage, read> links: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> parents: array<u32>;
// Other node, bits of the weight.
@group(0) @binding(4) var<storage, read> edges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> children: array<u32>;
// w of coarse nodes: sum over the finest nodes they stand for.
@group(0) @binding(6) var<storage, read_write> node_seen: array<vec4<f32>>;
// Two copies of all nodes; the result ends in the first.
@group(0) @binding(7) var<storage, read_write> node_color: array<vec4<f32>>;

fn relaxed(node: u32, copy: u32) -> vec4<f32> {
    let link = links[node];
    let own = node_seen[node];
    var sum = own.rgb * own.w;
    var weight = own.w;
    for (var e = link.x; e < link.y; e += 1u) {
        let edge = edges[e];
        let w = settings.smoothness * bitcast<f32>(edge.y);
        sum += w * node_color[copy + edge.x].rgb;
        weight += w;
    }
    let old = node_color[copy + node];
    if !(weight > 0.0) {
        return old;
    }
    return vec4(mix(old.rgb, sum / weight, DAMPING), 1.0);
}

@compute @workgroup_size(WORKGROUP)
fn main(@builtin(local_invocation_index) lane: u32) {
    let count = arrayLength(&links);
    let top = arrayLength(&levels) - 1u;
    for (var l = 1u; l <= top; l += 1u) {
        let level = levels[l];
        for (var node = level.x + lane; node < level.x + level.y; node += WORKGROUP) {
            let link = links[node];
            var sum = vec4(0.0);
            for (var c = link.z; c < link.w; c += 1u) {
                let one = node_seen[children[c]];
                sum += vec4(one.rgb * one.w, one.w);
            }
            if sum.w > 0.0 {
                sum = vec4(sum.rgb / sum.w, sum.w);
            }
            node_seen[node] = sum;
        }
        storageBarrier();
    }
    let root = levels[top].x;
    if lane == 0u {
        let mean = node_seen[root];
        node_color[root] = select(vec4(vec3(settings.unseen), 1.0), mean, mean.w > 0.0);
    }
    storageBarrier();
    for (var below = top; below > 0u; below -= 1u) {
        let level = levels[below - 1u];
        for (var node = level.x + lane; node < level.x + level.y; node += WORKGROUP) {
            node_color[node] = node_color[parents[node]];
        }
        storageBarrier();
        for (var step = 0u; step < RELAX_STEPS; step += 1u) {
            let source = (step & 1u) * count;
            for (var node = level.x + lane; node < level.x + level.y; node += WORKGROUP) {
                node_color[count - source + node] = relaxed(node, source);
            }
            storageBarrier();
        }
    }
}
