// One pass of a stable least-significant-digit radix sort. A workgroup owns one contiguous block and its own column of the
// histogram table; nothing depends on when other workgroups run. Atomics only count, so that their order does not matter.
// Prefix: const BLOCK, DIGIT_BITS, KEY_BITS, INVALID_KEY.
struct SortPass {
    // Elements before the first pass.
    count: u32,
    // Number of the digit.
    index: u32,
    // Whether keys are taken from the smallest on, and invalid ones left out; else as they are, `valid[0]` of them.
    scaled: u32,
    unused: u32,
}

@group(0) @binding(0) var<storage, read> sort_pass: SortPass;
// (key, payload)
@group(0) @binding(1) var<storage, read_write> source: array<vec2<u32>>;
// Largest ~key and largest key of all that are valid (zeroed before).
@group(0) @binding(2) var<storage, read_write> extremes: array<atomic<u32>, 2>;
// Digit-major: table[digit * blocks + block], for the blocks that there are elements for.
@group(0) @binding(3) var<storage, read_write> table: array<u32>;
// Number of valid elements, known after the first pass.
@group(0) @binding(4) var<storage, read_write> valid: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted: array<vec2<u32>>;

const DIGITS = 1u << DIGIT_BITS;
const LANES = 128u;
// Lanes that walk over elements in their order, and elements of each.
const WALKERS = 16u;
const WALK = BLOCK / WALKERS;
// Rows and columns are one element apart more than they are long, so that lanes do not meet in a bank of memory.
const WORDS = DIGITS / 2u;
const ROW = WALKERS + 1u;
const NONE = 0xffffffffu;

var<workgroup> low: atomic<u32>;
var<workgroup> high: atomic<u32>;
var<workgroup> histogram: array<atomic<u32>, DIGITS>;
// Digit of every element, then its place.
var<workgroup> places: array<u32, WALKERS * (WALK + 1u)>;
// Counts of two digits a word, by walker.
var<workgroup> counts: array<u32, WORDS * ROW>;
var<workgroup> starts: array<u32, DIGITS>;
var<workgroup> sizes: vec2<u32>;

// Elements, and columns of the table; to be called by all lanes together.
fn find_sizes(lane: u32) -> vec2<u32> {
    if lane == 0u {
        let known = min(valid[0], sort_pass.count);
        let all = select(known, sort_pass.count, sort_pass.scaled != 0u);
        let count = select(known, all, sort_pass.index == 0u);
        sizes = vec2(count, max(1u, (all + BLOCK - 1u) / BLOCK));
    }
    return workgroupUniformLoad(&sizes);
}

@compute @workgroup_size(LANES)
fn find_range(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var range = vec2(0u);
    for (var k = 0u; k < BLOCK / LANES; k++) {
        let i = group.x * BLOCK + k * LANES + lane;
        if i < sort_pass.count {
            let key = source[i].x;
            if key != INVALID_KEY {
                range = max(range, vec2(~key, key));
            }
        }
    }
    atomicMax(&low, range.x);
    atomicMax(&high, range.y);
    workgroupBarrier();
    if lane == 0u {
        atomicMax(&extremes[0], atomicLoad(&low));
        atomicMax(&extremes[1], atomicLoad(&high));
    }
}

// x: smallest key; y: right shift that makes the range of the keys fit KEY_BITS.
fn key_scaling() -> vec2<u32> {
    if sort_pass.scaled == 0u {
        return vec2(0u);
    }
    let smallest = ~atomicLoad(&extremes[0]);
    let largest = atomicLoad(&extremes[1]);
    let bits = 32u - countLeadingZeros(max(smallest, largest) - smallest);
    return vec2(smallest, max(bits, KEY_BITS) - KEY_BITS);
}

// NONE for an element that is left out.
fn digit_of(i: u32, count: u32, scaling: vec2<u32>) -> u32 {
    if i >= count {
        return NONE;
    }
    let key = source[i].x;
    if key == INVALID_KEY {
        return NONE;
    }
    return (((key - scaling.x) >> scaling.y) >> (DIGIT_BITS * sort_pass.index)) & (DIGITS - 1u);
}

@compute @workgroup_size(LANES)
fn count_digits(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let size = find_sizes(lane);
    if group.x >= size.y {
        return;
    }
    let scaling = key_scaling();
    for (var k = 0u; k < BLOCK / LANES; k++) {
        let digit = digit_of(group.x * BLOCK + k * LANES + lane, size.x, scaling);
        if digit != NONE {
            atomicAdd(&histogram[digit], 1u);
        }
    }
    workgroupBarrier();
    for (var digit = lane; digit < DIGITS; digit += LANES) {
        table[digit * size.y + group.x] = atomicLoad(&histogram[digit]);
    }
}

@compute @workgroup_size(LANES)
fn scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let size = find_sizes(lane);
    let first = group.x * BLOCK;
    if first >= size.x {
        return;
    }
    let scaling = key_scaling();
    for (var k = 0u; k < BLOCK / LANES; k++) {
        let i = k * LANES + lane;
        places[i + i / WALK] = digit_of(first + i, size.x, scaling);
    }
    for (var digit = lane; digit < DIGITS; digit += LANES) {
        starts[digit] = table[digit * size.y + group.x];
    }
    workgroupBarrier();
    if lane < WALKERS {
        for (var k = 0u; k < WALK; k++) {
            let digit = places[lane * (WALK + 1u) + k];
            if digit != NONE {
                counts[(digit / 2u) * ROW + lane] += 1u << (16u * (digit & 1u));
            }
        }
    }
    workgroupBarrier();
    for (var word = lane; word < WORDS; word += LANES) {
        var sum = 0u;
        for (var walker = 0u; walker < WALKERS; walker++) {
            let own = counts[word * ROW + walker];
            counts[word * ROW + walker] = sum;
            sum += own;
        }
    }
    workgroupBarrier();
    if lane < WALKERS {
        for (var k = 0u; k < WALK; k++) {
            let at = lane * (WALK + 1u) + k;
            let digit = places[at];
            if digit != NONE {
                let cell = (digit / 2u) * ROW + lane;
                let shift = 16u * (digit & 1u);
                places[at] = starts[digit] + ((counts[cell] >> shift) & 0xffffu);
                counts[cell] += 1u << shift;
            }
        }
    }
    workgroupBarrier();
    for (var k = 0u; k < BLOCK / LANES; k++) {
        let i = k * LANES + lane;
        let place = places[i + i / WALK];
        if place != NONE {
            sorted[place] = source[first + i];
        }
    }
}
