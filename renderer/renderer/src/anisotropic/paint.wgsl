// One invocation a Gaussian: colour of the drawn ones as the camera sees them. A colour that is not finite takes its Gaussian
// out of the image.
// Prefix: camera.wgsl, raster/frame.wgsl, the attributes `center` and `harmonics` at bindings 1 and 2, anisotropic/harmonics.wgsl, const INVALID_KEY.
@group(0) @binding(0) var<storage, read> frame: Frame;
// (depth key, Gaussian)
@group(0) @binding(3) var<storage, read_write> keyed: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read_write> painted: array<vec4<f32>>;

// On the bits, since compilers may assume that comparisons never see NaN.
fn finite(v: vec3<f32>) -> bool {
    return all((bitcast<vec3<u32>>(v) & vec3(0x7f800000u)) != vec3(0x7f800000u));
}

@compute @workgroup_size(64)
fn paint(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i >= frame.gaussians || keyed[i].x == INVALID_KEY {
        return;
    }
    let color = unclamped_color(i, normalize(center[i].xyz - frame.camera.position.xyz));
    if !finite(color) {
        keyed[i].x = INVALID_KEY;
        return;
    }
    painted[i] = vec4(max(color, vec3(0.0)), 0.0);
}
