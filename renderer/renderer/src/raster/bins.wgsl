// Lists the Gaussians of every tile in depth order: pairs (tile, Gaussian) are written in depth order, and a stable sort by tile
// (sort/radix.wgsl) makes lists of them. Sharing by pairs bounds every loop, whatever the footprints: Mesa's software adapter
// silently ends loops after 65535 iterations of one invocation.
// No kernel uses more than 8 of the bindings: all that browsers promise (shader_tests.rs).
// Prefix: const LANES, BLOCK and DIGIT_BITS of the sort, camera.wgsl, raster/frame.wgsl.
@group(0) @binding(0) var<storage, read> frame: Frame;
// (depth key, Gaussian), nearest first
@group(0) @binding(1) var<storage, read> ordered: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> visible: array<u32>;
@group(0) @binding(3) var<storage, read> rects: array<vec2<u32>>;
// By rank in depth order: pairs of that Gaussian, and after the scan of all nearer ones.
@group(0) @binding(4) var<storage, read_write> pairs_before: array<u32>;
@group(0) @binding(5) var<storage, read> pair_total: array<u32>;
// Pairs that fit: those of the nearest Gaussians, none of them in part.
@group(0) @binding(6) var<storage, read_write> kept: array<u32>;
// (tile, Gaussian)
@group(0) @binding(7) var<storage, read_write> pairs: array<vec2<u32>>;
// End of each tile's list, which is the start of the next one's.
@group(0) @binding(8) var<storage, read_write> ends: array<u32>;
// visible Gaussians, pairs wanted, images so far that wanted more pairs than there is room for
@group(0) @binding(9) var<storage, read_write> stats: array<u32>;
@group(0) @binding(10) var<storage, read_write> work: Work;

// Of the kernels whose work depends on the number of pairs.
struct Work {
    // x: length of the table that the sort by tile scans.
    table_length: vec4<u32>,
    // xyz: workgroups of write_pairs, and of the sort by tile.
    write_groups: vec4<u32>,
    sort_groups: vec4<u32>,
}

struct Rect {
    first: vec2<u32>,
    size: vec2<u32>,
}

fn rect_of(rank: u32) -> Rect {
    let packed = rects[ordered[rank].y];
    var rect: Rect;
    rect.first = vec2(packed.x & 0xffffu, packed.x >> 16u);
    rect.size = vec2(packed.y & 0xffffu, packed.y >> 16u) - rect.first + vec2(1u);
    return rect;
}

fn invocation(group: vec3<u32>, groups: vec3<u32>, lane: u32) -> u32 {
    return (group.y * groups.x + group.x) * LANES + lane;
}

@compute @workgroup_size(LANES)
fn count_pairs(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) lane: u32) {
    let rank = invocation(group, groups, lane);
    if rank >= frame.gaussians {
        return;
    }
    var count = 0u;
    if rank < visible[0] {
        let size = rect_of(rank).size;
        count = size.x * size.y;
    }
    pairs_before[rank] = count;
}

// The last rank before which there are at most so many pairs.
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

@compute @workgroup_size(1)
fn keep_pairs() {
    let wanted = min(pair_total[0], frame.pair_capacity + 1u);
    var fitting = wanted;
    if wanted > frame.pair_capacity {
        fitting = pairs_before[rank_of(frame.pair_capacity)];
        stats[2] += 1u;
    }
    kept[0] = fitting;
    let blocks = max(1u, (fitting + BLOCK - 1u) / BLOCK);
    work.table_length.x = blocks << DIGIT_BITS;
    work.write_groups = vec4((fitting + LANES - 1u) / LANES, 1u, 1u, 0u);
    work.sort_groups = vec4(blocks, 1u, 1u, 0u);
    stats[0] = visible[0];
    stats[1] = wanted;
}

@compute @workgroup_size(LANES)
fn write_pairs(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) lane: u32) {
    let pair = invocation(group, groups, lane);
    if pair >= kept[0] {
        return;
    }
    let rank = rank_of(pair);
    let rect = rect_of(rank);
    let within = pair - pairs_before[rank];
    let tile = rect.first + vec2(within % rect.size.x, within / rect.size.x);
    pairs[pair] = vec2(tile.y * frame.tiles.x + tile.x, ordered[rank].y);
}

// After the sort by tile.
@compute @workgroup_size(LANES)
fn end_lists(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) lane: u32) {
    let tile = invocation(group, groups, lane);
    if tile >= frame.tiles.x * frame.tiles.y {
        return;
    }
    var low = 0u;
    var high = kept[0];
    while low < high {
        let middle = (low + high) / 2u;
        if pairs[middle].x <= tile {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    ends[tile] = low;
}
