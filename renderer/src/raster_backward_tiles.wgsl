// Sum of a Gaussian's pair sums over its tiles, row by row.
// Needs raster_frame.wgsl, raster_backward_frame.wgsl and the bindings frame, tile_limits and pair_sums.
fn sum_of_tiles(place: Place) -> PairSum {
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
        }
        tile.x += 1u;
        if tile.x > (place.last & 0xffffu) {
            tile = vec2(place.first & 0xffffu, tile.y + 1u);
        }
    }
    return PairSum(array(sums_a, sums_b, carried));
}
