//! Derivatives by normals and plane depths of anisotropic Gaussians, together with those by colour: the kernels against differences of an
//! f64 reference.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::{
    AnisotropicGradients, BackwardRasterizer, HarmonicOrder, ImageGradients, Outputs, RasterSettings, Rasterizer,
    RenderTarget,
};
use flyrig_types::{Camera, Lens};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::anisotropic::{ATTRIBUTES, Ellipsoids, errors, poison, random_ellipsoids, upload};
use support::anisotropic_run::summary;
use support::planes::{Drawn, PlaneIncoming, run};
use support::random_scene::{LENSES, random_camera, straight};

const SETTINGS: RasterSettings = RasterSettings {
    near_m: 0.05,
    cull_backfacing: false,
    outputs: Outputs { depth: true, ..Outputs::PLANES },
    filter_variance_px2: 0.1,
    filter_keeps_opacity: false,
    area: None,
};

struct Kernels<'a> {
    gpu: &'a GpuContext,
    forward: Rasterizer,
    backward: BackwardRasterizer,
}

impl<'a> Kernels<'a> {
    fn new(gpu: &'a GpuContext) -> Self {
        Self { gpu, forward: Rasterizer::new(gpu, 16).unwrap(), backward: BackwardRasterizer::new(gpu).unwrap() }
    }

    fn run(&mut self, scene: &Ellipsoids, camera: &Camera, by: &PlaneIncoming) -> [Vec<[f32; 4]>; 4] {
        // Depths of the centres do not count where planes do.
        let incoming = by.with_depths(&mut StdRng::seed_from_u64(1));
        let kernels = (&mut self.forward, &mut self.backward);
        run(self.gpu, kernels, scene, camera, &SETTINGS, (&incoming, Some(&by.planes))).unwrap()
    }

    /// Errors of the derivatives of a scene; `poison_pixels` replaces numbers of every third pixel.
    fn errors(&mut self, rng: &mut StdRng, scene: &Ellipsoids, camera: &Camera, poison_pixels: bool) -> [f64; 5] {
        let mut scene = scene.clone();
        scene.clear_of_clamp(camera);
        // Above 1 and at 1 an opacity has no two-sided difference.
        scene.scale_opacity.iter_mut().for_each(|s| s[3] = s[3].min(0.999));
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let drawn = Drawn::new(&scene, camera, &SETTINGS, size);
        let mut by = PlaneIncoming::random(rng, &drawn.touched.unclear);
        if poison_pixels {
            for at in (0..by.color.len()).step_by(3) {
                by.planes[at][at % 4] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][at / 3 % 3];
                by.color[at / 2][at % 4] = f32::NAN;
            }
        }
        let expected = drawn.slopes(&scene, camera, &SETTINGS, &by);
        let found = self.run(&scene, camera, &by);
        assert!(found.iter().flatten().flatten().all(|v| v.is_finite()), "not finite");
        errors(&found, &expected)
    }
}

#[test]
fn random_scenes_agree_with_differences() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(2);
        let mut kernels = Kernels::new(gpu);
        let rounds = 120;
        let mut found = Vec::new();
        for round in 0..rounds {
            let (width, height) = (rng.random_range(1..25), rng.random_range(1..25));
            let camera = random_camera(&mut rng, LENSES[round % LENSES.len()], width, height);
            let count = rng.random_range(1..40);
            let mut scene = random_ellipsoids(&mut rng, count, HarmonicOrder::ALL[round % 3]);
            if round % 7 == 6 {
                poison(&mut rng, &mut scene);
            }
            found.push(kernels.errors(&mut rng, &scene, &camera, false));
        }
        println!("{rounds} scenes on {}", gpu.adapter_name());
        for (name, [median, high, worst]) in ATTRIBUTES.iter().zip(summary(&found)) {
            println!("{name:10} median {median:.1e}, 99 % {high:.1e}, worst {worst:.1e}");
            assert!(worst <= 1e-3 && median <= 2e-5, "{name}");
        }
    });
}

/// Changes Gaussian number so and so.
type Change<'a> = &'a dyn Fn(usize, &mut Ellipsoids);

#[test]
fn hard_cases_agree_with_differences_and_stay_finite() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(3);
        let mut kernels = Kernels::new(gpu);
        let camera = straight(Lens::PINHOLE, 31, 23);
        let scene = random_ellipsoids(&mut rng, 60, HarmonicOrder::One);
        let mut check = |name: &str, scene: &Ellipsoids, camera: &Camera, poison_pixels: bool| {
            let errors = kernels.errors(&mut StdRng::seed_from_u64(4), scene, camera, poison_pixels);
            println!("{name:30} {}", errors.map(|e| format!("{e:.1e}")).join(" "));
            assert!(errors.iter().all(|e| *e < 1e-3), "{name}: {errors:?}");
        };
        check("no Gaussians", &random_ellipsoids(&mut rng, 0, HarmonicOrder::One), &camera, false);
        check("one pixel", &scene, &straight(Lens::PINHOLE, 1, 1), false);
        check("one row", &scene, &straight(Lens::PINHOLE, 90, 1), false);
        check("poisoned pixels", &scene, &camera, true);
        let mut poisoned = scene.clone();
        poison(&mut rng, &mut poisoned);
        check("poisoned Gaussians", &poisoned, &camera, false);
        let changed = |change: Change<'_>| {
            let mut other = scene.clone();
            (0..other.count()).for_each(|i| change(i, &mut other));
            other
        };
        let cases: [(&str, Change<'_>); 10] = [
            ("zero scales", &|i, s| s.scale_opacity[i][i % 3] = 0.0),
            ("zero quaternions", &|i, s| s.rotation[i] = [0.0; 4]),
            ("very short quaternions", &|i, s| s.rotation[i] = s.rotation[i].map(|v| v * 1e-9)),
            ("zero opacities", &|i, s| s.scale_opacity[i][3] = 0.0),
            ("behind the camera", &|i, s| s.center[i][2] = [-5.0, 0.5][i % 2]),
            ("in one place", &|i, s| s.center[i] = [0.1, -0.05, 0.3, 0.0]),
            ("needles", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.3, 0.002, 0.001])),
            ("discs", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.1, 0.07, 1e-4])),
            ("equal scales", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.1; 3])),
            ("three wide ones among others", &|i, s| {
                if i % 20 == 7 {
                    s.scale_opacity[i] = [300.0, 5.0, 1.0, 0.3];
                }
            }),
        ];
        for (name, change) in cases {
            check(name, &changed(change), &camera, false);
        }
    });
}

#[test]
fn degenerate_planes_have_finite_derivatives() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(5);
        let camera = straight(Lens::PINHOLE, 40, 30);
        let clear = vec![false; 40 * 30];
        for (name, rotation, scale) in [
            ("equal scales", [0.0, 0.0, 0.0, 1.0], [0.1; 3]),
            ("edge-on", [0.0, 0.5f32.sqrt(), 0.0, 0.5f32.sqrt()], [0.1, 0.1, 0.01]),
            ("tiny", [0.3, 0.1, -0.2, 1.0], [0.1, 0.1, 1e-20]),
            ("as deep as its distance", [0.3, 0.1, -0.2, 1.0], [9.0, 9.0, 0.1]),
        ] {
            let mut scene = random_ellipsoids(&mut rng, 50, HarmonicOrder::Zero);
            scene.rotation.fill(rotation);
            scene.scale_opacity.iter_mut().for_each(|s| s[..3].copy_from_slice(&scale));
            let found = Kernels::new(gpu).run(&scene, &camera, &PlaneIncoming::random(&mut rng, &clear));
            assert!(found.iter().flatten().flatten().all(|v| v.is_finite()), "{name}");
            assert!(name == "tiny" || found[0].iter().any(|v| v[0] != 0.0), "{name}: something is seen");
        }
    });
}

#[test]
fn without_plane_gradients_the_derivatives_keep_their_bytes() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(6);
        let scene = random_ellipsoids(&mut rng, 900, HarmonicOrder::One);
        let camera = random_camera(&mut rng, LENSES[1], 100, 70);
        let by = PlaneIncoming::random(&mut rng, &vec![false; 100 * 70]);
        let incoming = by.with_depths(&mut rng);
        let run_as = |outputs: Outputs, planes: Option<&[[f32; 4]]>| {
            let mut kernels = Kernels::new(gpu);
            let settings = RasterSettings { outputs, ..SETTINGS };
            let pair = (&mut kernels.forward, &mut kernels.backward);
            run(gpu, pair, &scene, &camera, &settings, (&incoming, planes)).unwrap()
        };
        for depth in [false, true] {
            let plain = run_as(Outputs { depth, ..Outputs::COLOR }, None);
            assert!(plain == run_as(Outputs { depth, ..Outputs::PLANES }, None), "no dL/d planes");
            assert!(plain == run_as(Outputs { depth, ..Outputs::COLOR }, Some(&by.planes)), "no planes drawn");
        }
        let plain = run_as(Outputs::COLOR, None);
        let zero = run_as(Outputs::PLANES, Some(&vec![[0.0; 4]; 100 * 70]));
        for (a, b) in plain.iter().zip(&zero) {
            let size = a.iter().flatten().map(|v| v.abs()).fold(0.0, f32::max);
            assert!(a.iter().flatten().zip(b.iter().flatten()).all(|(a, b)| (a - b).abs() <= 1e-5 * size));
        }
    });
}

#[test]
fn equal_input_gives_equal_bytes_and_kinds_take_turns() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(7);
        let scene = random_ellipsoids(&mut rng, 900, HarmonicOrder::One);
        let camera = random_camera(&mut rng, LENSES[1], 100, 70);
        let by = PlaneIncoming::random(&mut rng, &vec![false; 100 * 70]);
        let mut kernels = Kernels::new(gpu);
        let first = kernels.run(&scene, &camera, &by);
        let incoming = by.with_depths(&mut rng);
        let pair = (&mut kernels.forward, &mut kernels.backward);
        run(gpu, pair, &scene, &camera, &SETTINGS, (&incoming, None)).unwrap();
        assert!(kernels.run(&scene, &camera, &by) == first && Kernels::new(gpu).run(&scene, &camera, &by) == first);
    });
}

#[test]
fn after_the_first_image_no_gpu_object_is_made() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(9);
        let scene = upload(gpu, &random_ellipsoids(&mut rng, 300, HarmonicOrder::Two)).unwrap();
        let camera = random_camera(&mut rng, LENSES[1], 64, 48);
        let mut kernels = Kernels::new(gpu);
        let target = RenderTarget::new(gpu, 64, 48).unwrap().with_planes(gpu).unwrap();
        let gradients = ImageGradients::zeroed(gpu, 64, 48).unwrap().with_planes(gpu).unwrap();
        let by = PlaneIncoming::random(&mut rng, &vec![false; 64 * 48]);
        gradients.planes.iter().for_each(|image| image.write(gpu, &by.planes));
        let out = AnisotropicGradients::zeroed(gpu, 300, HarmonicOrder::Two).unwrap();
        let mut image = || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let Kernels { forward, backward, .. } = &mut kernels;
            forward.encode(gpu, &mut encoder, &scene, &camera, &SETTINGS, &target).unwrap();
            backward.encode_anisotropic(gpu, &mut encoder, forward, &scene, &target, &gradients, &out).unwrap();
            gpu.queue.submit([encoder.finish()]);
            gpu.wait().unwrap();
            gpu.objects()
        };
        let first = image();
        assert_eq!([image(), image()], [first; 2]);
    });
}
