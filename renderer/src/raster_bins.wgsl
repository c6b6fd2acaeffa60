// Lists the Gaussians of every tile in depth order: a stable counting sort by tile, where each
// invocation owns a contiguous chunk of the depth order and its own column of the tile table.
// Prefix: camera.wgsl, raster_frame.wgsl.
@group(0) @binding(0) var<uniform> frame: Frame;
// (depth key, Gaussian), nearest first
@group(0) @binding(1) var<storage, read_write> ordered: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> visible: array<u32>;
@group(0) @binding(3) var<storage, read_write> rects: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read_write> chunk_pairs: array<u32>;
// table[tile * bin_chunks + chunk]
@group(0) @binding(5) var<storage, read_write> table: array<u32>;
@group(0) @binding(6) var<storage, read_write> pairs: array<u32>;
// visible Gaussians, pairs wanted, pictures so far that wanted more pairs than there is room for
@group(0) @binding(7) var<storage, read_write> stats: array<u32>;

struct Rect {
    first: vec2<u32>,
    last: vec2<u32>,
    count: u32,
}

fn rect_of(rank: u32) -> Rect {
    let packed = rects[ordered[rank].y];
    var rect: Rect;
    rect.first = vec2(packed.x & 0xffffu, packed.x >> 16u);
    rect.last = vec2(packed.y & 0xffffu, packed.y >> 16u);
    let size = rect.last - rect.first + vec2(1u);
    rect.count = size.x * size.y;
    return rect;
}

fn chunk(index: u32) -> vec2<u32> {
    let count = visible[0];
    let size = (count + frame.bin_chunks - 1u) / frame.bin_chunks;
    let begin = min(index * size, count);
    return vec2(begin, min(begin + size, count));
}

// Sums stop growing one above the capacity, far below the overflow of u32.
fn add_pairs(sum: u32, more: u32) -> u32 {
    return min(sum + more, frame.pair_capacity + 1u);
}

fn pairs_before(index: u32) -> u32 {
    var sum = 0u;
    for (var c = 0u; c < index; c++) {
        sum = add_pairs(sum, chunk_pairs[c]);
    }
    return sum;
}

@compute @workgroup_size(32)
fn count_pairs(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.bin_chunks {
        return;
    }
    let range = chunk(id.x);
    var sum = 0u;
    for (var rank = range.x; rank < range.y; rank++) {
        sum = add_pairs(sum, rect_of(rank).count);
    }
    chunk_pairs[id.x] = sum;
}

@compute @workgroup_size(32)
fn count_tiles(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.bin_chunks {
        return;
    }
    let tiles = frame.tiles.x * frame.tiles.y;
    for (var t = 0u; t < tiles; t++) {
        table[t * frame.bin_chunks + id.x] = 0u;
    }
    var sum = pairs_before(id.x);
    let range = chunk(id.x);
    for (var rank = range.x; rank < range.y; rank++) {
        let rect = rect_of(rank);
        sum = add_pairs(sum, rect.count);
        // Nothing behind the first Gaussian that does not fit is kept.
        if sum > frame.pair_capacity {
            break;
        }
        for (var y = rect.first.y; y <= rect.last.y; y++) {
            for (var x = rect.first.x; x <= rect.last.x; x++) {
                table[(y * frame.tiles.x + x) * frame.bin_chunks + id.x] += 1u;
            }
        }
    }
}

// After this pass table[i] is the end of list i, which is the start of list i + 1.
@compute @workgroup_size(32)
fn list_pairs(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.bin_chunks {
        return;
    }
    var sum = pairs_before(id.x);
    let range = chunk(id.x);
    for (var rank = range.x; rank < range.y; rank++) {
        let rect = rect_of(rank);
        sum = add_pairs(sum, rect.count);
        if sum > frame.pair_capacity {
            break;
        }
        let gaussian = ordered[rank].y;
        for (var y = rect.first.y; y <= rect.last.y; y++) {
            for (var x = rect.first.x; x <= rect.last.x; x++) {
                let cell = (y * frame.tiles.x + x) * frame.bin_chunks + id.x;
                let place = table[cell];
                table[cell] = place + 1u;
                pairs[place] = gaussian;
            }
        }
    }
    if id.x == frame.bin_chunks - 1u {
        let wanted = add_pairs(pairs_before(id.x), chunk_pairs[id.x]);
        stats[0] = visible[0];
        stats[1] = wanted;
        if wanted > frame.pair_capacity {
            stats[2] += 1u;
        }
    }
}
