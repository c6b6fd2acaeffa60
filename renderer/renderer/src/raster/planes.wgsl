// One invocation a Gaussian: the planes of the drawn ones.
// Prefix: camera.wgsl, raster/frame.wgsl, anisotropic/axes.wgsl, anisotropic/plane.wgsl, the first three attributes of anisotropic
// Gaussians at bindings 1 to 3, const INVALID_KEY.
@group(0) @binding(0) var<storage, read> frame: Frame;
// (depth key, Gaussian)
@group(0) @binding(4) var<storage, read> keyed: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> planes: array<Plane>;

@compute @workgroup_size(64)
fn place_planes(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                @builtin(local_invocation_index) local: u32) {
    let i = (group.y * groups.x + group.x) * 64u + local;
    if i >= frame.gaussians || keyed[i].x == INVALID_KEY {
        return;
    }
    let p = (frame.camera.camera_from_world * vec4(center[i].xyz, 1.0)).xyz;
    let axes = axes_in_camera(frame.camera, rotation[i]);
    planes[i] = plane_of(frame.camera, p, axes, scale_opacity[i].xyz).plane;
}
