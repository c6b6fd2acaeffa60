//! The rasteriser against the f64 reference, over random and poisoned scenes.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::{Outputs, RasterSettings, Rasterizer, RenderTarget};
use flyrig_types::{Camera, Lens};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::random_scene::{LENSES, poison, random_camera, random_scene, scaled, straight};
use support::reference::{self, Scene};
use support::{Difference, render, upload};

/// A splat whose alpha is at the cut may be counted on one side and not on the other: 1/255 of light.
const MAX_ERROR: f64 = 1.0 / 255.0 + 1e-3;
/// Rounding alone.
const MEAN_ERROR: f64 = 2e-5;

fn check(
    gpu: &GpuContext,
    name: &str,
    rasterizer: &mut Rasterizer,
    scene: &Scene,
    camera: &Camera,
    settings: &RasterSettings,
) -> Difference {
    let size = (camera.intrinsics.width, camera.intrinsics.height);
    let gaussians = upload(gpu, scene).unwrap();
    let ours = render(gpu, rasterizer, &gaussians, camera, settings, size).unwrap();
    assert!(ours.is_finite(), "{name}: not finite");
    let expected = reference::render(scene, camera, settings, size.0, size.1);
    let d = Difference::between(&ours, &expected);
    println!(
        "{name:34} max {:.1e} mean {:.1e} | depth max {:.1e} | canonical max {:.1e} | mean alpha {:.2}",
        d.color_max,
        d.color_mean,
        d.depth_max,
        d.canonical_max,
        expected.color.iter().map(|c| c[3]).sum::<f64>() / expected.color.len() as f64,
    );
    assert!(d.color_max < MAX_ERROR && d.color_mean < MEAN_ERROR, "{name}: {d:?}");
    // Depths reach 4 m, canonical coordinates 1 m.
    assert!(d.depth_max < 4.0 * MAX_ERROR && d.depth_mean < 4.0 * MEAN_ERROR, "{name}: {d:?}");
    assert!(d.canonical_max < MAX_ERROR && d.canonical_mean < MEAN_ERROR, "{name}: {d:?}");
    assert_eq!(rasterizer.stats(gpu).unwrap().overflowed_images, 0);
    d
}

#[test]
fn random_scenes_agree_with_the_reference_for_every_lens() {
    on_both(|gpu| {
        let mut rasterizer = Rasterizer::new(gpu, 16).unwrap();
        let mut rng = StdRng::seed_from_u64(1);
        let (mut max, mut mean, mut scenes) = (0.0f64, 0.0, 0.0);
        for seed in 0..6 {
            for (l, lens) in LENSES.into_iter().enumerate() {
                for poisoned in [false, true] {
                    let count = rng.random_range(1..900);
                    let mut scene = random_scene(&mut rng, count);
                    if poisoned {
                        poison(&mut rng, &mut scene);
                    }
                    let (width, height) = (rng.random_range(1..140), rng.random_range(1..90));
                    let camera = random_camera(&mut rng, lens, width, height);
                    let settings = RasterSettings { cull_backfacing: seed % 2 == 0, ..Default::default() };
                    let settings = if seed % 3 == 2 { settings.with_classic_filter() } else { settings };
                    let name =
                        format!("lens {l} {width}x{height} n {count} {}", if poisoned { "poisoned" } else { "" });
                    let d = check(gpu, &name, &mut rasterizer, &scene, &camera, &settings);
                    max = max.max(d.color_max);
                    mean += d.color_mean;
                    scenes += 1.0;
                }
            }
        }
        println!("{scenes} scenes on {}: max error {max:.2e}, mean {:.2e}", gpu.adapter_name(), mean / scenes);
    });
}

#[test]
fn hard_cases_agree_with_the_reference() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(2);
        let mut rasterizer = Rasterizer::new(gpu, 0).unwrap();
        let settings = RasterSettings { cull_backfacing: false, ..Default::default() };
        let camera = straight(Lens::PINHOLE, 70, 50);
        let mut check = |name: &str, scene: &Scene, camera: &Camera| {
            check(gpu, name, &mut rasterizer, scene, camera, &settings);
        };
        check("empty scene", &Scene::default(), &camera);
        let scene = random_scene(&mut rng, 300);
        check("one pixel", &scene, &straight(Lens::PINHOLE, 1, 1));
        check("one row", &scene, &straight(Lens::PINHOLE, 301, 1));

        let mut flat = scene.clone();
        flat.center_scale.iter_mut().for_each(|c| c[2] = 0.5);
        check("all at one depth", &flat, &camera);

        let mut opaque = scene.clone();
        opaque.color.iter_mut().for_each(|c| c[3] = 1.0);
        check("all opaque", &opaque, &camera);
        opaque.color.iter_mut().for_each(|c| c[3] = 0.0);
        check("all transparent", &opaque, &camera);
        opaque.color.iter_mut().zip(0..).for_each(|(c, i)| c[3] = [0.985, 0.99, 0.995, 1.0][i % 4]);
        opaque.center_scale.iter_mut().for_each(|c| c[3] = 0.15);
        check("opacities about the clamp", &opaque, &camera);

        let mut one_place = scene.clone();
        one_place.center_scale.iter_mut().for_each(|c| *c = [0.1, -0.05, 0.3, 0.08]);
        check("coincident", &one_place, &camera);
        one_place.center_scale.iter_mut().for_each(|c| c[3] = 0.0);
        check("zero scale", &one_place, &camera);

        let mut plane = scene.clone();
        for (i, c) in plane.center_scale.iter_mut().enumerate() {
            c[2] = [-2.0, -2.1, 0.5, -5.0, f32::NAN, -1.951][i % 6];
        }
        check("on and behind the camera plane", &plane, &camera);

        // Standard deviation 60 m seen from 2 m: the image lies well inside.
        let mut wide = scene.clone();
        wide.center_scale[7] = [0.0, 0.0, 0.0, 300.0];
        check("a Gaussian 1e4 px wide", &wide, &camera);
        wide.center_scale.iter_mut().for_each(|c| c[3] = 300.0);
        check("every Gaussian 1e4 px wide", &wide, &camera);
    });
}

#[test]
fn from_millimetres_to_kilometres_the_images_agree_with_the_reference() {
    on_both(|gpu| {
        let mut rasterizer = Rasterizer::new(gpu, 300).unwrap();
        for unit in [1e-6, 1e-3, 1.0, 1e3, 1e6] {
            let mut rng = StdRng::seed_from_u64(6);
            let mut worst = Difference::default();
            for lens in LENSES {
                let camera = random_camera(&mut rng, lens, 64, 48);
                let (scene, camera, settings) = scaled(&random_scene(&mut rng, 300), &camera, unit);
                let gaussians = upload(gpu, &scene).unwrap();
                let ours = render(gpu, &mut rasterizer, &gaussians, &camera, &settings, (64, 48)).unwrap();
                let expected = reference::render(&scene, &camera, &settings, 64, 48);
                assert!(ours.color.iter().any(|c| c[3] > 0.5), "something is seen");
                let d = Difference::between(&ours, &expected);
                worst.color_max = worst.color_max.max(d.color_max);
                worst.color_mean = worst.color_mean.max(d.color_mean);
                worst.depth_mean = worst.depth_mean.max(d.depth_mean / unit);
                worst.canonical_mean = worst.canonical_mean.max(d.canonical_mean);
            }
            println!(
                "unit {unit:.0e} m: colour max {:.1e} mean {:.1e}, depth mean {:.1e} units, canonical mean {:.1e}",
                worst.color_max, worst.color_mean, worst.depth_mean, worst.canonical_mean
            );
            assert!(worst.color_max < MAX_ERROR && worst.color_mean < MEAN_ERROR, "{unit}: {worst:?}");
            assert!(worst.depth_mean < 4.0 * MEAN_ERROR && worst.canonical_mean < MEAN_ERROR, "{unit}: {worst:?}");
        }
        // The edge: what is farther than 1e9 m is not drawn.
        let camera = straight(Lens::PINHOLE, 64, 48);
        let (scene, camera, settings) = scaled(&random_scene(&mut StdRng::seed_from_u64(6), 300), &camera, 2e9);
        let gaussians = upload(gpu, &scene).unwrap();
        let ours = render(gpu, &mut rasterizer, &gaussians, &camera, &settings, (64, 48)).unwrap();
        assert!(ours.color.as_flattened().iter().all(|v| *v == 0.0));
    });
}

#[test]
fn two_runs_give_the_same_bytes_and_one_submission_may_hold_many_images() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(3);
        let scene = random_scene(&mut rng, 5000);
        let gaussians = upload(gpu, &scene).unwrap();
        let settings = RasterSettings::default();
        let size = (200, 120);
        let cameras: Vec<_> = LENSES.map(|lens| random_camera(&mut rng, lens, size.0, size.1)).into();
        let mut rasterizer = Rasterizer::new(gpu, 5000).unwrap();
        let targets: Vec<_> = cameras.iter().map(|_| RenderTarget::new(gpu, size.0, size.1).unwrap()).collect();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for (camera, target) in cameras.iter().zip(&targets) {
            rasterizer.encode(gpu, &mut encoder, &gaussians, camera, &settings, target).unwrap();
        }
        gpu.queue.submit([encoder.finish()]);
        let mut other = Rasterizer::new(gpu, 1).unwrap();
        for (camera, target) in cameras.iter().zip(&targets) {
            let again = render(gpu, &mut other, &gaussians, camera, &settings, size).unwrap();
            assert!(target.color.read(gpu).unwrap() == again.color, "{:?}", camera.intrinsics.lens);
            assert!(target.depth.read(gpu).unwrap() == again.depth);
            assert!(target.canonical.read(gpu).unwrap() == again.canonical);
            assert!(again.color.iter().any(|c| c[3] > 0.5), "something is seen");
        }
    });
}

#[test]
fn images_that_were_not_asked_for_keep_their_content_and_the_others_do_not_change() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(4);
        let scene = random_scene(&mut rng, 400);
        let gaussians = upload(gpu, &scene).unwrap();
        let camera = random_camera(&mut rng, LENSES[1], 90, 60);
        let mut rasterizer = Rasterizer::new(gpu, 400).unwrap();
        let all = render(gpu, &mut rasterizer, &gaussians, &camera, &RasterSettings::default(), (90, 60)).unwrap();
        let settings = RasterSettings { outputs: Outputs::COLOR, ..Default::default() };
        let color = render(gpu, &mut rasterizer, &gaussians, &camera, &settings, (90, 60)).unwrap();
        assert!(color.color == all.color);
        assert!(color.depth.iter().all(|&d| d == 0.0) && color.canonical.as_flattened().iter().all(|&c| c == 0.0));
    });
}

#[test]
fn when_the_room_for_pairs_is_spent_the_farthest_are_missing_and_it_is_told() {
    on_both(|gpu| {
        // 4000 Gaussians that each cover the whole image: more pairs than there is room for.
        let mut rng = StdRng::seed_from_u64(5);
        let count = 4000;
        let mut scene = random_scene(&mut rng, count);
        for (i, (c, color)) in scene.center_scale.iter_mut().zip(&mut scene.color).enumerate() {
            *c = [0.0, 0.0, i as f32 * 1e-3, 300.0];
            color[3] = 0.005;
        }
        let camera = straight(Lens::PINHOLE, 640, 480);
        let settings = RasterSettings { cull_backfacing: false, ..Default::default() };
        let gaussians = upload(gpu, &scene).unwrap();
        let mut rasterizer = Rasterizer::new(gpu, count).unwrap();
        let ours = render(gpu, &mut rasterizer, &gaussians, &camera, &settings, (640, 480)).unwrap();
        let stats = rasterizer.stats(gpu).unwrap();
        assert_eq!(stats.overflowed_images, 1);
        assert_eq!(stats.visible_gaussians, count as u32);
        assert!(ours.is_finite());
        // The nearest that fit, found from what is left in the middle of the image.
        let alpha = f64::from(ours.color[240 * 640 + 320][3]);
        let kept = ((1.0 - alpha).ln() / (1.0f64 - 0.005).ln()).round() as usize;
        assert!(kept > 10 && kept < count, "{kept}");
        let cut = |v: &[[f32; 4]]| v[..kept].to_vec();
        let nearest = Scene {
            center_scale: cut(&scene.center_scale),
            normal: cut(&scene.normal),
            color: cut(&scene.color),
            canonical: cut(&scene.canonical),
        };
        let d = Difference::between(&ours, &reference::render(&nearest, &camera, &settings, 640, 480));
        assert!(d.color_max < MAX_ERROR, "{kept} kept: {d:?}");
    });
}
