// Where the sums of a Gaussian's tiles lie: one slot a tile of its rectangle, row by row.
struct Place {
    // First and last tile, each x | y << 16.
    first: u32,
    last: u32,
    // First slot; grows with depth.
    offset: u32,
    // 0: not drawn, or no room for its slots.
    fits: u32,
}

// Sums over the pixels of one tile for one Gaussian. With e the exponent log2(alpha), s = dL/de of a pixel, (x, y) the
// pixel from the splat's centre and w its blending weight:
// [s, s x, s y, w dL/d(depth sum)], [s x x, s x y, s y y, w], [w carried, 0]; and, where the image has planes (VECTORS = 5), with t
// the ratio of the centre's depth to the plane's: [w dL/d(normal sum), w dL/d(plane depth sum) / t],
// [dL/dt, dL/dt x, dL/dt y where t is not limited, dL/d reach where it is].
// Prefix: const VECTORS.
struct PairSum {
    vectors: array<vec4<f32>, VECTORS>,
}

fn place_width(place: Place) -> u32 {
    return (place.last & 0xffffu) - (place.first & 0xffffu) + 1u;
}

fn place_height(place: Place) -> u32 {
    return (place.last >> 16u) - (place.first >> 16u) + 1u;
}
