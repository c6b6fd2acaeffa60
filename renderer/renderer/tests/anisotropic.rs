//! Anisotropic Gaussians in images: against the f64 reference, and against isotropic ones of the same shape.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::{Gaussians, HarmonicOrder, RasterSettings, Rasterizer, RenderTarget};
use flyrig_types::{Camera, Lens};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::anisotropic::{Ellipsoids, from_isotropic, poison, random_ellipsoids, upload};
use support::random_scene::{LENSES, random_camera, random_scene, straight};
use support::{Difference, Pictures};

/// As in `raster.rs`.
const MAX_ERROR: f64 = 1.0 / 255.0 + 1e-3;
const MEAN_ERROR: f64 = 2e-5;

fn render<'a>(
    gpu: &GpuContext,
    rasterizer: &mut Rasterizer,
    gaussians: impl Into<Gaussians<'a>>,
    camera: &Camera,
    settings: &RasterSettings,
) -> Pictures {
    let target = RenderTarget::new(gpu, camera.intrinsics.width, camera.intrinsics.height).unwrap();
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    rasterizer.encode(gpu, &mut encoder, gaussians, camera, settings, &target).unwrap();
    gpu.queue.submit([encoder.finish()]);
    Pictures {
        color: target.color.read(gpu).unwrap(),
        depth: target.depth.read(gpu).unwrap(),
        canonical: target.canonical.read(gpu).unwrap(),
    }
}

fn check(gpu: &GpuContext, name: &str, rasterizer: &mut Rasterizer, scene: &Ellipsoids, camera: &Camera) -> f64 {
    check_with(&RasterSettings::default(), gpu, name, rasterizer, scene, camera)
}

fn check_with(
    settings: &RasterSettings,
    gpu: &GpuContext,
    name: &str,
    rasterizer: &mut Rasterizer,
    scene: &Ellipsoids,
    camera: &Camera,
) -> f64 {
    let ours = render(gpu, rasterizer, &upload(gpu, scene).unwrap(), camera, settings);
    assert!(ours.is_finite(), "{name}: not finite");
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let expected = scene.render(camera, settings, width, height);
    let d = Difference::between(&ours, &expected);
    println!(
        "{name:44} max {:.1e} mean {:.1e} | depth max {:.1e} | mean alpha {:.2}",
        d.color_max,
        d.color_mean,
        d.depth_max,
        expected.color.iter().map(|c| c[3]).sum::<f64>() / expected.color.len() as f64,
    );
    // Colours reach 4, depths 4 m.
    assert!(d.color_max < 4.0 * MAX_ERROR && d.color_mean < 4.0 * MEAN_ERROR, "{name}: {d:?}");
    assert!(d.depth_max < 4.0 * MAX_ERROR && d.depth_mean < 4.0 * MEAN_ERROR, "{name}: {d:?}");
    assert!(ours.canonical.as_flattened().iter().all(|v| *v == 0.0), "{name}: canonical positions are not drawn");
    d.color_mean
}

#[test]
fn random_scenes_agree_with_the_reference_for_every_lens_and_order() {
    on_both(|gpu| {
        let mut rasterizer = Rasterizer::new(gpu, 16).unwrap();
        let mut rng = StdRng::seed_from_u64(1);
        let (mut mean, mut scenes) = (0.0, 0.0);
        for order in HarmonicOrder::ALL {
            for (l, lens) in LENSES.into_iter().enumerate() {
                for poisoned in [false, true] {
                    let count = rng.random_range(1..900);
                    let mut scene = random_ellipsoids(&mut rng, count, order);
                    if poisoned {
                        poison(&mut rng, &mut scene);
                    }
                    let (width, height) = (rng.random_range(1..140), rng.random_range(1..90));
                    let camera = random_camera(&mut rng, lens, width, height);
                    let state = if poisoned { "poisoned" } else { "" };
                    let name = format!("order {order:?} lens {l} {width}x{height} n {count} {state}");
                    mean += check(gpu, &name, &mut rasterizer, &scene, &camera);
                    scenes += 1.0;
                }
            }
        }
        println!("{scenes} scenes on {}: mean error {:.2e}", gpu.adapter_name(), mean / scenes);
    });
}

#[test]
fn the_classic_filter_agrees_with_the_reference() {
    on_both(|gpu| {
        let settings = RasterSettings::default().with_classic_filter();
        let mut rasterizer = Rasterizer::new(gpu, 16).unwrap();
        let mut rng = StdRng::seed_from_u64(7);
        for (round, lens) in LENSES.into_iter().enumerate() {
            let mut scene = random_ellipsoids(&mut rng, 400, HarmonicOrder::ALL[round % 3]);
            // Far below a pixel, where the filter decides on the opacity.
            scene.scale_opacity.iter_mut().step_by(2).for_each(|s| (0..3).for_each(|k| s[k] *= 0.01));
            if round % 2 == 1 {
                poison(&mut rng, &mut scene);
            }
            let camera = random_camera(&mut rng, lens, 90, 70);
            check_with(&settings, gpu, &format!("classic {round}"), &mut rasterizer, &scene, &camera);
        }
        // A Gaussian below a pixel keeps its opacity, which Mip-Splatting's filter spreads.
        let mut one = random_ellipsoids(&mut rng, 1, HarmonicOrder::Zero);
        one.center[0] = [0.0; 4];
        one.scale_opacity[0] = [1e-4, 1e-4, 1e-4, 0.9];
        let camera = straight(Lens::PINHOLE, 9, 9);
        let mut alpha = |settings: &RasterSettings| -> f32 {
            let image = render(gpu, &mut rasterizer, &upload(gpu, &one).unwrap(), &camera, settings);
            image.color.iter().map(|color| color[3]).sum()
        };
        let (classic, mip) = (alpha(&settings), alpha(&RasterSettings::default()));
        let integral = 0.9 * 2.0 * std::f32::consts::PI * 0.3;
        assert!((classic - integral).abs() < 0.2 && mip < 0.1, "{classic} {mip}");
    });
}

#[test]
fn hard_cases_agree_with_the_reference() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(2);
        let mut rasterizer = Rasterizer::new(gpu, 0).unwrap();
        let camera = straight(Lens::PINHOLE, 70, 50);
        let mut check = |name: &str, scene: &Ellipsoids, camera: &Camera| {
            check(gpu, name, &mut rasterizer, scene, camera);
        };
        let scene = random_ellipsoids(&mut rng, 300, HarmonicOrder::Two);
        check("empty scene", &random_ellipsoids(&mut rng, 0, HarmonicOrder::Two), &camera);
        check("one pixel", &scene, &straight(Lens::PINHOLE, 1, 1));
        check("one row", &scene, &straight(Lens::PINHOLE, 301, 1));
        let changed = |change: &dyn Fn(usize, &mut Ellipsoids)| {
            let mut other = scene.clone();
            (0..other.count()).for_each(|i| change(i, &mut other));
            other
        };
        check("zero scales", &changed(&|i, s| s.scale_opacity[i][i % 3] = 0.0), &camera);
        check("zero quaternions", &changed(&|i, s| s.rotation[i] = [0.0; 4]), &camera);
        check("quaternions that are no numbers", &changed(&|i, s| s.rotation[i][i % 4] = f32::NAN), &camera);
        check("very short quaternions", &changed(&|i, s| s.rotation[i] = s.rotation[i].map(|v| v * 1e-12)), &camera);
        check("very long quaternions", &changed(&|i, s| s.rotation[i] = s.rotation[i].map(|v| v * 1e12)), &camera);
        check("zero opacities", &changed(&|i, s| s.scale_opacity[i][3] = 0.0), &camera);
        check("opacities above 1", &changed(&|i, s| s.scale_opacity[i][3] = 1.5), &camera);
        check("behind the camera", &changed(&|i, s| s.center[i][2] = -5.0), &camera);
        check("on the camera's plane", &changed(&|i, s| s.center[i][2] = [-2.0, -2.1, -1.951][i % 3]), &camera);
        check("in one place", &changed(&|i, s| s.center[i] = [0.1, -0.05, 0.3, 0.0]), &camera);
        check("needles", &changed(&|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.3, 0.002, 0.002])), &camera);
        check("discs", &changed(&|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.1, 0.1, 1e-6])), &camera);
        check("a wall", &changed(&|i, s| s.scale_opacity[i] = [300.0, 300.0, 300.0, 0.3]), &camera);
        check("black", &changed(&|i, s| s.harmonics_of(i).fill([0.0; 4])), &camera);
        check("below black", &changed(&|i, s| s.harmonics_of(i)[0] = [-9.0; 4]), &camera);
        check("one colour that is no number", &changed(&|i, s| s.harmonics_of(i)[8][2] = f32::NAN), &camera);
    });
}

#[test]
fn equal_scales_give_the_image_of_isotropic_gaussians() {
    on_both(|gpu| {
        let mut rasterizer = Rasterizer::new(gpu, 16).unwrap();
        let mut rng = StdRng::seed_from_u64(3);
        for lens in LENSES {
            let isotropic = random_scene(&mut rng, 800);
            let camera = random_camera(&mut rng, lens, 120, 90);
            let settings = RasterSettings { cull_backfacing: false, ..Default::default() };
            let buffers = support::upload(gpu, &isotropic).unwrap();
            let expected = render(gpu, &mut rasterizer, &buffers, &camera, &settings);
            let ellipsoids = upload(gpu, &from_isotropic(&mut rng, &isotropic)).unwrap();
            let ours = render(gpu, &mut rasterizer, &ellipsoids, &camera, &settings);
            let off = |f: &dyn Fn(usize) -> f32| (0..ours.color.len()).map(f).fold(0.0f32, f32::max);
            let color = off(&|i| (0..4).map(|c| (ours.color[i][c] - expected.color[i][c]).abs()).fold(0.0, f32::max));
            let depth = off(&|i| (ours.depth[i] - expected.depth[i]).abs() * expected.color[i][3]);
            let differ = |i: &usize| (0..4).any(|c| (ours.color[*i][c] - expected.color[*i][c]).abs() > 1e-5);
            let share = (0..ours.color.len()).filter(differ).count() as f64 / ours.color.len() as f64;
            println!(
                "{lens:?}: colour {color:.1e}, depth {depth:.1e}, {:.2} % of the pixels above 1e-5",
                share * 100.0
            );
            // At the cut rounding decides whether a splat counts in a pixel.
            assert!(f64::from(color) < MAX_ERROR && f64::from(depth) < 4.0 * MAX_ERROR && share < 0.005, "{lens:?}");
        }
    });
}

#[test]
fn two_runs_give_the_same_bytes_and_kinds_take_turns() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(4);
        let scene = upload(gpu, &random_ellipsoids(&mut rng, 3000, HarmonicOrder::Two)).unwrap();
        let other = support::upload(gpu, &random_scene(&mut rng, 3000)).unwrap();
        let camera = random_camera(&mut rng, LENSES[1], 160, 120);
        let settings = RasterSettings::default();
        let mut rasterizer = Rasterizer::new(gpu, 1).unwrap();
        let first = render(gpu, &mut rasterizer, &scene, &camera, &settings);
        let isotropic = render(gpu, &mut rasterizer, &other, &camera, &settings);
        let mut fresh = Rasterizer::new(gpu, 3000).unwrap();
        assert!(render(gpu, &mut fresh, &other, &camera, &settings) == isotropic);
        assert!(render(gpu, &mut fresh, &scene, &camera, &settings) == first);
        assert!(render(gpu, &mut rasterizer, &scene, &camera, &settings) == first);
        assert!(first.color.iter().any(|c| c[3] > 0.5), "something is seen");
    });
}
