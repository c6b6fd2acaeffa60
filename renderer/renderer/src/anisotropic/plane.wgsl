// Plane of an anisotropic Gaussian: through its centre, perpendicular to the axis of its smallest scale. Along the ray of the pixel at
// the offset d from the splat's centre, the plane's depth is the centre's over t = 1 + dot(slope, d), with t kept within `least` and
// `most`. Needs struct Camera.
// Prefix: const LEAST_COSINE, REACH, MOST_REACH.
struct Plane {
    // Unit normal in camera axes, towards the camera.
    normal: vec3<f32>,
    least: f32,
    // Change of t per pixel.
    slope: vec2<f32>,
    most: f32,
    unused: f32,
}

// Plane with the numbers that its derivative needs.
struct PlaneShape {
    plane: Plane,
    // x/z and y/z of the centre.
    ideal: vec2<f32>,
    // Derivative of the lens by the ideal point, without the focal length.
    lens: mat2x2<f32>,
    // Inverse of d pixel / d ideal point.
    ideal_by_pixel: mat2x2<f32>,
    // Product of the normal and the ray through the centre with z = 1, at most -LEAST_COSINE.
    cosine: f32,
    edge_on: bool,
    // Standard deviation along camera z, metres.
    deviation: f32,
    // Limit of the depth's distance from that of the centre, as a share of the latter.
    reach: f32,
}

fn finite_slope(v: vec2<f32>) -> bool {
    return all((bitcast<vec2<u32>>(v) & vec2(0x7f800000u)) != vec2(0x7f800000u));
}

// Plane of a Gaussian at camera-space `p`, with unit axes in camera axes. Of equal scales the first is the smallest. A slope that
// is not finite (where the lens folds) becomes 0.
fn plane_of(camera: Camera, p: vec3<f32>, axes: mat3x3<f32>, scale_m: vec3<f32>) -> PlaneShape {
    var out: PlaneShape;
    let inverse_z = 1.0 / p.z;
    out.ideal = p.xy * inverse_z;
    out.lens = distort(camera, out.ideal).jacobian;
    let by_x = out.lens[0] * camera.focal_px;
    let by_y = out.lens[1] * camera.focal_px;
    let inverse_det = 1.0 / (by_x.x * by_y.y - by_y.x * by_x.y);
    out.ideal_by_pixel = mat2x2(vec2(by_y.y, -by_x.y) * inverse_det, vec2(-by_y.x, by_x.x) * inverse_det);
    var smallest = scale_m.x;
    var along = axes[0];
    if scale_m.y < smallest {
        smallest = scale_m.y;
        along = axes[1];
    }
    if scale_m.z < smallest {
        along = axes[2];
    }
    let normal = select(along, -along, dot(along, p) > 0.0);
    let facing = normal.x * out.ideal.x + normal.y * out.ideal.y + normal.z;
    out.edge_on = !(facing <= -LEAST_COSINE);
    out.cosine = select(facing, -LEAST_COSINE, out.edge_on);
    let slope = vec2(dot(out.ideal_by_pixel[0], normal.xy), dot(out.ideal_by_pixel[1], normal.xy)) / out.cosine;
    out.deviation = length(vec3(axes[0].z, axes[1].z, axes[2].z) * scale_m);
    out.reach = min(REACH * out.deviation * inverse_z, MOST_REACH);
    out.plane.normal = normal;
    out.plane.slope = select(vec2(0.0), slope, finite_slope(slope));
    out.plane.least = 1.0 / (1.0 + out.reach);
    out.plane.most = 1.0 / (1.0 - out.reach);
    return out;
}

// t at four pixels, before it is limited.
fn inverse_ratios(plane: Plane, dx: f32, dy: vec4<f32>) -> vec4<f32> {
    return 1.0 + plane.slope.x * dx + plane.slope.y * dy;
}

// Limits t; NaN becomes the least.
fn limited(plane: Plane, inverse_ratio: vec4<f32>) -> vec4<f32> {
    return min(select(vec4(plane.least), inverse_ratio, inverse_ratio > vec4(plane.least)), vec4(plane.most));
}
