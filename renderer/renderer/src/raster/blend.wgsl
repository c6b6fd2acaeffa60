// One workgroup a tile, one invocation for four pixels of a column: blends the tile's list front to back.
// Invocations load the list together, a batch at a time: one after the other, its loads are what a graphics processor waits for.
// Four pixels share what is loaded of a splat, which is what the time goes into on Mesa's software adapter.
// Lines between "// only NAME" and "// end" are left out of kernels that do not write that image: a binding counts
// against the adapter's limit wherever it is declared and named, reached or not.
// Prefix: camera.wgsl, raster/frame.wgsl, raster/busy.wgsl, anisotropic/plane.wgsl with planes, const TILE, CUT, MAX_ALPHA, OPAQUE.
@group(0) @binding(0) var<storage, read> frame: Frame;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
// only color
@group(0) @binding(2) var<storage, read> color: array<vec4<f32>>;
// end
// only canonical
@group(0) @binding(3) var<storage, read> canonical: array<vec4<f32>>;
// end
@group(0) @binding(4) var<storage, read> ends: array<u32>;
// (tile, Gaussian)
@group(0) @binding(5) var<storage, read> pairs: array<vec2<u32>>;
// only color
@group(0) @binding(6) var<storage, read_write> color_out: array<vec4<f32>>;
// end
// only depth
@group(0) @binding(7) var<storage, read_write> depth_out: array<f32>;
// end
// only canonical
@group(0) @binding(8) var<storage, read_write> canonical_out: array<vec4<f32>>;
// end
// only planes
@group(0) @binding(9) var<storage, read> planes: array<Plane>;
@group(0) @binding(10) var<storage, read_write> planes_out: array<vec4<f32>>;
// end

const ROWS = 4u;
const LANES = TILE * TILE / ROWS;
// Splats of a batch.
const BATCH = 64u;

var<workgroup> batch_splats: array<Splat, BATCH>;
// only color
var<workgroup> batch_color: array<vec3<f32>, BATCH>;
// end
// only canonical
var<workgroup> batch_canonical: array<vec3<f32>, BATCH>;
// end
// only planes
var<workgroup> batch_planes: array<Plane, BATCH>;
// end

@compute @workgroup_size(TILE, TILE / ROWS)
fn blend(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>,
         @builtin(local_invocation_index) lane: u32) {
    let tile = group.xy + frame.first_tile;
    let first = vec2(tile.x * TILE + local.x, tile.y * TILE + local.y * ROWS);
    let inside = all(first < frame.size);
    let list = tile.y * frame.tiles.x + tile.x;
    var begin = 0u;
    if list > 0u {
        begin = ends[list - 1u];
    }
    let end = ends[list];
    let x = f32(first.x);
    let y = f32(first.y) + vec4(0.0, 1.0, 2.0, 3.0);
    let log2_cut = vec4(log2(CUT));
    // One component a pixel.
    var transmittance = vec4(1.0);
    // Summed, since 1 - transmittance cancels where little is covered.
    var coverage = vec4(0.0);
    var seen_red = vec4(0.0);
    var seen_green = vec4(0.0);
    var seen_blue = vec4(0.0);
    var seen_depth = vec4(0.0);
    var seen_x = vec4(0.0);
    var seen_y = vec4(0.0);
    var seen_z = vec4(0.0);
    // only planes
    var seen_normal_x = vec4(0.0);
    var seen_normal_y = vec4(0.0);
    var seen_normal_z = vec4(0.0);
    var seen_plane = vec4(0.0);
    // end
    var open = inside && begin < end;
    for (var batch = begin; any_busy(lane, open); batch += BATCH) {
        let count = min(BATCH, end - batch);
        for (var k = lane; k < count; k += LANES) {
            let g = pairs[batch + k].y;
            batch_splats[k] = splats[g];
            // only color
            batch_color[k] = color[g].rgb;
            // end
            // only canonical
            batch_canonical[k] = canonical[g].xyz;
            // end
            // only planes
            batch_planes[k] = planes[g];
            // end
        }
        workgroupBarrier();
        if open {
            for (var k = 0u; k < count; k++) {
                let splat = batch_splats[k];
                let dx = x - splat.pixel.x;
                let dy = y - splat.pixel.y;
                let exponent =
                    splat.log2_opacity - splat.conic.x * dx * dx - dy * (splat.conic.y * dx + splat.conic.z * dy);
                let touched = (exponent >= log2_cut) & (transmittance >= vec4(OPAQUE));
                if any(touched) {
                    let alpha = select(vec4(0.0), min(exp2(exponent), vec4(MAX_ALPHA)), touched);
                    let weight = alpha * transmittance;
                    // only color
                    let paint = batch_color[k];
                    seen_red += weight * paint.r;
                    seen_green += weight * paint.g;
                    seen_blue += weight * paint.b;
                    // end
                    // only depth
                    seen_depth += weight * splat.depth;
                    // end
                    // only canonical
                    let position = batch_canonical[k];
                    seen_x += weight * position.x;
                    seen_y += weight * position.y;
                    seen_z += weight * position.z;
                    // end
                    // only planes
                    let plane = batch_planes[k];
                    seen_normal_x += weight * plane.normal.x;
                    seen_normal_y += weight * plane.normal.y;
                    seen_normal_z += weight * plane.normal.z;
                    seen_plane += weight * (splat.depth / limited(plane, inverse_ratios(plane, dx, dy)));
                    // end
                    coverage += weight;
                    transmittance *= 1.0 - alpha;
                }
                if all(transmittance < vec4(OPAQUE)) {
                    break;
                }
            }
            open = any(transmittance >= vec4(OPAQUE)) && batch + count < end;
        }
    }
    if !inside {
        return;
    }
    for (var row = 0u; row < min(ROWS, frame.size.y - first.y); row++) {
        let at = (first.y + row) * frame.size.x + first.x;
        // only color
        color_out[at] = vec4(seen_red[row], seen_green[row], seen_blue[row], coverage[row]);
        // end
        // only depth
        // Coverage is 0 or at least CUT.
        depth_out[at] = seen_depth[row] / max(coverage[row], 1e-6);
        // end
        // only canonical
        canonical_out[at] = vec4(seen_x[row], seen_y[row], seen_z[row], coverage[row]);
        // end
        // only planes
        planes_out[at] = vec4(seen_normal_x[row], seen_normal_y[row], seen_normal_z[row], seen_plane[row]);
        // end
    }
}
