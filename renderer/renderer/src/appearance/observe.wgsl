// One thread a Gaussian, one dispatch a view: adds what this view saw of it (Eq. 5 to 8).
@group(0) @binding(0) var<storage, read> settings: Settings;
@group(0) @binding(1) var<storage, read> camera: Camera;
// sRGB bytes, red lowest; mask coverage highest.
@group(0) @binding(2) var<storage, read> picture: array<u32>;
// Canonical position times alpha; w: alpha.
@group(0) @binding(3) var<storage, read> rendered_canonical: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> center_scale: array<vec4<f32>>;
// w: depth of the centre below the drawn surface.
@group(0) @binding(5) var<storage, read> normals: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> canonical: array<vec4<f32>>;
// Sum of weight * linear RGB; w: sum of weights.
@group(0) @binding(7) var<storage, read_write> seen: array<vec4<f32>>;
// x: sum of Eq. 6 weights, y: exp(-k d) of the closest view that sees it.
@group(0) @binding(8) var<storage, read_write> quality: array<vec2<f32>>;
// Linear value of each sRGB byte.
@group(0) @binding(9) var<storage, read> linear_from_srgb: array<f32>;
// The last colours as this view shows them, times alpha; w: alpha.
@group(0) @binding(10) var<storage, read> drawn: array<vec4<f32>>;
@group(0) @binding(11) var<storage, read> last: array<vec4<f32>>;
// Pixel, weight and exp(-k d) of this view alone; shorter than the Gaussians where nobody asked for it.
@group(0) @binding(12) var<storage, read_write> kept: array<vec4<f32>>;

fn linear_rgb(packed: u32) -> vec3<f32> {
    let byte = (vec3(packed) >> vec3(0u, 8u, 16u)) & vec3(0xffu);
    return vec3(linear_from_srgb[byte.x], linear_from_srgb[byte.y], linear_from_srgb[byte.z]);
}

// Eq. 7 in observation space. The sine through the cross product: sqrt(1 - cos^2) loses half the digits
// exactly where the weight is largest.
fn angle_weight(normal: vec3<f32>, camera_to_point: vec3<f32>) -> f32 {
    let lengths = length(normal) * length(camera_to_point);
    if !(dot(normal, camera_to_point) < 0.0) || !(lengths > 0.0) || !is_finite(lengths) {
        return 0.0;
    }
    return 1.0 - min(length(cross(normal, camera_to_point)) / lengths, 1.0);
}

// Adds what drawing takes away: a Gaussian's image is its colour mixed with its neighbours'.
fn sharpened(color: vec3<f32>, last: vec3<f32>, shown: vec4<f32>) -> vec3<f32> {
    if settings.corrects != 0u {
        let corrected = settings.sharpness * (last + color - shown.rgb / shown.w);
        return select(vec3(0.0), clamp(corrected, vec3(-1.0), vec3(1.0)), all_finite(vec4(corrected, 0.0)));
    }
    if !(settings.sharpness > 0.0 && shown.w >= MIN_RENDERED_ALPHA) {
        return color;
    }
    let sharper = color + settings.sharpness * (last - shown.rgb / shown.w);
    if !all_finite(vec4(sharper, 0.0)) {
        return color;
    }
    return clamp(sharper, vec3(0.0), vec3(1.0));
}

@compute @workgroup_size(WORKGROUP)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = (group.y * groups.x + group.x) * WORKGROUP + lane;
    if i >= arrayLength(&seen) {
        return;
    }
    // The drawn surface lies above the centre (base/body/src/inset.rs): what a camera sees of the Gaussian is there.
    let position = center_scale[i].xyz + normals[i].w * normals[i].xyz;
    let angle = angle_weight(normals[i].xyz, position - camera.position.xyz);
    if settings.view_weight == 0.0 && !(angle > 0.0) {
        return;
    }
    let projected = project_point(camera, position, NEAR_M);
    if !projected.valid {
        return;
    }
    let pixel = projected.pixel;
    let size = vec2<f32>(camera.size);
    if !(all(pixel >= vec2(-0.5)) && all(pixel <= size - 0.5)) {
        return;
    }
    // Bilinear by hand: hardware filters know nothing of the mask and pull the background in at silhouettes, and
    // software adapters decode sRGB textures with errors of 1e-3.
    let base = floor(pixel);
    let fraction = pixel - base;
    var color = vec3(0.0);
    var coverage = 0.0;
    var rendered = vec4(0.0);
    var shown = vec4(0.0);
    for (var corner = 0u; corner < 4u; corner += 1u) {
        let offset = vec2<u32>(corner & 1u, corner >> 1u);
        let texel = vec2<u32>(clamp(vec2<i32>(base) + vec2<i32>(offset), vec2(0), vec2<i32>(camera.size) - 1));
        let side = select(1.0 - fraction, fraction, offset == vec2(1u));
        let share = side.x * side.y;
        let index = texel.y * camera.size.x + texel.x;
        let packed = picture[index];
        let mask = f32(packed >> 24u) / 255.0;
        let belief = share * clamp((mask - settings.min_mask) / (1.0 - settings.min_mask), 0.0, 1.0);
        color += belief * linear_rgb(packed);
        coverage += belief;
        rendered += share * rendered_canonical[index];
        shown += share * drawn[index];
    }
    if !(coverage >= MIN_COVERAGE) {
        return;
    }
    color /= coverage;
    var weight = 0.0;
    var nearness = 0.0;
    if rendered.w >= MIN_RENDERED_ALPHA {
        // Eq. 8: near the rendered surface in canonical space, so that an arm never paints the belly behind it.
        let d = distance(canonical[i].xyz, rendered.xyz / rendered.w);
        let surface = max(1.0 - settings.occlusion_per_m * d, 0.0);
        weight = angle * surface * coverage;
        if weight > 0.0 && is_finite(weight) {
            let before = quality[i];
            nearness = exp(-settings.occlusion_per_m * d);
            quality[i] = vec2(before.x + weight, max(before.y, nearness));
            color = sharpened(color, last[i].rgb, shown);
        } else {
            weight = 0.0;
        }
    }
    let total = weight + settings.view_weight * coverage;
    seen[i] += vec4(color * total, total);
    if i < arrayLength(&kept) {
        kept[i] = vec4(pixel, total, nearness);
    }
}
