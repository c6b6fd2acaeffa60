// One invocation a Gaussian: EWA projection (Zwicker et al. 2001) through the lens, low-pass filter,
// the rectangle of tiles it can reach, and its depth key.
// Lines between "// only isotropic" or "// only anisotropic" and "// end" belong to Gaussians of that kind.
// Prefix: camera.wgsl, raster/frame.wgsl, the attributes' bindings, anisotropic/axes.wgsl for anisotropic Gaussians, const TILE,
// INVALID_KEY, CUT, BACKFACING_COSINE, AWAY_COSINE.
@group(0) @binding(0) var<storage, read> frame: Frame;
// Bindings 1 to 4: the attributes of the Gaussians (schema.rs); of anisotropic ones the first three and `normal`, whose elements
// are read where Gaussians are culled.
@group(0) @binding(5) var<storage, read_write> splats: array<Splat>;
// First and last tile, each x | y << 16.
@group(0) @binding(6) var<storage, read_write> rects: array<vec2<u32>>;
// (depth key, Gaussian)
@group(0) @binding(7) var<storage, read_write> keyed: array<vec2<u32>>;

// On the bits, since compilers may assume that comparisons never see NaN.
fn finite(v: vec4<f32>) -> bool {
    return all((bitcast<vec4<u32>>(v) & vec4(0x7f800000u)) != vec4(0x7f800000u));
}

@compute @workgroup_size(64)
fn project(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
           @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i >= frame.gaussians {
        return;
    }
    keyed[i] = vec2(INVALID_KEY, i);
    // only isotropic
    let world = center_scale[i].xyz;
    let scale_m = center_scale[i].w;
    let paint = color[i];
    if !(finite(center_scale[i]) && finite(paint) && scale_m > 0.0 && paint.w > 0.0) {
        return;
    }
    let own_opacity = paint.w;
    if frame.cull_backfacing != 0u {
        let n = normal[i];
        let sight = world - frame.camera.position.xyz;
        if !finite(n) || dot(n.xyz, sight) > BACKFACING_COSINE * length(n.xyz) * length(sight) {
            return;
        }
    }
    if frame.with_canonical != 0u && !finite(canonical[i]) {
        return;
    }
    // end
    // only anisotropic
    let world = center[i].xyz;
    let scale_m = scale_opacity[i].xyz;
    let own_opacity = scale_opacity[i].w;
    let is_finite = finite(vec4(world, 0.0)) && finite(scale_opacity[i]) && finite(rotation[i]);
    if !(is_finite && all(scale_m > vec3(0.0)) && own_opacity > 0.0 && is_rotation(rotation[i])) {
        return;
    }
    if frame.cull_backfacing != 0u {
        let n = normal[i];
        let sight = world - frame.camera.position.xyz;
        if !finite(n) || dot(n.xyz, sight) > AWAY_COSINE * length(n.xyz) * length(sight) {
            return;
        }
    }
    // end
    let projected = project_point(frame.camera, world, frame.near_m);
    if !projected.valid {
        return;
    }
    let in_camera = (frame.camera.camera_from_world * vec4(world, 1.0)).xyz;
    let jacobian = projection_jacobian(frame.camera, in_camera);
    // Rows of the matrix whose product with its transpose is the covariance.
    // only isotropic
    let row_x = vec3(jacobian[0].x, jacobian[1].x, jacobian[2].x) * scale_m;
    let row_y = vec3(jacobian[0].y, jacobian[1].y, jacobian[2].y) * scale_m;
    // end
    // only anisotropic
    let along_axes = jacobian * axes_in_camera(frame.camera, rotation[i]);
    let row_x = vec3(along_axes[0].x, along_axes[1].x, along_axes[2].x) * scale_m;
    let row_y = vec3(along_axes[0].y, along_axes[1].y, along_axes[2].y) * scale_m;
    // end
    let xx = dot(row_x, row_x);
    let xy = dot(row_x, row_y);
    let yy = dot(row_y, row_y);
    // det(J J^T) by the Cauchy-Binet formula: never negative, no cancellation for thin ellipses.
    let normal_of_rows = cross(row_x, row_y);
    let det = dot(normal_of_rows, normal_of_rows);
    // Mip-Splatting's 2D Mip filter (Yu et al. 2024, Eq. 10): a wider ellipse of the same integral,
    // or of the same opacity.
    let s = frame.filter_variance_px2;
    let filtered_det = det + s * (xx + yy) + s * s;
    let kept = select(sqrt(det / filtered_det), 1.0, frame.filter_keeps_opacity != 0u);
    let opacity = min(own_opacity, 1.0) * kept;
    if !finite(vec4(projected.pixel, filtered_det, opacity)) || !(opacity > CUT) {
        return;
    }
    let filtered = vec3(xx + s, xy, yy + s);
    // opacity * exp(-r2 / 2) = CUT
    let r2 = 2.0 * log(opacity / CUT);
    let extent = sqrt(r2 * filtered.xz);
    // Pixel centres are at integers. One hundredth of a pixel covers the rounding.
    let last_pixel = vec2<f32>(frame.size - vec2(1u));
    let low = ceil(projected.pixel - extent - 0.01);
    let high = floor(projected.pixel + extent + 0.01);
    if !finite(vec4(low, high)) || any(high < vec2(0.0)) || any(low > last_pixel) || any(low > high) {
        return;
    }
    let first_tile = vec2<u32>(max(low, vec2(0.0))) / TILE;
    let last_tile = vec2<u32>(min(high, last_pixel)) / TILE;
    rects[i] = vec2(first_tile.x | (first_tile.y << 16u), last_tile.x | (last_tile.y << 16u));

    const HALF_LOG2_E = 0.72134752;
    let scale = HALF_LOG2_E / filtered_det;
    var splat: Splat;
    splat.pixel = projected.pixel;
    splat.depth = projected.depth;
    splat.log2_opacity = log2(opacity);
    splat.conic = vec3(filtered.z, -2.0 * filtered.y, filtered.x) * scale;
    splats[i] = splat;
    // The bits of positive floats sort as the floats do.
    keyed[i] = vec2(bitcast<u32>(projected.depth), i);
}
