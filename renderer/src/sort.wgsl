// One pass of a stable least-significant-digit radix sort. Each invocation owns one contiguous chunk
// and its own column of the histogram table; nothing depends on when other workgroups run.
// Prefix: const CHUNKS, DIGIT_BITS, DIGIT_PASSES, INVALID_KEY.
struct SortPass {
    // Elements before the first pass.
    count: u32,
    index: u32,
}

@group(0) @binding(0) var<storage, read> sort_pass: SortPass;
// (key, payload)
@group(0) @binding(1) var<storage, read_write> source: array<vec2<u32>>;
// Smallest and largest valid key of every chunk.
@group(0) @binding(2) var<storage, read_write> ranges: array<vec2<u32>>;
// Digit-major: table[digit * CHUNKS + chunk].
@group(0) @binding(3) var<storage, read_write> table: array<u32>;
// Number of valid elements, known after the first pass.
@group(0) @binding(4) var<storage, read_write> valid: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted: array<vec2<u32>>;

fn chunk(index: u32) -> vec2<u32> {
    var count = sort_pass.count;
    if sort_pass.index > 0u {
        count = valid[0];
    }
    let size = (count + CHUNKS - 1u) / CHUNKS;
    let begin = min(index * size, count);
    return vec2(begin, min(begin + size, count));
}

@compute @workgroup_size(32)
fn find_range(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = (sort_pass.count + CHUNKS - 1u) / CHUNKS;
    let begin = min(id.x * size, sort_pass.count);
    let end = min(begin + size, sort_pass.count);
    var range = vec2(0xffffffffu, 0u);
    for (var i = begin; i < end; i++) {
        let key = source[i].x;
        if key != INVALID_KEY {
            range = vec2(min(range.x, key), max(range.y, key));
        }
    }
    ranges[id.x] = range;
}

// x: smallest key; y: right shift that makes the range of the keys fit all digits.
fn key_scaling() -> vec2<u32> {
    var range = vec2(0xffffffffu, 0u);
    for (var c = 0u; c < CHUNKS; c++) {
        let r = ranges[c];
        range = vec2(min(range.x, r.x), max(range.y, r.y));
    }
    let bits = 32u - countLeadingZeros(max(range.x, range.y) - range.x);
    return vec2(range.x, max(bits, DIGIT_BITS * DIGIT_PASSES) - DIGIT_BITS * DIGIT_PASSES);
}

fn digit(key: u32, scaling: vec2<u32>) -> u32 {
    return (((key - scaling.x) >> scaling.y) >> (DIGIT_BITS * sort_pass.index)) & ((1u << DIGIT_BITS) - 1u);
}

@compute @workgroup_size(32)
fn count_digits(@builtin(global_invocation_id) id: vec3<u32>) {
    for (var d = 0u; d < (1u << DIGIT_BITS); d++) {
        table[d * CHUNKS + id.x] = 0u;
    }
    let scaling = key_scaling();
    let range = chunk(id.x);
    for (var i = range.x; i < range.y; i++) {
        let key = source[i].x;
        if key != INVALID_KEY {
            table[digit(key, scaling) * CHUNKS + id.x] += 1u;
        }
    }
}

@compute @workgroup_size(32)
fn scatter(@builtin(global_invocation_id) id: vec3<u32>) {
    let scaling = key_scaling();
    let range = chunk(id.x);
    for (var i = range.x; i < range.y; i++) {
        let element = source[i];
        if element.x != INVALID_KEY {
            let cell = digit(element.x, scaling) * CHUNKS + id.x;
            let place = table[cell];
            table[cell] = place + 1u;
            sorted[place] = element;
        }
    }
}
