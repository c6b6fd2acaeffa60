//! Derivatives of anisotropic Gaussians: the f64 reference against finite differences, the kernels against the reference.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::{
    AnisotropicGradients, BackwardRasterizer, HarmonicOrder, ImageGradients, RasterSettings, Rasterizer, RenderTarget,
};
use flyrig_types::{Camera, Lens};
use glam::DVec3;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::anisotropic::{ATTRIBUTES, Ellipsoid, Ellipsoids, backward, errors, poison, random_ellipsoids, upload};
use support::anisotropic_run::{Kernels, random_incoming, random_round, summary};
use support::random_scene::{LENSES, random_camera, straight};
use support::reference_backward::{Incoming, linear_loss_of, touched_by};

const SETTINGS: RasterSettings = RasterSettings {
    near_m: 0.05,
    cull_backfacing: false,
    outputs: flyrig_renderer::Outputs::ALL,
    filter_variance_px2: 0.1,
    filter_keeps_opacity: false,
    area: None,
};

#[test]
fn the_reference_agrees_with_finite_differences() {
    let mut rng = StdRng::seed_from_u64(1);
    let mut worst = 0.0f64;
    for round in 0..90 {
        let settings = if round % 5 == 4 { SETTINGS.with_classic_filter() } else { SETTINGS };
        let (width, height) = (rng.random_range(1..24), rng.random_range(1..24));
        let camera = random_camera(&mut rng, LENSES[round % LENSES.len()], width, height);
        let count = rng.random_range(1..30);
        let mut scene = random_ellipsoids(&mut rng, count, HarmonicOrder::ALL[round % 3]);
        // Above 1 and at 1 an opacity has no two-sided difference.
        scene.scale_opacity.iter_mut().for_each(|s| s[3] = s[3].min(0.999));
        scene.clear_of_clamp(&camera);
        let touched = touched_by(scene.splats(&camera, &settings), (width, height));
        let incoming = random_incoming(&mut rng, (width * height) as usize);
        let out = backward(&scene, &camera, &settings, width, &touched, &incoming);
        // Along a random direction in the space of all numbers, each in its own unit.
        let mut directions: Vec<Ellipsoid> = (0..count).map(|i| scene.get(i).unwrap()).collect();
        for direction in &mut directions {
            let length = direction.rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
            direction.center = DVec3::ONE;
            direction.rotation = [length; 4];
            (0..Ellipsoid::SHAPE).for_each(|k| *direction.number(k) *= rng.random_range(-1.0..1.0));
            direction
                .harmonics
                .iter_mut()
                .for_each(|c| *c = DVec3::from([(); 3].map(|()| rng.random_range(-1.0..1.0))));
        }
        let loss = |h: f64| {
            let (mut splats, mut colors) = (Vec::new(), Vec::new());
            for s in &touched.splats {
                let mut moved = scene.get(s.index)?;
                let mut direction = directions[s.index].clone();
                (0..Ellipsoid::SHAPE).for_each(|k| *moved.number(k) += h * *direction.number(k));
                moved.harmonics.iter_mut().zip(&direction.harmonics).for_each(|(c, d)| *c += *d * h);
                splats.push(moved.splat(&camera, &settings, s.index)?);
                colors.push(moved.unclamped_color(&camera).max(DVec3::ZERO));
            }
            Some(linear_loss_of(&colors, &touched, &splats, &incoming, width))
        };
        let pair = |h: f64| Some((loss(h)? - loss(-h)?) / (2.0 * h));
        // A splat may vanish on the way: then there is no difference to take.
        let (Some(wide), Some(narrow)) = (pair(2e-5), pair(1e-5)) else { continue };
        let difference = (4.0 * narrow - wide) / 3.0;
        let (mut slope, mut scale) = (0.0, 0.0);
        for (i, direction) in directions.iter_mut().enumerate() {
            let mut add = |slopes: &[f64], first: usize| {
                for (k, by) in slopes.iter().enumerate() {
                    slope += by * *direction.number(first + k);
                    scale += (by * *direction.number(first + k)).abs();
                }
            };
            add(&out.center[i][..3], 0);
            add(&out.scale_opacity[i], 3);
            add(&out.rotation[i], 7);
            let coefficients = scene.order.coefficients();
            for (by, d) in out.harmonics[i * coefficients..].iter().zip(&direction.harmonics) {
                let by = DVec3::new(by[0], by[1], by[2]);
                slope += by.dot(*d);
                scale += (by * *d).abs().element_sum();
            }
        }
        worst = worst.max((difference - slope).abs() / scale.max(1e-6));
    }
    println!("reference against finite differences: worst relative error {worst:.1e}");
    assert!(worst < 1e-4, "{worst}");
}

#[test]
fn random_scenes_agree_with_the_reference() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(2);
        let mut kernels = Kernels::new(gpu).unwrap();
        let rounds = 1000;
        let found: Vec<[f64; 5]> =
            (0..rounds).map(|round| random_round(&mut rng, &mut kernels, round).unwrap()).collect();
        println!("{rounds} scenes on {}", gpu.adapter_name());
        for (name, [median, high, worst]) in ATTRIBUTES.iter().zip(summary(&found)) {
            println!("{name:10} median {median:.1e}, 99 % {high:.1e}, worst {worst:.1e}");
            assert!(worst <= 1e-3 && median <= 1e-5, "{name}");
        }
    });
}

/// Changes Gaussian number so and so.
type Change<'a> = &'a dyn Fn(usize, &mut Ellipsoids);

fn check(gpu: &GpuContext, name: &str, scene: &Ellipsoids, camera: &Camera, poisoned_pixels: bool) {
    let mut rng = StdRng::seed_from_u64(4);
    let mut scene = scene.clone();
    scene.clear_of_clamp(camera);
    let size = (camera.intrinsics.width, camera.intrinsics.height);
    let touched = touched_by(scene.splats(camera, &SETTINGS), size);
    let mut incoming = random_incoming(&mut rng, (size.0 * size.1) as usize);
    incoming.only_clear(&touched.unclear);
    if poisoned_pixels {
        for at in (0..incoming.color.len()).step_by(3) {
            incoming.color[at][at % 4] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][at / 3 % 3];
            incoming.depth_carry[at / 2][0] = f32::NAN;
        }
    }
    let expected = backward(&scene, camera, &SETTINGS, size.0, &touched, &incoming);
    let ours = Kernels::new(gpu).unwrap().run(&scene, &[(camera, &incoming)], &SETTINGS).unwrap();
    assert!(ours.iter().flatten().flatten().all(|v| v.is_finite()), "{name}: not finite");
    let errors = errors(&ours, &expected);
    println!("{name:34} {}", errors.map(|e| format!("{e:.1e}")).join(" "));
    assert!(errors.iter().all(|e| *e < 1e-3), "{name}: {errors:?}");
}

#[test]
fn hard_cases_agree_with_the_reference_and_stay_finite() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(3);
        let camera = straight(Lens::PINHOLE, 37, 29);
        let scene = random_ellipsoids(&mut rng, 200, HarmonicOrder::Two);
        println!("{:34} {}", "", ATTRIBUTES.join(", "));
        check(gpu, "no Gaussians", &random_ellipsoids(&mut rng, 0, HarmonicOrder::One), &camera, false);
        check(gpu, "one pixel", &scene, &straight(Lens::PINHOLE, 1, 1), false);
        check(gpu, "one row", &scene, &straight(Lens::PINHOLE, 90, 1), false);
        check(gpu, "poisoned pixels", &scene, &camera, true);
        let mut poisoned = scene.clone();
        poison(&mut rng, &mut poisoned);
        check(gpu, "poisoned Gaussians", &poisoned, &camera, false);
        let changed = |change: Change<'_>| {
            let mut other = scene.clone();
            (0..other.count()).for_each(|i| change(i, &mut other));
            other
        };
        let cases: [(&str, Change<'_>); 12] = [
            ("zero scales", &|i, s| s.scale_opacity[i][i % 3] = 0.0),
            ("zero quaternions", &|i, s| s.rotation[i] = [0.0; 4]),
            ("very short quaternions", &|i, s| s.rotation[i] = s.rotation[i].map(|v| v * 1e-9)),
            ("very long quaternions", &|i, s| s.rotation[i] = s.rotation[i].map(|v| v * 1e9)),
            ("zero opacities", &|i, s| s.scale_opacity[i][3] = 0.0),
            ("opacities about 1", &|i, s| s.scale_opacity[i][3] = [0.5, 1.0, 1.5, 0.97][i % 4]),
            ("behind the camera", &|i, s| s.center[i][2] = [-5.0, 0.5][i % 2]),
            ("in one place", &|i, s| s.center[i] = [0.1, -0.05, 0.3, 0.0]),
            ("needles", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.3, 0.002, 0.001])),
            ("discs", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.1, 0.07, 1e-6])),
            ("three wide ones among others", &|i, s| {
                if i % 70 == 7 {
                    s.scale_opacity[i] = [300.0, 5.0, 1.0, 0.3];
                }
            }),
            ("below black", &|i, s| s.harmonics_of(i)[0] = [-9.0; 4]),
        ];
        for (name, change) in cases {
            check(gpu, name, &changed(change), &camera, false);
        }
    });
}

#[test]
fn from_millimetres_to_kilometres_slopes_agree_with_the_reference() {
    on_both(|gpu| {
        let mut kernels = Kernels::new(gpu).unwrap();
        for unit in [1e-6, 1e-3, 1.0, 1e3, 1e6] {
            let mut rng = StdRng::seed_from_u64(8);
            let mut worst = [0.0f64; 5];
            for lens in LENSES {
                let mut camera = random_camera(&mut rng, lens, 31, 23);
                let mut scene = random_ellipsoids(&mut rng, 60, HarmonicOrder::Two);
                scene.center.as_flattened_mut().iter_mut().for_each(|v| *v *= unit as f32);
                scene.scale_opacity.iter_mut().for_each(|s| s[..3].iter_mut().for_each(|v| *v *= unit as f32));
                camera.camera_from_world.translation *= unit;
                let settings = RasterSettings { near_m: SETTINGS.near_m * unit as f32, ..SETTINGS };
                scene.clear_of_clamp(&camera);
                let touched = touched_by(scene.splats(&camera, &settings), (31, 23));
                let mut incoming = random_incoming(&mut rng, 31 * 23);
                // The loss's slope by depth belongs to the unit as well.
                incoming.depth_carry.iter_mut().for_each(|d| d[0] /= unit as f32);
                incoming.only_clear(&touched.unclear);
                let expected = backward(&scene, &camera, &settings, 31, &touched, &incoming);
                let ours = kernels.run(&scene, &[(&camera, &incoming)], &settings).unwrap();
                assert!(touched.splats.len() > 10, "something is seen");
                worst.iter_mut().zip(errors(&ours, &expected)).for_each(|(worst, error)| *worst = worst.max(error));
            }
            println!("unit {unit:.0e} m: {}", worst.map(|e| format!("{e:.1e}")).join(" "));
            assert!(worst.iter().all(|error| *error < 1e-3), "{unit}: {worst:?}");
        }
    });
}

#[test]
fn after_the_first_image_no_gpu_object_is_made() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(9);
        let scene = upload(gpu, &random_ellipsoids(&mut rng, 300, HarmonicOrder::Two)).unwrap();
        let camera = random_camera(&mut rng, LENSES[1], 64, 48);
        let (mut forward, mut back) = (Rasterizer::new(gpu, 1).unwrap(), BackwardRasterizer::new(gpu).unwrap());
        let target = RenderTarget::new(gpu, 64, 48).unwrap();
        let gradients = ImageGradients::zeroed(gpu, 64, 48).unwrap();
        gradients.color.write(gpu, &random_incoming(&mut rng, 64 * 48).color);
        let out = AnisotropicGradients::zeroed(gpu, 300, HarmonicOrder::Two).unwrap();
        let mut image = || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            forward.encode(gpu, &mut encoder, &scene, &camera, &SETTINGS, &target).unwrap();
            back.encode_anisotropic(gpu, &mut encoder, &forward, &scene, &target, &gradients, &out).unwrap();
            gpu.queue.submit([encoder.finish()]);
            gpu.wait().unwrap();
            gpu.objects()
        };
        let first = image();
        assert_eq!([image(), image()], [first; 2]);
    });
}

#[test]
fn two_runs_give_the_same_bytes_and_views_add_up() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(5);
        let scene = random_ellipsoids(&mut rng, 2000, HarmonicOrder::Two);
        let cameras = LENSES.map(|lens| random_camera(&mut rng, lens, 120, 90));
        let incoming = random_incoming(&mut rng, 120 * 90);
        let views: Vec<_> = cameras.iter().map(|camera| (camera, &incoming)).collect();
        let first = Kernels::new(gpu).unwrap().run(&scene, &views, &SETTINGS).unwrap();
        let mut kernels = Kernels::new(gpu).unwrap();
        assert!(kernels.run(&scene, &views, &SETTINGS).unwrap() == first);
        assert!(kernels.run(&scene, &views, &SETTINGS).unwrap() == first);
        assert!(first.iter().all(|attribute| attribute.iter().any(|v| v[0] != 0.0)), "something is seen");
        // In another order of the views only rounding differs.
        let turned: Vec<_> = views.iter().copied().rev().collect();
        let other = kernels.run(&scene, &turned, &SETTINGS).unwrap();
        for (a, b) in first.iter().zip(&other) {
            let size = a.iter().flatten().map(|v| v.abs()).fold(0.0, f32::max);
            assert!(a.iter().flatten().zip(b.iter().flatten()).all(|(a, b)| (a - b).abs() <= 1e-5 * size));
        }
    });
}

#[test]
fn nothing_happens_where_no_gradient_comes_in_or_the_kind_differs() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(6);
        let scene = random_ellipsoids(&mut rng, 500, HarmonicOrder::One);
        let camera = random_camera(&mut rng, LENSES[1], 64, 64);
        let mut kernels = Kernels::new(gpu).unwrap();
        let zeros = Incoming { color: vec![[0.0; 4]; 64 * 64], depth_carry: vec![[0.0; 4]; 64 * 64] };
        let nothing = kernels.run(&scene, &[(&camera, &zeros)], &SETTINGS).unwrap();
        assert!(nothing.iter().flatten().flatten().all(|v| *v == 0.0));
        let full = random_incoming(&mut rng, 64 * 64);
        let other = random_ellipsoids(&mut rng, 500, HarmonicOrder::Two);
        let nothing = kernels.run_other(&scene, &other, (&camera, &full), &SETTINGS).unwrap();
        assert!(nothing.iter().flatten().flatten().all(|v| *v == 0.0), "the image shows another order");
    });
}

#[test]
fn an_image_without_depth_has_the_slopes_of_its_colors() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(7);
        let scene = random_ellipsoids(&mut rng, 800, HarmonicOrder::One);
        let camera = random_camera(&mut rng, LENSES[0], 120, 90);
        let mut incoming = random_incoming(&mut rng, 120 * 90);
        let mut kernels = Kernels::new(gpu).unwrap();
        let settings = RasterSettings { outputs: flyrig_renderer::Outputs::COLOR, ..SETTINGS };
        let found = kernels.run(&scene, &[(&camera, &incoming)], &settings).unwrap();
        incoming.depth_carry.fill([0.0; 4]);
        let expected = kernels.run(&scene, &[(&camera, &incoming)], &SETTINGS).unwrap();
        for (a, b) in found.iter().zip(&expected) {
            let size = b.iter().flatten().map(|v| v.abs()).fold(0.0, f32::max);
            assert!(
                size > 0.0 && a.iter().flatten().zip(b.iter().flatten()).all(|(a, b)| (a - b).abs() <= 1e-5 * size)
            );
        }
    });
}
