// Lists the Gaussians of every tile in depth order: a stable counting sort by tile of the pairs
// (Gaussian, tile), where each invocation owns an equal share of the pairs, contiguous in depth order, and
// its own column of the tile table (zeroed before). Sharing by pairs bounds every loop, whatever the
// footprints: Mesa's software adapter silently ends loops after 65535 iterations of one invocation.
// No kernel uses more than 8 of the bindings: all that browsers promise (raster_shader_tests.rs).
// Prefix: camera.wgsl, raster_frame.wgsl.
@group(0) @binding(0) var<storage, read> frame: Frame;
// (depth key, Gaussian), nearest first
@group(0) @binding(1) var<storage, read_write> ordered: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> visible: array<u32>;
@group(0) @binding(3) var<storage, read_write> rects: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read_write> chunk_pairs: array<u32>;
// Pairs of all nearer Gaussians.
@group(0) @binding(5) var<storage, read_write> pairs_before: array<u32>;
// table[tile * bin_chunks + chunk]
@group(0) @binding(6) var<storage, read_write> table: array<u32>;
@group(0) @binding(7) var<storage, read_write> pairs: array<u32>;
// visible Gaussians, pairs wanted, images so far that wanted more pairs than there is room for
@group(0) @binding(8) var<storage, read_write> stats: array<u32>;

struct Rect {
    first: vec2<u32>,
    last: vec2<u32>,
    width: u32,
    count: u32,
}

fn rect_of(rank: u32) -> Rect {
    let packed = rects[ordered[rank].y];
    var rect: Rect;
    rect.first = vec2(packed.x & 0xffffu, packed.x >> 16u);
    rect.last = vec2(packed.y & 0xffffu, packed.y >> 16u);
    let size = rect.last - rect.first + vec2(1u);
    rect.width = size.x;
    rect.count = size.x * size.y;
    return rect;
}

// Sums stop growing one above the capacity, far below the overflow of u32.
fn add_pairs(sum: u32, more: u32) -> u32 {
    return min(sum + more, frame.pair_capacity + 1u);
}

fn share(count: u32, index: u32) -> vec2<u32> {
    let size = (count + frame.bin_chunks - 1u) / frame.bin_chunks;
    let begin = min(index * size, count);
    return vec2(begin, min(begin + size, count));
}

@compute @workgroup_size(32)
fn count_pairs(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.bin_chunks {
        return;
    }
    let range = share(visible[0], id.x);
    var sum = 0u;
    for (var rank = range.x; rank < range.y; rank++) {
        sum = add_pairs(sum, rect_of(rank).count);
    }
    chunk_pairs[id.x] = sum;
}

fn pairs_of_chunks(end: u32) -> u32 {
    var sum = 0u;
    for (var c = 0u; c < end; c++) {
        sum = add_pairs(sum, chunk_pairs[c]);
    }
    return sum;
}

@compute @workgroup_size(32)
fn place_pairs(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.bin_chunks {
        return;
    }
    let range = share(visible[0], id.x);
    var sum = pairs_of_chunks(id.x);
    for (var rank = range.x; rank < range.y; rank++) {
        pairs_before[rank] = sum;
        sum = add_pairs(sum, rect_of(rank).count);
    }
}

// Last rank whose pairs begin at or before `pair`.
fn rank_of(pair: u32) -> u32 {
    var low = 0u;
    var high = visible[0];
    while high > low + 1u {
        let middle = (low + high) / 2u;
        if pairs_before[middle] <= pair {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

// Pairs that fit: those of the nearest Gaussians, none of them in part.
fn kept_pairs() -> u32 {
    let wanted = pairs_of_chunks(frame.bin_chunks);
    if wanted <= frame.pair_capacity {
        return wanted;
    }
    return pairs_before[rank_of(frame.pair_capacity)];
}

// Walks over the pairs in depth order.
struct Cursor {
    rank: u32,
    rect: Rect,
    tile: vec2<u32>,
}

fn cursor_at(pair: u32) -> Cursor {
    var cursor: Cursor;
    cursor.rank = rank_of(pair);
    cursor.rect = rect_of(cursor.rank);
    let within = pair - pairs_before[cursor.rank];
    cursor.tile = cursor.rect.first + vec2(within % cursor.rect.width, within / cursor.rect.width);
    return cursor;
}

fn next(cursor: ptr<function, Cursor>) {
    (*cursor).tile.x += 1u;
    if (*cursor).tile.x > (*cursor).rect.last.x {
        (*cursor).tile = vec2((*cursor).rect.first.x, (*cursor).tile.y + 1u);
        if (*cursor).tile.y > (*cursor).rect.last.y {
            (*cursor).rank += 1u;
            // The reads past the end of the last share's last Gaussian are of no use and do no harm.
            (*cursor).rect = rect_of(min((*cursor).rank, visible[0] - 1u));
            (*cursor).tile = (*cursor).rect.first;
        }
    }
}

fn cell(tile: vec2<u32>, index: u32) -> u32 {
    return (tile.y * frame.tiles.x + tile.x) * frame.bin_chunks + index;
}

@compute @workgroup_size(32)
fn count_tiles(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x == 0u {
        let wanted = pairs_of_chunks(frame.bin_chunks);
        stats[0] = visible[0];
        stats[1] = wanted;
        if wanted > frame.pair_capacity {
            stats[2] += 1u;
        }
    }
    let range = share(kept_pairs(), id.x);
    if id.x >= frame.bin_chunks || range.x >= range.y {
        return;
    }
    var cursor = cursor_at(range.x);
    for (var pair = range.x; pair < range.y; pair++) {
        table[cell(cursor.tile, id.x)] += 1u;
        next(&cursor);
    }
}

// After this kernel table[i] is the end of list i, which is the start of list i + 1.
@compute @workgroup_size(32)
fn list_pairs(@builtin(global_invocation_id) id: vec3<u32>) {
    let range = share(kept_pairs(), id.x);
    if id.x >= frame.bin_chunks || range.x >= range.y {
        return;
    }
    var cursor = cursor_at(range.x);
    for (var pair = range.x; pair < range.y; pair++) {
        let at = cell(cursor.tile, id.x);
        let place = table[at];
        table[at] = place + 1u;
        pairs[place] = ordered[cursor.rank].y;
        next(&cursor);
    }
}
