// Linear blend skinning of surface Gaussians: world = LBS(x + t_x), FlyHuman section 3.1.
// One invocation per Gaussian. A displacement or growth that is not finite counts as none; Gaussians beyond the buffer's end are
// not displaced.

// Three rows of world_from_canonical per joint.
@group(0) @binding(0) var<storage, read> joint_rows: array<vec4f>;
// Canonical position; w: scale.
@group(0) @binding(1) var<storage, read> rest: array<vec4f>;
// Canonical normal; w: depth below the rendered surface, metres.
@group(0) @binding(2) var<storage, read> rest_normal: array<vec4f>;
// Four joint indices of 16 bits.
@group(0) @binding(3) var<storage, read> skin_joints: array<vec2u>;
@group(0) @binding(4) var<storage, read> skin_weights: array<vec4f>;
// Canonical displacement; w: relative growth of the surface, its Gaussians and their depth.
@group(0) @binding(5) var<storage, read> displacement: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> center_scale: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> normal: array<vec4f>;

override WORKGROUP_SIZE: u32 = 64u;

// Tests the bits, since compilers may assume that no float is NaN.
fn finite(v: vec3f) -> bool {
    let exponents = bitcast<vec3u>(v) & vec3u(0x7f800000u);
    return all(exponents != vec3u(0x7f800000u));
}

@compute @workgroup_size(WORKGROUP_SIZE)
fn skin(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + lane;
    if i >= arrayLength(&rest) {
        return;
    }
    let packed = skin_joints[i];
    let joints = vec4u(packed.x & 0xffffu, packed.x >> 16u, packed.y & 0xffffu, packed.y >> 16u);
    let weights = skin_weights[i];
    var x = vec4f();
    var y = vec4f();
    var z = vec4f();
    var total = 0.0;
    for (var k = 0u; k < 4u; k++) {
        let row = joints[k] * 3u;
        if weights[k] > 0.0 && row + 2u < arrayLength(&joint_rows) {
            x += weights[k] * joint_rows[row];
            y += weights[k] * joint_rows[row + 1u];
            z += weights[k] * joint_rows[row + 2u];
            total += weights[k];
        }
    }
    if total > 0.0 {
        x /= total;
        y /= total;
        z /= total;
    } else {
        x = vec4f(1.0, 0.0, 0.0, 0.0);
        y = vec4f(0.0, 1.0, 0.0, 0.0);
        z = vec4f(0.0, 0.0, 1.0, 0.0);
    }
    var point = rest[i].xyz;
    var growth = 1.0;
    if i < arrayLength(&displacement) && finite(displacement[i].xyz) {
        point += displacement[i].xyz;
        growth += select(0.0, max(displacement[i].w, 0.0), finite(displacement[i].www));
    }
    let p = vec4f(point, 1.0);
    center_scale[i] = vec4f(dot(x, p), dot(y, p), dot(z, p), growth * rest[i].w);
    let n = rest_normal[i].xyz;
    let turned = vec3f(dot(x.xyz, n), dot(y.xyz, n), dot(z.xyz, n));
    let length_squared = dot(turned, turned);
    normal[i] = vec4f(select(vec3f(), turned * inverseSqrt(length_squared), length_squared > 1e-20), growth * rest_normal[i].w);
}
