// One invocation a rank of the depth order: where the sums of that Gaussian's tiles go (zeroed before).
// Prefix: camera.wgsl, raster/frame.wgsl, backward/frame.wgsl, const MAX_TILES.
@group(0) @binding(0) var<storage, read> frame: Frame;
// x: slots there is room for
@group(0) @binding(1) var<storage, read> room: vec4<u32>;
// (depth key, Gaussian), nearest first
@group(0) @binding(2) var<storage, read> ordered: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> visible: array<u32>;
@group(0) @binding(4) var<storage, read> rects: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> pairs_before: array<u32>;
@group(0) @binding(6) var<storage, read_write> places: array<Place>;

@compute @workgroup_size(64)
fn place_gaussians(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                   @builtin(local_invocation_index) local: u32) {
    let rank = (group.y * groups.x + group.x) * 64u + local;
    if rank >= visible[0] {
        return;
    }
    let g = ordered[rank].y;
    let rect = rects[g];
    var place: Place;
    place.first = rect.x;
    place.last = rect.y;
    place.offset = pairs_before[rank];
    let tiles = place_width(place) * place_height(place);
    // The same Gaussians that the lists kept: all whose pairs end within the capacity.
    let fits = tiles <= MAX_TILES && place.offset + tiles <= min(room.x, frame.pair_capacity);
    place.fits = u32(fits);
    places[g] = place;
}
