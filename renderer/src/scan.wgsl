// Exclusive prefix sum in place. Each invocation owns one contiguous segment, so that the result is
// the same on every run and no invocation waits for another.
// Prefix: const SEGMENTS.
@group(0) @binding(0) var<storage, read> scan_length: vec4<u32>;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> segment_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> total: array<u32>;

fn segment(index: u32) -> vec2<u32> {
    let length = scan_length.x;
    let size = (length + SEGMENTS - 1u) / SEGMENTS;
    let begin = min(index * size, length);
    return vec2(begin, min(begin + size, length));
}

@compute @workgroup_size(32)
fn reduce(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= SEGMENTS {
        return;
    }
    let range = segment(id.x);
    var sum = 0u;
    for (var i = range.x; i < range.y; i++) {
        sum += values[i];
    }
    segment_sums[id.x] = sum;
}

@compute @workgroup_size(32)
fn apply(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= SEGMENTS {
        return;
    }
    var sum = 0u;
    for (var s = 0u; s < id.x; s++) {
        sum += segment_sums[s];
    }
    let range = segment(id.x);
    for (var i = range.x; i < range.y; i++) {
        let value = values[i];
        values[i] = sum;
        sum += value;
    }
    if id.x == SEGMENTS - 1u {
        total[0] = sum;
    }
}
