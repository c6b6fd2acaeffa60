// What every raster kernel knows about the image. Needs struct Camera.
struct Frame {
    camera: Camera,
    // Pixels.
    size: vec2<u32>,
    tiles: vec2<u32>,
    gaussians: u32,
    cull_backfacing: u32,
    with_canonical: u32,
    pair_capacity: u32,
    near_m: f32,
    filter_variance_px2: f32,
    // Whether splats keep their opacity under the filter.
    filter_keeps_opacity: u32,
    unused: u32,
    // First of the tiles that are blended; the others keep their content.
    first_tile: vec2<u32>,
    unused_too: vec2<u32>,
}

struct Splat {
    // Centre in the image, pixels.
    pixel: vec2<f32>,
    // Camera-space z, metres.
    depth: f32,
    // log2 of the opacity after the filter.
    log2_opacity: f32,
    // log2(alpha) = log2_opacity - (x a x + y b x y + z c y y) at the offset (x, y) in pixels.
    conic: vec3<f32>,
    unused: f32,
}
