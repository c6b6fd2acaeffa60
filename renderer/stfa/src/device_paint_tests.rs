//! The two ways through the networks give the same colours.

use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
use flyrig_learn::{burn_tensor::Device, to_vec};
use flyrig_renderer::{AppearanceSettings, Observations};
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

use super::*;
use crate::{LearnedAppearance, NetworkSize, crops::ViewImage};

const SIZES: [[u32; 2]; 3] = [[61, 90], [48, 64], [50, 40]];

fn body() -> BodyGraph {
    let template = default_template(&ShapeParams::default()).unwrap();
    let surface = sample_surface(&template, 3000, 1).unwrap();
    BodyGraph::new(&surface, &build_graph(&template, &surface, 200, DEFAULT_SIGMA2_M2).unwrap()).unwrap()
}

/// Networks whose last layer is not zero.
fn networks(size: NetworkSize) -> Parameters {
    let mut parameters = Parameters::untrained(size, 3);
    let mut rng = SmallRng::seed_from_u64(4);
    for parameter in parameters.by_name.values_mut() {
        parameter.values.iter_mut().for_each(|value| *value += rng.random_range(-0.1..0.1));
    }
    parameters
}

fn pictures(rng: &mut SmallRng) -> Vec<Vec<u8>> {
    let picture = |&[width, height]: &[u32; 2]| -> Vec<u8> {
        let (x0, y0) = (rng.random_range(0..width / 4), rng.random_range(0..height / 4));
        (0..width * height)
            .flat_map(|i| {
                let inside = i % width >= x0 && i / width >= y0 && i % width < width - 5;
                let mask = if inside { rng.random_range(100..=255) } else { 0u8 };
                [rng.random(), rng.random(), rng.random(), mask]
            })
            .collect()
    };
    SIZES.iter().map(picture).collect()
}

fn observed(body: &BodyGraph, rng: &mut SmallRng) -> Observations {
    let mut out = Observations::default();
    let color = |rng: &mut SmallRng| -> [f32; 4] { std::array::from_fn(|_| rng.random_range(0.0..1.0)) };
    for [width, height] in SIZES {
        let kept = (0..body.gaussians()).map(|_| {
            let [x, y] = [rng.random_range(-2.0..width as f32), rng.random_range(-2.0..height as f32)];
            let weight = rng.random_range(-0.5f32..0.9).max(0.0);
            if weight > 0.0 { [x, y, weight, rng.random_range(0.0..1.0)] } else { [0.0; 4] }
        });
        out.views.push(kept.collect());
    }
    for gaussian in 0..body.gaussians() {
        let weights: f32 = out.views.iter().map(|view| view[gaussian][2]).sum();
        let [r, g, b, near] = color(rng);
        out.seen.push([r * weights, g * weights, b * weights, weights]);
        out.quality.push([weights, near]);
    }
    out.node_seen = (0..body.nodes()).map(|_| color(rng)).collect();
    out.node_color = (0..body.nodes()).map(|_| color(rng)).collect();
    out
}

fn poisoned(mut observed: Observations) -> Observations {
    for (i, value) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY].into_iter().enumerate() {
        for column in 0..4 {
            observed.views[i][10 + column][column] = value;
            observed.seen[20 + 4 * i + column][column] = value;
            observed.node_seen[4 * i + column][column] = value;
            observed.node_color[4 * i + column][column] = value;
        }
        observed.quality[40 + i] = [value, 0.5];
        observed.quality[50 + i] = [0.5, value];
    }
    observed
}

/// Six frames of both on a device; the fourth is poisoned, the fifth is blind, before the sixth they forget.
fn compare(device: &Device, size: NetworkSize, settings: &AppearanceSettings, bound: f32) {
    let (body, parameters) = (body(), networks(size));
    let mut rng = SmallRng::seed_from_u64(5);
    let mut plain = LearnedAppearance::new(&parameters, body.clone());
    let mut painter = DevicePainter::new(&parameters, &body, device);
    for frame in 0..6 {
        if frame == 5 {
            plain.reset();
            painter.reset();
        }
        let pictures = pictures(&mut rng);
        let mut seen = observed(&body, &mut rng);
        if frame == 3 {
            seen = poisoned(seen);
        }
        let count = if frame == 4 { 0 } else { SIZES.len() };
        seen.views.truncate(count);
        let pictures = views(&pictures);
        let views = &pictures[..count];
        let expected = plain.paint(&seen, views, settings).unwrap();
        let crops = Crops::cut(views).unwrap();
        let found = to_vec(painter.paint(&ObservedTensors::upload(&seen, device), &crops, settings).unwrap());
        assert!(found.iter().all(|v| (0.0..=1.0).contains(v)), "frame {frame}");
        let worst = expected.as_flattened().iter().zip(&found).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < bound, "{size:?}, frame {frame}: {worst}");
        let apart = expected.iter().zip(&expected[1..]).any(|(a, b)| (a[0] - b[0]).abs() > 0.1);
        assert!(apart, "a flat image tells nothing");
    }
}

#[test]
fn tensors_paint_what_the_processor_paints() {
    let device = Device::flex();
    let settings = AppearanceSettings::default();
    for size in [NetworkSize::TINY, NetworkSize::SMALL] {
        compare(&device, size, &settings, 2e-5);
    }
    for (space, time) in [(true, false), (false, false), (false, true)] {
        compare(&device, NetworkSize::TINY, &AppearanceSettings { space, time, ..settings }, 2e-5);
    }
}

fn views(pictures: &[Vec<u8>]) -> Vec<ViewImage<'_>> {
    pictures.iter().zip(&SIZES).map(|(rgba, &[width, height])| ViewImage { width, height, rgba }).collect()
}

#[test]
fn what_did_not_change_is_kept() {
    let (body, mut rng) = (body(), SmallRng::seed_from_u64(6));
    let settings = AppearanceSettings { time: false, ..AppearanceSettings::default() };
    let (mut pictures, seen) = (pictures(&mut rng), observed(&body, &mut rng));
    let mut kept = LearnedAppearance::new(&networks(NetworkSize::TINY), body.clone());
    kept.reuse = 1e-6;
    let first = kept.paint(&seen, &views(&pictures), &settings).unwrap();
    assert_eq!((kept.counts.views_kept, kept.counts.colors_kept), (0, 0));
    assert_eq!(kept.paint(&seen, &views(&pictures), &settings).unwrap(), first);
    assert_eq!((kept.counts.views_kept, kept.counts.colors_kept), (3, body.gaussians() as u64));
    // Another image: its features are made again, and the colours of all who see it.
    let middle = pictures[1].len() / 2;
    pictures[1][middle - 2000..middle + 2000].iter_mut().for_each(|value| *value = 255 - *value / 2);
    let changed = kept.paint(&seen, &views(&pictures), &settings).unwrap();
    assert_eq!(kept.counts.views_kept, 5);
    let mut fresh = LearnedAppearance::new(&networks(NetworkSize::TINY), body.clone());
    let expected = fresh.paint(&seen, &views(&pictures), &settings).unwrap();
    let worst = |a: &[[f32; 4]], b: &[[f32; 4]]| {
        a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    assert!(worst(&changed, &expected) < 1e-4 && worst(&changed, &first) > 1e-3);
    // One image fewer, and masks that are believed otherwise: nothing of before may be used.
    let mut fewer = seen.clone();
    fewer.views.truncate(2);
    kept.paint(&fewer, &views(&pictures)[..2], &settings).unwrap();
    kept.paint(&fewer, &views(&pictures)[..2], &AppearanceSettings { min_mask: 0.2, ..settings }).unwrap();
    assert_eq!(kept.counts.views_kept, 5);
}

#[test]
fn frames_that_do_not_fit_are_refused() {
    let (body, device) = (body(), Device::flex());
    let mut painter = DevicePainter::new(&networks(NetworkSize::TINY), &body, &device);
    let seen = observed(&body, &mut SmallRng::seed_from_u64(1));
    let error =
        painter.paint(&ObservedTensors::upload(&seen, &device), &Crops::default(), &AppearanceSettings::default());
    assert!(error.unwrap_err().to_string().contains("3 views, 0 images"));
}

#[cfg(feature = "wgpu")]
#[test]
fn the_graphics_device_paints_the_same() {
    let gpu = flyrig_gpu::GpuContext::new(&flyrig_gpu::AdapterChoice::Best).unwrap();
    let device = crate::shared::registered(&gpu).unwrap();
    compare(&device, NetworkSize::TINY, &AppearanceSettings::default(), 1e-3);
}
