// One invocation a pixel, one workgroup a tile: blends the tile's list front to back. No workgroup
// memory and no barrier, so that every subgroup can leave as soon as its pixels are opaque.
// Prefix: camera.wgsl, raster_frame.wgsl, const TILE, CUT, MAX_ALPHA, OPAQUE, WITH_COLOR, WITH_DEPTH, WITH_CANONICAL.
@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> color: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> canonical: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> table: array<u32>;
@group(0) @binding(5) var<storage, read> pairs: array<u32>;
@group(0) @binding(6) var<storage, read_write> color_out: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> depth_out: array<f32>;
@group(0) @binding(8) var<storage, read_write> canonical_out: array<vec4<f32>>;

@compute @workgroup_size(TILE, TILE)
fn blend(@builtin(workgroup_id) tile: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let pixel = tile.xy * TILE + local.xy;
    if any(pixel >= frame.size) {
        return;
    }
    let list = (tile.y * frame.tiles.x + tile.x) * frame.bin_chunks;
    var begin = 0u;
    if list > 0u {
        begin = table[list - 1u];
    }
    let end = table[list + frame.bin_chunks - 1u];
    let position = vec2<f32>(pixel);
    let log2_cut = log2(CUT);
    var transmittance = 1.0;
    var seen_color = vec3(0.0);
    var seen_depth = 0.0;
    var seen_canonical = vec3(0.0);
    for (var k = begin; k < end; k++) {
        let g = pairs[k];
        let splat = splats[g];
        let d = position - splat.pixel;
        let exponent = splat.log2_opacity - (splat.conic.x * d.x * d.x + splat.conic.y * d.x * d.y + splat.conic.z * d.y * d.y);
        if exponent < log2_cut {
            continue;
        }
        let alpha = min(exp2(exponent), MAX_ALPHA);
        let weight = alpha * transmittance;
        if WITH_COLOR {
            seen_color += weight * color[g].rgb;
        }
        if WITH_DEPTH {
            seen_depth += weight * splat.depth;
        }
        if WITH_CANONICAL {
            seen_canonical += weight * canonical[g].xyz;
        }
        transmittance *= 1.0 - alpha;
        if transmittance < OPAQUE {
            break;
        }
    }
    let at = pixel.y * frame.size.x + pixel.x;
    let coverage = 1.0 - transmittance;
    if WITH_COLOR {
        color_out[at] = vec4(seen_color, coverage);
    }
    if WITH_DEPTH {
        // Coverage is 0 or at least CUT.
        depth_out[at] = seen_depth / max(coverage, 1e-6);
    }
    if WITH_CANONICAL {
        canonical_out[at] = vec4(seen_canonical, coverage);
    }
}
