//! The backward rasteriser: the f64 reference against finite differences, the GPU against the reference.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::{
    BackwardRasterizer, Carry, GaussianGradients, ImageGradients, RasterSettings, Rasterizer, RenderTarget,
};
use flyrig_types::{Camera, Lens};
use glam::DVec3;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::random_scene::{LENSES, poison, random_camera, random_scene, scaled, straight};
use support::reference::{Scene, splat_at, vec3};
use support::reference_backward::{Incoming, Outgoing, backward, lift, linear_loss, touched};
use support::upload;

fn random_incoming(rng: &mut StdRng, pixels: usize) -> Incoming {
    let mut four = |_| [(); 4].map(|()| rng.random_range(-1.0f32..1.0));
    Incoming { color: (0..pixels).map(&mut four).collect(), depth_carry: (0..pixels).map(&mut four).collect() }
}

struct Gpu<'a> {
    gpu: &'a GpuContext,
    forward: Rasterizer,
    backward: BackwardRasterizer,
}

impl<'a> Gpu<'a> {
    fn new(gpu: &'a GpuContext) -> Self {
        let forward = Rasterizer::new(gpu, 16).unwrap();
        let backward = BackwardRasterizer::new(gpu).unwrap();
        Self { gpu, forward, backward }
    }

    /// Centres with weights, and carried sums, over one or more views.
    fn run(
        &mut self,
        scene: &Scene,
        views: &[(&Camera, &Incoming)],
        settings: &RasterSettings,
        carry: Carry,
    ) -> (Vec<[f32; 4]>, Vec<[f32; 4]>) {
        let gpu = self.gpu;
        let gaussians = upload(gpu, scene).unwrap();
        let out = GaussianGradients::zeroed(gpu, scene.center_scale.len()).unwrap();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        out.clear(&mut encoder);
        for (camera, incoming) in views {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let target = RenderTarget::new(gpu, width, height).unwrap();
            let gradients = ImageGradients::zeroed(gpu, width, height).unwrap();
            gradients.color.write(gpu, &incoming.color);
            gradients.depth_carry.write(gpu, &incoming.depth_carry);
            self.forward.encode(gpu, &mut encoder, &gaussians, camera, settings, &target).unwrap();
            self.backward
                .encode(gpu, &mut encoder, &self.forward, &gaussians, &target, (&gradients, carry), &out)
                .unwrap();
        }
        gpu.queue.submit([encoder.finish()]);
        (out.center.read(gpu).unwrap(), out.carried.read(gpu).unwrap())
    }
}

/// Relative errors in the 2-norm over all Gaussians: centres, carried sums.
fn errors((center, carried): &(Vec<[f32; 4]>, Vec<[f32; 4]>), expected: &Outgoing) -> (f64, f64) {
    let (mut off, mut all, mut carried_off, mut carried_all) = (0.0, 0.0, 0.0, 0.0);
    for (i, want) in expected.center.iter().enumerate() {
        off += (vec3(center[i]) - *want).length_squared();
        all += want.length_squared();
        let sums = DVec3::from(expected.carried[i]).extend(expected.weight[i]);
        let ours = vec3(carried[2 * i]).extend(center[i][3].into());
        carried_off += (ours - sums).length_squared();
        carried_all += sums.length_squared();
    }
    let relative = |off: f64, all: f64| if off == 0.0 { 0.0 } else { (off / all.max(1e-30)).sqrt() };
    (relative(off, all), relative(carried_off, carried_all))
}

/// Zeroes the gradients of pixels where rounding decides.
fn only_clear(incoming: &mut Incoming, unclear: &[bool]) -> usize {
    for (at, _) in unclear.iter().enumerate().filter(|(_, unclear)| **unclear) {
        incoming.color[at] = [0.0; 4];
        incoming.depth_carry[at] = [0.0; 4];
    }
    unclear.iter().filter(|unclear| **unclear).count()
}

#[test]
fn the_reference_agrees_with_finite_differences() {
    let mut rng = StdRng::seed_from_u64(1);
    let mut worst = 0.0f64;
    for round in 0..60 {
        let (width, height) = (rng.random_range(1..24), rng.random_range(1..24));
        let camera = random_camera(&mut rng, LENSES[round % LENSES.len()], width, height);
        let count = rng.random_range(1..30);
        let scene = random_scene(&mut rng, count);
        let settings = RasterSettings { cull_backfacing: false, ..Default::default() };
        let lists = touched(&scene, &camera, &settings, (width, height));
        let incoming = random_incoming(&mut rng, (width * height) as usize);
        let out = backward(&scene, &camera, &settings, width, &lists, &incoming);
        // Along a random direction in the space of all centres.
        let directions: Vec<DVec3> =
            (0..count).map(|_| DVec3::from([(); 3].map(|()| rng.random_range(-1.0..1.0)))).collect();
        let loss = |h: f64| {
            let moved: Option<Vec<_>> = lists
                .splats
                .iter()
                .map(|s| {
                    let center = vec3(scene.center_scale[s.index]) + directions[s.index] * h;
                    splat_at(&scene, &camera, &settings, s.index, center)
                })
                .collect();
            moved.map(|moved| linear_loss(&scene, &lists, &moved, &incoming, width))
        };
        let pair = |h: f64| Some((loss(h)? - loss(-h)?) / (2.0 * h));
        // A splat may vanish on the way: then there is no difference to take.
        let (Some(wide), Some(narrow)) = (pair(2e-5), pair(1e-5)) else { continue };
        let difference = (4.0 * narrow - wide) / 3.0;
        let slope: f64 = out.center.iter().zip(&directions).map(|(g, d)| g.dot(*d)).sum();
        let scale: f64 = out.center.iter().zip(&directions).map(|(g, d)| g.dot(*d).abs()).sum();
        worst = worst.max((difference - slope).abs() / scale.max(1e-6));
    }
    println!("reference against finite differences: worst relative error {worst:.1e}");
    assert!(worst < 1e-4, "{worst}");
}

#[test]
fn random_scenes_agree_with_the_reference() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(2);
        let mut device = Gpu::new(gpu);
        let (mut center_errors, mut carried_errors) = (Vec::new(), Vec::new());
        let (mut unclear, mut pixels, mut worst) = (0, 0, (0.0, String::new()));
        for round in 0..1200 {
            let (width, height) = (rng.random_range(1..33), rng.random_range(1..33));
            let camera = random_camera(&mut rng, LENSES[round % LENSES.len()], width, height);
            let count = rng.random_range(1..80);
            let mut scene = random_scene(&mut rng, count);
            if round % 5 == 4 {
                poison(&mut rng, &mut scene);
            }
            let settings = RasterSettings { cull_backfacing: round % 2 == 0, ..Default::default() };
            let lists = touched(&scene, &camera, &settings, (width, height));
            let mut incoming = random_incoming(&mut rng, (width * height) as usize);
            unclear += only_clear(&mut incoming, &lists.unclear);
            pixels += lists.unclear.len();
            let expected = backward(&scene, &camera, &settings, width, &lists, &incoming);
            let ours = device.run(&scene, &[(&camera, &incoming)], &settings, Carry::Sum);
            assert!(ours.0.as_flattened().iter().chain(ours.1.as_flattened()).all(|v| v.is_finite()));
            let (center, carried) = errors(&ours, &expected);
            if center > worst.0 {
                worst = (center, format!("scene {round}: {width}x{height}, {count} Gaussians, lens {}", round % 4));
            }
            center_errors.push(center);
            carried_errors.push(carried);
        }
        center_errors.sort_by(f64::total_cmp);
        carried_errors.sort_by(f64::total_cmp);
        let at = |list: &[f64], share: f64| list[((list.len() - 1) as f64 * share) as usize];
        println!(
            "{} scenes on {}, {:.2} % of the pixels left out as undecided\ncentres: median {:.1e}, 99 % {:.1e}, worst {:.1e} \
         ({})\ncolours: median {:.1e}, worst {:.1e}",
            center_errors.len(),
            gpu.adapter_name(),
            unclear as f64 / pixels as f64 * 100.0,
            at(&center_errors, 0.5),
            at(&center_errors, 0.99),
            worst.0,
            worst.1,
            at(&carried_errors, 0.5),
            at(&carried_errors, 1.0)
        );
        assert!(at(&center_errors, 1.0) <= 1e-3 && at(&center_errors, 0.5) <= 1e-5);
        assert!(at(&carried_errors, 1.0) <= 1e-3 && at(&carried_errors, 0.5) <= 1e-5);
    });
}

#[test]
fn hard_cases_agree_with_the_reference_and_stay_finite() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(3);
        let mut device = Gpu::new(gpu);
        let settings = RasterSettings { cull_backfacing: false, ..Default::default() };
        let mut check = |name: &str, scene: &Scene, camera: &Camera, poisoned_pixels: bool| {
            let size = (camera.intrinsics.width, camera.intrinsics.height);
            let lists = touched(scene, camera, &settings, size);
            let mut incoming = random_incoming(&mut rng, (size.0 * size.1) as usize);
            only_clear(&mut incoming, &lists.unclear);
            if poisoned_pixels {
                for at in (0..incoming.color.len()).step_by(3) {
                    incoming.color[at][at % 4] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][at / 3 % 3];
                    incoming.depth_carry[at / 2][at % 4] = f32::NAN;
                }
            }
            let expected = backward(scene, camera, &settings, size.0, &lists, &incoming);
            let ours = device.run(scene, &[(camera, &incoming)], &settings, Carry::Sum);
            assert!(ours.0.as_flattened().iter().chain(ours.1.as_flattened()).all(|v| v.is_finite()), "{name}");
            let (center, carried) = errors(&ours, &expected);
            println!("{name:34} centres {center:.1e} colours {carried:.1e}");
            assert!(center < 1e-3 && carried < 1e-3, "{name}: {center} {carried}");
        };
        let mut rng = StdRng::seed_from_u64(4);
        let camera = straight(Lens::PINHOLE, 37, 29);
        let scene = random_scene(&mut rng, 200);
        check("no Gaussians", &Scene::default(), &camera, false);
        check("one pixel", &scene, &straight(Lens::PINHOLE, 1, 1), false);
        check("one row", &scene, &straight(Lens::PINHOLE, 90, 1), false);
        check("poisoned pixels", &scene, &camera, true);
        let mut other = scene.clone();
        poison(&mut rng, &mut other);
        check("poisoned Gaussians", &other, &camera, false);
        let mut other = scene.clone();
        other.center_scale.iter_mut().for_each(|c| c[3] = 0.0);
        check("zero scale", &other, &camera, false);
        let mut other = scene.clone();
        other.center_scale.iter_mut().for_each(|c| *c = [0.1, -0.05, 0.3, 0.08]);
        check("coincident", &other, &camera, false);
        other.color.iter_mut().for_each(|c| c[3] = 1.0);
        check("coincident and opaque", &other, &camera, false);
        let mut other = scene.clone();
        for (i, c) in other.center_scale.iter_mut().enumerate() {
            c[2] = [-2.0, -2.1, 0.5, -5.0, f32::NAN, -1.94][i % 6];
        }
        check("on and behind the camera plane", &other, &camera, false);
        let mut other = scene.clone();
        other.center_scale[7] = [0.0, 0.0, 0.0, 300.0];
        other.color[7][3] = 0.5;
        check("a Gaussian 1e4 px wide", &other, &camera, false);
        other.center_scale.iter_mut().for_each(|c| c[3] = 300.0);
        check("every Gaussian 1e4 px wide", &other, &camera, false);
        // The nearest is opaque: clamped in every pixel. The next one ends it.
        for (i, (c, color)) in other.center_scale.iter_mut().zip(&mut other.color).enumerate() {
            c[2] = 0.002 * i as f32;
            color[3] = [1.0, 0.995][i % 2];
        }
        other.color[1][3] = 0.6;
        check("every Gaussian wide and clamped", &other, &camera, false);
        let mut other = scene.clone();
        other.color.iter_mut().zip(0..).for_each(|(c, i)| c[3] = [0.985, 0.99, 0.995, 1.0][i % 4]);
        other.center_scale.iter_mut().for_each(|c| c[3] = 0.15);
        check("opacities about the clamp", &other, &camera, false);
    });
}

#[test]
fn from_millimetres_to_kilometres_slopes_and_matrices_agree_with_the_reference() {
    on_both(|gpu| {
        let mut device = Gpu::new(gpu);
        for unit in [1e-6, 1e-3, 1.0, 1e3, 1e6] {
            let mut rng = StdRng::seed_from_u64(8);
            let mut worst = [0.0f64; 3];
            for round in 0..8 {
                let camera = random_camera(&mut rng, LENSES[round % LENSES.len()], 31, 23);
                let (scene, camera, settings) = scaled(&random_scene(&mut rng, 60), &camera, unit);
                let lists = touched(&scene, &camera, &settings, (31, 23));
                let mut incoming = random_incoming(&mut rng, 31 * 23);
                // The loss's slope by depth belongs to the unit as well.
                incoming.depth_carry.iter_mut().for_each(|d| d[0] /= unit as f32);
                only_clear(&mut incoming, &lists.unclear);
                let expected = backward(&scene, &camera, &settings, 31, &lists, &incoming);
                let (center, carried) =
                    errors(&device.run(&scene, &[(&camera, &incoming)], &settings, Carry::Sum), &expected);
                let (_, lifted) = device.run(&scene, &[(&camera, &incoming)], &settings, Carry::Lift);
                let (mut off, mut all) = (0.0, 0.0);
                for s in &lists.splats {
                    let want = lift(&scene, &camera, &settings, s, expected.carried[s.index]);
                    for (ours, want) in lifted[2 * s.index..2 * s.index + 2].as_flattened().iter().zip(want) {
                        off += (f64::from(*ours) - want).powi(2);
                        all += want * want;
                    }
                }
                assert!(lists.splats.len() > 10 && all > 0.0, "something is seen");
                let errors = [center, carried, (off / all).sqrt()];
                worst.iter_mut().zip(errors).for_each(|(worst, error)| *worst = worst.max(error));
            }
            println!(
                "unit {unit:.0e} m: centres {:.1e}, colours {:.1e}, matrices {:.1e}",
                worst[0], worst[1], worst[2]
            );
            assert!(worst.iter().all(|error| *error < 1e-4), "{unit}: {worst:?}");
        }
    });
}

#[test]
fn two_runs_give_the_same_bytes_and_views_add_up() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(5);
        let scene = random_scene(&mut rng, 3000);
        let cameras = LENSES.map(|lens| random_camera(&mut rng, lens, 120, 90));
        let incoming = random_incoming(&mut rng, 120 * 90);
        let settings = RasterSettings::default();
        let views: Vec<_> = cameras.iter().map(|camera| (camera, &incoming)).collect();
        for carry in [Carry::Sum, Carry::Lift] {
            let first = Gpu::new(gpu).run(&scene, &views, &settings, carry);
            let mut device = Gpu::new(gpu);
            assert!(device.run(&scene, &views, &settings, carry) == first);
            assert!(device.run(&scene, &views, &settings, carry) == first);
            let mut sum = vec![[0.0f32; 4]; scene.center_scale.len()];
            for view in &views {
                let one = device.run(&scene, &[*view], &settings, carry).0;
                sum.iter_mut().zip(&one).for_each(|(sum, one)| sum.iter_mut().zip(one).for_each(|(s, o)| *s += o));
            }
            assert!(sum == first.0 && sum.iter().any(|v| v[0] != 0.0));
        }
    });
}

#[test]
fn nothing_happens_where_no_gradient_comes_in() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(6);
        let scene = random_scene(&mut rng, 500);
        let camera = random_camera(&mut rng, LENSES[1], 64, 64);
        let settings = RasterSettings { cull_backfacing: false, ..Default::default() };
        let mut device = Gpu::new(gpu);
        let full = random_incoming(&mut rng, 64 * 64);
        let mut one = Incoming { color: vec![[0.0; 4]; 64 * 64], depth_carry: vec![[0.0; 4]; 64 * 64] };
        let nothing = device.run(&scene, &[(&camera, &one)], &settings, Carry::Sum);
        assert!(nothing.0.as_flattened().iter().chain(nothing.1.as_flattened()).all(|&v| v == 0.0));
        // Stale sums of the full run must not be read again.
        device.run(&scene, &[(&camera, &full)], &settings, Carry::Sum);
        one.color[30 * 64 + 30] = [1.0, -1.0, 0.5, 0.3];
        let lists = touched(&scene, &camera, &settings, (64, 64));
        let expected = backward(&scene, &camera, &settings, 64, &lists, &one);
        let (center, _) = errors(&device.run(&scene, &[(&camera, &one)], &settings, Carry::Sum), &expected);
        assert!(center < 1e-3, "{center}");
    });
}

#[test]
fn lifted_matrices_are_those_of_the_projection() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(7);
        let scene = random_scene(&mut rng, 60);
        let camera = random_camera(&mut rng, LENSES[1], 30, 20);
        let settings = RasterSettings { cull_backfacing: false, ..Default::default() };
        let lists = touched(&scene, &camera, &settings, (30, 20));
        let mut incoming = random_incoming(&mut rng, 600);
        only_clear(&mut incoming, &lists.unclear);
        let expected = backward(&scene, &camera, &settings, 30, &lists, &incoming);
        let (_, lifted) = Gpu::new(gpu).run(&scene, &[(&camera, &incoming)], &settings, Carry::Lift);
        for s in &lists.splats {
            let want = lift(&scene, &camera, &settings, s, expected.carried[s.index]);
            let ours = lifted[2 * s.index..2 * s.index + 2].as_flattened();
            let size = want.iter().map(|v| v.abs()).fold(1e-3, f64::max);
            for (ours, want) in ours.iter().zip(want) {
                assert!((f64::from(*ours) - want).abs() < 1e-4 * size, "{ours} {want}");
            }
        }
    });
}
