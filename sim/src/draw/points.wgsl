// The moving points of a person. Prepended: view.wgsl.

// Position and openness, normal.
struct Point {
    place: vec4<f32>,
    normal: vec4<f32>,
}

// A point of `count` at a time, on the parabola through the three nearest keys, or at the only one.
fn point_at(index: u32, count: u32, secs: f32) -> Point {
    let at = (secs - view.keys.x) * view.keys.y;
    let middle = clamp(floor(at + 0.5), 1.0, max(view.keys.z - 2.0, 1.0));
    let s = at - middle;
    var weights = vec3(0.5 * s * (s - 1.0), 1.0 - s * s, 0.5 * s * (s + 1.0));
    if (view.keys.z < 2.5) {
        weights = vec3(1.0, 0.0, 0.0);
    }
    let first = (u32(middle) - 1u) * count + index;
    var sum = Point(vec4(0.0), vec4(0.0));
    for (var key = 0u; key < min(u32(view.keys.z), 3u); key++) {
        let point = points[first + key * count];
        sum = Point(sum.place + weights.x * point.place, sum.normal + weights.x * point.normal);
        weights = weights.yzx;
    }
    return sum;
}
