// One invocation a Gaussian: adds up the sums of its tiles row by row, for the kernels that carry them on.
// Lines between "// only planes" or "// only plain" and "// end" belong to images with or without planes.
// Prefix: camera.wgsl, raster/frame.wgsl, backward/frame.wgsl.
@group(0) @binding(0) var<storage, read> frame: Frame;
@group(0) @binding(1) var<storage, read> places: array<Place>;
@group(0) @binding(2) var<storage, read> tile_limits: array<u32>;
@group(0) @binding(3) var<storage, read> pair_sums: array<PairSum>;
// By Gaussian; the weight is 0 where nothing matters.
@group(0) @binding(4) var<storage, read_write> sums: array<PairSum>;

@compute @workgroup_size(64)
fn sum_tiles(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i >= frame.gaussians {
        return;
    }
    let place = places[i];
    if place.fits == 0u {
        sums[i].vectors[1] = vec4(0.0);
        return;
    }
    // only planes
    var plane_a = vec4(0.0);
    var plane_b = vec4(0.0);
    // end
    let width = place_width(place);
    let tiles = width * place_height(place);
    var tile = vec2(place.first & 0xffffu, place.first >> 16u);
    var sums_a = vec4(0.0);
    var sums_b = vec4(0.0);
    var carried = vec4(0.0);
    for (var t = 0u; t < tiles; t++) {
        if place.offset < tile_limits[tile.y * frame.tiles.x + tile.x] {
            sums_a += pair_sums[place.offset + t].vectors[0];
            sums_b += pair_sums[place.offset + t].vectors[1];
            carried += pair_sums[place.offset + t].vectors[2];
            // only planes
            plane_a += pair_sums[place.offset + t].vectors[3];
            plane_b += pair_sums[place.offset + t].vectors[4];
            // end
        }
        tile.x += 1u;
        if tile.x > (place.last & 0xffffu) {
            tile = vec2(place.first & 0xffffu, tile.y + 1u);
        }
    }
    // only plain
    sums[i] = PairSum(array(sums_a, sums_b, carried));
    // end
    // only planes
    sums[i] = PairSum(array(sums_a, sums_b, carried, plane_a, plane_b));
    // end
}
