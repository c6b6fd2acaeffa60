//! Camera model in WGSL and on the processor against the one in f64.

use flyrig_gpu::{AdapterChoice, CAMERA_WGSL, CameraConstants, ComputeKernel, GpuContext, StorageBuffer, dispatch_1d};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DVec2, DVec3};

const KERNEL: &str = "
@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> points: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> pixels: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> jacobians: array<array<vec2<f32>, 3>>;
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= arrayLength(&points) { return; }
    let p = project_point(camera, points[id.x].xyz, 1e-3);
    pixels[id.x] = vec4(p.pixel, p.depth, select(0.0, 1.0, p.valid));
    let j = projection_jacobian(camera, (camera.camera_from_world * vec4(points[id.x].xyz, 1.0)).xyz);
    jacobians[id.x] = array(j[0], j[1], j[2]);
}
";

#[test]
fn camera_wgsl_is_valid() {
    let module = naga::front::wgsl::parse_str(&[CAMERA_WGSL, KERNEL].concat()).unwrap();
    naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty())
        .validate(&module)
        .unwrap();
}

fn cameras() -> Vec<Camera> {
    [
        Lens::PINHOLE,
        Lens::RadialTangential { radial: [-0.25, 0.08, -0.01], tangential: [0.002, -0.001] },
        Lens::Rational { radial: [0.5, 0.12, 0.01, 0.8, 0.25, 0.02], tangential: [0.002, -0.001] },
        Lens::Fisheye { coefficients: [0.06, -0.02, 0.004, -0.001] },
    ]
    .into_iter()
    .map(|lens| Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "test".into(),
        intrinsics: Intrinsics {
            width: 640,
            height: 480,
            focal_px: DVec2::new(520.0, 515.0),
            center_px: DVec2::new(321.5, 238.5),
            lens,
        },
        camera_from_world: Isometry::look_at(DVec3::new(1.0, -2.5, 1.4), DVec3::new(0.0, 0.0, 1.0), DVec3::Z),
    })
    .collect()
}

#[test]
fn wgsl_agrees_with_f64_and_poisoned_points_are_invalid() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let kernel = ComputeKernel::new(&gpu, "camera test", &[CAMERA_WGSL, KERNEL], "main");
    let mut points: Vec<[f32; 4]> = (0..500)
        .map(|i| {
            let t = i as f32;
            [(t * 0.37).sin(), (t * 0.91).cos(), 1.0 + (t * 1.7).sin(), 1.0]
        })
        .collect();
    let poisoned = [[f32::NAN, 0.0, 0.0, 1.0], [f32::INFINITY, 0.0, 0.0, 1.0], [2.0, -5.0, 1.8, 1.0]];
    points.extend(poisoned);
    for camera in cameras() {
        let uniform = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: size_of::<CameraConstants>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let constants = CameraConstants::from(&camera);
        gpu.queue.write_buffer(&uniform, 0, bytemuck::bytes_of(&constants));
        let input = StorageBuffer::from_slice(&gpu, "points", &points).unwrap();
        let pixels = StorageBuffer::<[f32; 4]>::zeroed(&gpu, "pixels", points.len()).unwrap();
        let jacobians = StorageBuffer::<[[f32; 2]; 3]>::zeroed(&gpu, "jacobians", points.len()).unwrap();
        let bindings = [
            uniform.as_entire_binding(),
            input.raw().as_entire_binding(),
            pixels.raw().as_entire_binding(),
            jacobians.raw().as_entire_binding(),
        ];
        let group = kernel.bind(&gpu, &bindings);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(&kernel.pipeline);
            pass.set_bind_group(0, &group, &[]);
            let (x, y) = dispatch_1d(points.len() as u32, 64);
            pass.dispatch_workgroups(x, y, 1);
        }
        gpu.queue.submit([encoder.finish()]);
        let (pixels, jacobians) = (pixels.read(&gpu).unwrap(), jacobians.read(&gpu).unwrap());
        let mut compared = 0;
        for ((point, got), jacobian) in points.iter().zip(&pixels).zip(&jacobians) {
            let world = DVec3::new(point[0].into(), point[1].into(), point[2].into());
            let in_camera = constants.to_camera(world.as_vec3());
            let natively = constants.project(in_camera, 1e-3);
            let Some(expected) = camera.project(world) else {
                assert!(got[3].abs() < 0.5 && natively.is_none(), "{point:?} must be invalid");
                continue;
            };
            compared += 1;
            let error = (DVec2::new(got[0].into(), got[1].into()) - expected).length();
            assert!(error < 2e-3, "{point:?}: {error} px");
            let error = (natively.unwrap().as_dvec2() - expected).length();
            assert!(error < 2e-3, "on the processor, {point:?}: {error} px");
            // Finite differences in camera axes, in f64.
            const STEP: f64 = 1e-5;
            let world_from_camera = camera.camera_from_world.rotation.inverse();
            let natively = constants.projection_jacobian(in_camera);
            for ((axis, column), natively) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().zip(jacobian).zip(natively) {
                let step = world_from_camera * axis * STEP;
                let (Some(plus), Some(minus)) = (camera.project(world + step), camera.project(world - step)) else {
                    continue;
                };
                let numeric = (plus - minus) / (2.0 * STEP);
                let error = (DVec2::new(column[0].into(), column[1].into()) - numeric).length();
                assert!(error < 1e-3 * (1.0 + numeric.length()), "{point:?} {axis}: {error}");
                let error = (natively.as_dvec2() - numeric).length();
                assert!(error < 1e-3 * (1.0 + numeric.length()), "on the processor, {point:?} {axis}: {error}");
            }
        }
        assert!(compared > 300, "{compared}");
    }
}

#[test]
fn unknown_adapter_names_the_ones_there_are() {
    let error = GpuContext::new(&AdapterChoice::Named("no such card".to_owned())).unwrap_err().to_string();
    assert!(error.starts_with("no graphics adapter has 'no such card' in its name; there are: "), "{error}");
}

#[test]
fn a_buffer_beyond_the_adapter_is_refused_by_name() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let error = StorageBuffer::<[f32; 4]>::zeroed(&gpu, "a million images", usize::MAX / 64).unwrap_err();
    assert!(error.to_string().starts_with("a million images needs "), "{error}");
}
