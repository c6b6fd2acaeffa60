// Derivative of the blending: one workgroup a tile, one invocation for four pixels of a column, as in
// raster/blend.wgsl. The list is walked front to back again; what lies behind a splat is the finished pixel less
// what was blended so far. Each (tile, Gaussian) pair gets one sum over the tile's pixels, in a fixed order.
//
// A tile whose incoming gradients are all zero ends at once; a pixel without any counts as finished.
// Lines between "// only planes" or "// only plain" and "// end" belong to images with or without planes.
// Prefix: camera.wgsl, raster/frame.wgsl, raster/busy.wgsl, backward/frame.wgsl, with planes anisotropic/plane.wgsl, const TILE, CUT,
// MAX_ALPHA, OPAQUE, WITH_DEPTH, CARRY_COLOR, BATCH, VECTORS, MAX_LIST.
@group(0) @binding(0) var<storage, read> frame: Frame;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> color: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> ends: array<u32>;
// (tile, Gaussian)
@group(0) @binding(4) var<storage, read> pairs: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> places: array<Place>;
// The images that the forward pass drew.
@group(0) @binding(6) var<storage, read> drawn_color: array<vec4<f32>>;
// only plain
@group(0) @binding(7) var<storage, read> drawn_depth: array<f32>;
// end
// dL/d (red, green, blue, alpha)
@group(0) @binding(8) var<storage, read> incoming_color: array<vec4<f32>>;
// only plain
// dL/d depth, and three numbers that are carried to the Gaussians unless CARRY_COLOR: then dL/d color is
@group(0) @binding(9) var<storage, read> incoming_depth: array<vec4<f32>>;
// end
@group(0) @binding(10) var<storage, read_write> pair_sums: array<PairSum>;
@group(0) @binding(11) var<storage, read_write> tile_limits: array<u32>;
// only planes
@group(0) @binding(12) var<storage, read> planes: array<Plane>;
// Sums of normals and plane depths that the forward pass drew, and dL/d them.
@group(0) @binding(13) var<storage, read> drawn_planes: array<vec4<f32>>;
@group(0) @binding(14) var<storage, read> incoming_planes: array<vec4<f32>>;
// end

const ROWS = 4u;
const INVOCATIONS = TILE * TILE / ROWS;
const LN_2 = 0.6931471805599453;
// Parts of a sum over the invocations, so that as many of them as possible add up.
const PARTS = max(1u, INVOCATIONS / (BATCH * VECTORS * 4u) * 4u);
const PART = INVOCATIONS / PARTS;

// Splats that are loaded together, a multiple of BATCH: loads one after the other are what a graphics processor waits for.
const LOADED = 32u;

var<workgroup> loaded_splats: array<Splat, LOADED>;
var<workgroup> loaded_color: array<vec3<f32>, LOADED>;
var<workgroup> loaded_places: array<Place, LOADED>;
// only planes
var<workgroup> loaded_planes: array<Plane, LOADED>;
// end
// partial[(splat of the batch * VECTORS + vector) * INVOCATIONS + invocation]
var<workgroup> partials: array<vec4<f32>, BATCH * VECTORS * INVOCATIONS>;

// On the bits, since compilers may assume that comparisons never see NaN.
fn finite(v: vec4<f32>) -> bool {
    return all((bitcast<vec4<u32>>(v) & vec4(0x7f800000u)) != vec4(0x7f800000u));
}

@compute @workgroup_size(TILE, TILE / ROWS)
fn blend_backward(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>,
                  @builtin(local_invocation_index) index: u32) {
    let tile = group.xy + frame.first_tile;
    let first = vec2(tile.x * TILE + local.x, tile.y * TILE + local.y * ROWS);
    let tile_index = tile.y * frame.tiles.x + tile.x;
    // One component a pixel. A pixel that cannot matter starts opaque.
    var transmittance = vec4(0.0);
    var red = vec4(0.0);
    var green = vec4(0.0);
    var blue = vec4(0.0);
    // dL/d alpha of the pixel times the light that passes all, dL/d depth / alpha, and the drawn depth
    var passing = vec4(0.0);
    var by_depth = vec4(0.0);
    var mean_depth = vec4(0.0);
    var carried_x = vec4(0.0);
    var carried_y = vec4(0.0);
    var carried_z = vec4(0.0);
    // Loss by the colours that are still to be blended, were the loss linear. Depths are taken from the drawn depth:
    // theirs add up to 0.
    var behind = vec4(0.0);
    // only planes
    // dL/d normal sums, dL/d sum of plane depths, and the mean of the plane depths.
    var normal_x = vec4(0.0);
    var normal_y = vec4(0.0);
    var normal_z = vec4(0.0);
    var by_plane = vec4(0.0);
    var mean_plane = vec4(0.0);
    // end
    for (var row = 0u; row < ROWS; row++) {
        if first.x < frame.size.x && first.y + row < frame.size.y {
            let at = (first.y + row) * frame.size.x + first.x;
            let seen = drawn_color[at];
            let d_color = incoming_color[at];
            // only plain
            var d_depth = incoming_depth[at];
            // end
            // only planes
            var d_depth = vec4(0.0);
            let d_plane = incoming_planes[at];
            // end
            if !WITH_DEPTH {
                d_depth.x = 0.0;
            }
            if CARRY_COLOR {
                d_depth = vec4(d_depth.x, d_color.rgb);
            }
            var matters = any(d_color != vec4(0.0)) || any(d_depth != vec4(0.0));
            // only planes
            matters = (matters || any(d_plane != vec4(0.0))) && finite(d_plane);
            // end
            if seen.w > 0.0 && matters && finite(d_color) && finite(d_depth) {
                transmittance[row] = 1.0;
                red[row] = d_color.r;
                green[row] = d_color.g;
                blue[row] = d_color.b;
                passing[row] = d_color.a * (1.0 - seen.w);
                // only plain
                if WITH_DEPTH {
                    by_depth[row] = d_depth.x / max(seen.w, 1e-6);
                    mean_depth[row] = drawn_depth[at];
                }
                // end
                behind[row] = dot(d_color.rgb, seen.rgb);
                // only planes
                // Depths count relative to their mean: the rest is dL/d alpha.
                let drawn = drawn_planes[at];
                normal_x[row] = d_plane.x;
                normal_y[row] = d_plane.y;
                normal_z[row] = d_plane.z;
                by_plane[row] = d_plane.w;
                mean_plane[row] = drawn.w / max(seen.w, 1e-6);
                passing[row] = (d_color.a + d_plane.w * mean_plane[row]) * (1.0 - seen.w);
                behind[row] += dot(d_plane.xyz, drawn.xyz);
                // end
                carried_x[row] = d_depth.y;
                carried_y[row] = d_depth.z;
                carried_z[row] = d_depth.w;
            }
        }
    }
    if !any_busy(index, any(transmittance > vec4(0.0))) {
        if index == 0u {
            tile_limits[tile_index] = 0u;
        }
        return;
    }
    var begin = 0u;
    if tile_index > 0u {
        begin = ends[tile_index - 1u];
    }
    let end = min(ends[tile_index], begin + MAX_LIST);
    let x = f32(first.x);
    let y = f32(first.y) + vec4(0.0, 1.0, 2.0, 3.0);
    let log2_cut = vec4(log2(CUT));
    var walked = begin;
    for (var batch = begin; batch < end; batch += BATCH) {
        let count = min(BATCH, end - batch);
        let loaded = (batch - begin) % LOADED;
        if loaded == 0u {
            for (var k = index; k < min(LOADED, end - batch); k += INVOCATIONS) {
                let g = pairs[batch + k].y;
                loaded_splats[k] = splats[g];
                loaded_color[k] = color[g].rgb;
                loaded_places[k] = places[g];
                // only planes
                loaded_planes[k] = planes[g];
                // end
            }
            workgroupBarrier();
        }
        for (var b = 0u; b < count; b++) {
            let splat = loaded_splats[loaded + b];
            let dx = x - splat.pixel.x;
            let dy = y - splat.pixel.y;
            let exponent =
                splat.log2_opacity - splat.conic.x * dx * dx - dy * (splat.conic.y * dx + splat.conic.z * dy);
            let touched = (exponent >= log2_cut) & (transmittance >= vec4(OPAQUE));
            var first_moments = vec4(0.0);
            var second_moments = vec4(0.0);
            var carried = vec4(0.0);
            // only planes
            var plane_a = vec4(0.0);
            var plane_b = vec4(0.0);
            // end
            if any(touched) {
                let unclamped = exp2(exponent);
                let alpha = select(vec4(0.0), min(unclamped, vec4(MAX_ALPHA)), touched);
                let weight = alpha * transmittance;
                let paint = loaded_color[loaded + b];
                var value =
                    red * paint.r + green * paint.g + blue * paint.b + by_depth * (splat.depth - mean_depth);
                // only planes
                let plane = loaded_planes[loaded + b];
                let inverse_ratio = inverse_ratios(plane, dx, dy);
                let ratio = 1.0 / limited(plane, inverse_ratio);
                value += normal_x * plane.normal.x + normal_y * plane.normal.y + normal_z * plane.normal.z
                    + by_plane * (splat.depth * ratio - mean_plane);
                let near = inverse_ratio >= vec4(plane.most);
                let inside = (inverse_ratio > vec4(plane.least)) & (inverse_ratio < vec4(plane.most));
                let by_ratio = weight * by_plane * splat.depth;
                // dL/dt, and dL/d reach where t is limited.
                let by_inverse = select(vec4(0.0), -by_ratio * ratio * ratio, inside);
                let by_reach = select(select(by_ratio, -by_ratio, near), vec4(0.0), inside);
                let all = vec4(1.0);
                plane_a = vec4(dot(weight, normal_x), dot(weight, normal_y), dot(weight, normal_z),
                               dot(weight, by_plane * ratio));
                plane_b = vec4(dot(by_inverse, all), dx * dot(by_inverse, all), dot(by_inverse, dy), dot(by_reach, all));
                // end
                behind -= weight * value;
                let by_this_alpha = transmittance * value + (passing - behind) / (1.0 - alpha);
                // dL/d exponent; at the clamp alpha does not follow it.
                let slope = select(vec4(0.0), by_this_alpha * alpha * LN_2, unclamped < vec4(MAX_ALPHA));
                let slope_y = slope * dy;
                let ones = vec4(1.0);
                first_moments = vec4(dot(slope, ones), dx * dot(slope, ones), dot(slope_y, ones),
                                     dot(weight, by_depth));
                second_moments = vec4(dx * dx * dot(slope, ones), dx * dot(slope_y, ones), dot(slope_y, dy),
                                      dot(weight, ones));
                carried = vec4(dot(weight, carried_x), dot(weight, carried_y), dot(weight, carried_z), 0.0);
                transmittance *= 1.0 - alpha;
            }
            let at = b * VECTORS * INVOCATIONS + index;
            partials[at] = first_moments;
            partials[at + INVOCATIONS] = second_moments;
            partials[at + 2u * INVOCATIONS] = carried;
            // only planes
            partials[at + 3u * INVOCATIONS] = plane_a;
            partials[at + 4u * INVOCATIONS] = plane_b;
            // end
        }
        let more = any_busy(index, any(transmittance >= vec4(OPAQUE)));
        // Each sum in PARTS parts, then the parts, always in the same order.
        for (var part = index; part < count * VECTORS * PARTS; part += INVOCATIONS) {
            let first = part * PART;
            var sum = vec4(0.0);
            for (var i = first; i < first + PART; i += 4u) {
                sum += (partials[i] + partials[i + 1u]) + (partials[i + 2u] + partials[i + 3u]);
            }
            partials[first] = sum;
        }
        if PARTS > 1u {
            workgroupBarrier();
        }
        for (var item = index; item < count * VECTORS; item += INVOCATIONS) {
            let place = loaded_places[loaded + item / VECTORS];
            if place.fits != 0u {
                var sum = vec4(0.0);
                for (var i = 0u; i < INVOCATIONS; i += PART) {
                    sum += partials[item * INVOCATIONS + i];
                }
                let slot = place.offset + (tile.y - (place.first >> 16u)) * place_width(place)
                    + tile.x - (place.first & 0xffffu);
                pair_sums[slot].vectors[item % VECTORS] = sum;
            }
        }
        walked = batch + count;
        if !more {
            break;
        }
        workgroupBarrier();
    }
    if index == 0u {
        // Lists are in depth order, in which offsets grow.
        var limit = 0u;
        if walked > begin {
            limit = places[pairs[walked - 1u].y].offset + 1u;
        }
        tile_limits[tile_index] = limit;
    }
}
