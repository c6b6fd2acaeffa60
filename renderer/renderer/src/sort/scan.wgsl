// Exclusive prefix sum in place. Each workgroup owns one contiguous segment, so that the result is the same on every run and no
// workgroup waits for another. Sums stop at MOST, far below the overflow of u32: stopping early keeps them associative.
// Prefix: const SEGMENTS, MOST.
@group(0) @binding(0) var<storage, read> scan_length: vec4<u32>;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> segment_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> total: array<u32>;

const LANES = 64u;
// Values a lane takes at a time.
const EACH = 16u;

var<workgroup> sums: array<u32, LANES>;
var<workgroup> before: u32;

fn add(a: u32, b: u32) -> u32 {
    return min(a + b, MOST);
}

fn segment(index: u32) -> vec2<u32> {
    let length = scan_length.x;
    let size = (length + SEGMENTS - 1u) / SEGMENTS;
    let begin = min(index * size, length);
    return vec2(begin, min(begin + size, length));
}

// Adds up `mine` over the lanes; the result is that of lane 0.
fn sum_of_lanes(lane: u32, mine: u32) -> u32 {
    sums[lane] = mine;
    for (var half = LANES / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            sums[lane] = add(sums[lane], sums[lane + half]);
        }
    }
    return sums[0];
}

@compute @workgroup_size(LANES)
fn reduce(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let range = segment(group.x);
    var sum = 0u;
    for (var i = range.x + lane; i < range.y; i += LANES) {
        sum = add(sum, min(values[i], MOST));
    }
    sum = sum_of_lanes(lane, sum);
    if lane == 0u {
        segment_sums[group.x] = sum;
    }
}

@compute @workgroup_size(LANES)
fn apply(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var earlier = 0u;
    for (var s = lane; s < group.x; s += LANES) {
        earlier = add(earlier, segment_sums[s]);
    }
    earlier = sum_of_lanes(lane, earlier);
    if lane == 0u {
        before = earlier;
    }
    let range = segment(group.x);
    for (var first = range.x; first < range.y; first += LANES * EACH) {
        let mine = first + lane * EACH;
        var own = array<u32, EACH>();
        var sum = 0u;
        for (var k = 0u; k < EACH; k++) {
            if mine + k < range.y {
                own[k] = min(values[mine + k], MOST);
            }
            sum = add(sum, own[k]);
        }
        // Hillis and Steele's inclusive sum over the lanes.
        workgroupBarrier();
        sums[lane] = sum;
        for (var reach = 1u; reach < LANES; reach *= 2u) {
            workgroupBarrier();
            var left = 0u;
            if lane >= reach {
                left = sums[lane - reach];
            }
            workgroupBarrier();
            sums[lane] = add(sums[lane], left);
        }
        workgroupBarrier();
        var running = before;
        if lane > 0u {
            running = add(running, sums[lane - 1u]);
        }
        for (var k = 0u; k < EACH; k++) {
            if mine + k < range.y {
                values[mine + k] = running;
                running = add(running, own[k]);
            }
        }
        workgroupBarrier();
        if lane == LANES - 1u {
            before = add(before, sums[lane]);
        }
    }
    workgroupBarrier();
    if group.x == SEGMENTS - 1u && lane == 0u {
        total[0] = before;
    }
}
