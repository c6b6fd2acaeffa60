// One invocation a Gaussian: adds up the sums of its tiles, for the two kernels that carry them on.
// Prefix: camera.wgsl, raster_frame.wgsl, raster_backward_frame.wgsl, raster_backward_tiles.wgsl.
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
    sums[i] = sum_of_tiles(place);
}
