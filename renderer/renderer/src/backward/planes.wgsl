// Derivative of the planes, for project.wgsl. Nothing flows to the normal through the slope of a plane that is edge-on, nor to the
// scales where the reach is limited.
// Prefix: camera.wgsl, anisotropic/plane.wgsl, through_lens_jacobian.
struct PlaneSlopes {
    // dL/d centre in camera axes.
    center: vec3<f32>,
    scale: vec3<f32>,
    // Slope by a small turn in camera axes, sum of a x dL/da over the axes.
    turn: vec3<f32>,
}

// `sums_d` and `sums_e` are the last two vectors of PairSum.
fn plane_slopes(camera: Camera, p: vec3<f32>, axes: mat3x3<f32>, scale_m: vec3<f32>, sums_d: vec4<f32>,
                sums_e: vec4<f32>) -> PlaneSlopes {
    let shape = plane_of(camera, p, axes, scale_m);
    let inverse_z = 1.0 / p.z;
    let normal = shape.plane.normal;
    let slope = shape.plane.slope;

    // slope = L^-T normal.xy / cosine with L = d pixel / d ideal point.
    let by_slope = sums_e.yz;
    let by_ideal = shape.ideal_by_pixel * by_slope;
    let by_cosine = select(-dot(slope, by_slope) / shape.cosine, 0.0, shape.edge_on);
    let d_normal = sums_d.xyz + vec3(by_ideal / shape.cosine, 0.0) + vec3(shape.ideal, 1.0) * by_cosine;
    let by_row = -slope * camera.focal_px;
    let d_ideal = normal.xy * by_cosine
        + through_lens_jacobian(camera, shape.ideal, mat2x2(by_row * by_ideal.x, by_row * by_ideal.y));
    // t is 1 at the splat's centre, which moves with the Gaussian.
    let d_pixel = -slope * sums_e.x;
    let f = camera.focal_px * inverse_z;
    let along_x = shape.lens[0] * f;
    let along_y = shape.lens[1] * f;
    let along_z = -(shape.ideal.x * along_x + shape.ideal.y * along_y);

    // reach = REACH deviation / z, and the deviation is the length of `deviations`.
    let by_reach = select(0.0, sums_e.w, shape.reach < MOST_REACH);
    let by_deviation = REACH * inverse_z * by_reach / max(shape.deviation, 1e-30);
    let axis_z = vec3(axes[0].z, axes[1].z, axes[2].z);
    let deviations = axis_z * scale_m;
    let d_axis_z = scale_m * deviations * by_deviation;

    let d_z = sums_d.w - (dot(shape.ideal, d_ideal) + shape.reach * by_reach) * inverse_z;
    let z = vec3(0.0, 0.0, 1.0);
    var out: PlaneSlopes;
    out.center = vec3(dot(d_pixel, along_x), dot(d_pixel, along_y), dot(d_pixel, along_z))
        + vec3(d_ideal * inverse_z, d_z);
    out.scale = axis_z * deviations * by_deviation;
    // dL/d normal is that of an axis with its sign.
    out.turn = cross(normal, d_normal) + cross(axes[0], z) * d_axis_z.x + cross(axes[1], z) * d_axis_z.y
        + cross(axes[2], z) * d_axis_z.z;
    return out;
}
