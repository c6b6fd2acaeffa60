// One thread a Gaussian: fills what was not seen (Eq. 9), remembers (Eq. 10) and blends with the memory (Eq. 11, 12).
@group(0) @binding(0) var<storage, read> settings: Settings;
@group(0) @binding(1) var<storage, read> seen: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> quality: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> node_color: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> gaussian_nodes: array<vec4<u32>>;
@group(0) @binding(5) var<storage, read> gaussian_weights: array<vec4<f32>>;
// Accumulated linear RGB; w: accumulated weight.
@group(0) @binding(6) var<storage, read_write> memory: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> color: array<vec4<f32>>;

@compute @workgroup_size(WORKGROUP)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = (group.y * groups.x + group.x) * WORKGROUP + lane;
    if i >= arrayLength(&seen) {
        return;
    }
    let sum = seen[i];
    let visible = min(quality[i].x, 1.0);
    var observed = vec3(settings.unseen);
    if sum.w > 0.0 {
        observed = sum.rgb / sum.w;
    }
    // What the paper's linear layer does with the two features it gets: a badly seen point follows the surface
    // around it, a seen one keeps its own detail.
    let own = visible / (visible + settings.inpaint_weight);
    // Share of the current colour that was seen rather than filled in.
    let share = visible + (1.0 - visible) * own;
    var current = observed;
    if settings.space != 0u {
        let nodes = gaussian_nodes[i];
        let weights = gaussian_weights[i];
        var around = vec3(0.0);
        for (var j = 0u; j < 4u; j += 1u) {
            around += weights[j] * node_color[nodes[j]].rgb;
        }
        // Eq. 9 with f_gcn = mix(around, observed, own).
        if settings.corrects != 0u && settings.sharpness > 0.0 {
            // The share that observations lack is that of the surface around: a change of light is corrected entirely.
            observed += (1.0 / settings.sharpness - 1.0) * around;
        }
        current = (1.0 - visible) * mix(around, observed, own) + visible * observed;
    }
    if settings.time != 0u {
        var past = memory[i];
        let total = past.w + visible;
        if visible > 0.0 {
            let updated = vec4((past.w * past.rgb + visible * current) / total, min(total, settings.memory_weight_max));
            if all_finite(updated) {
                past = updated;
                memory[i] = updated;
            }
        }
        let trust = past.w / settings.memory_weight_max * (1.0 - share * quality[i].y);
        current = mix(current, past.rgb, clamp(trust, 0.0, 1.0));
    }
    color[i] = vec4(current, 1.0);
}
