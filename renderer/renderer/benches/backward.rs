//! Times the backward rasteriser beside the forward one on the built-in body, and prints the error beside the time.
//!
//! `cargo bench -p flyrig-renderer --bench backward`
//!
//! The loss is the squared difference of colour and alpha to the body moved by a smooth wave of 1 cm.

#[path = "../tests/support/mod.rs"]
mod support;

use std::error::Error;
use std::time::Instant;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_renderer::{
    BackwardRasterizer, Carry, GaussianGradients, ImageGradients, Outputs, RasterSettings, Rasterizer, RenderTarget,
};
use flyrig_types::Camera;
use glam::DVec3;
use support::body_scene::{body, camera};
use support::reference::{Picture, Scene, render, vec3};
use support::reference_backward::{Incoming, backward, touched};
use support::upload;

const RUNS: usize = 15;

fn main() -> Result<(), Box<dyn Error>> {
    let device = GpuContext::new(&AdapterChoice::Best)?;
    let processor = device.on_processor();
    println!(
        "{} and {}; milliseconds, median of {RUNS} alternating runs",
        device.adapter_name(),
        processor.adapter_name()
    );
    println!(
        "{:>9} {:>9} {:>7} {:>14} | {:>8} {:>8} {:>6} | {:>14} {:>20}",
        "kernels",
        "image",
        "count",
        "pixels with",
        "forward",
        "backward",
        "ratio",
        "error to f64",
        "slope of true loss"
    );
    for (count, size, every) in [
        (115_000, 512, 1),
        (57_000, 512, 1),
        (29_000, 512, 1),
        (115_000, 256, 1),
        (115_000, 1024, 1),
        (115_000, 512, 8),
        (115_000, 512, 0),
    ] {
        let scene = body(count)?;
        let view = camera(&scene, size, size, 0.5);
        let settings = RasterSettings { outputs: Outputs::COLOR, ..Default::default() };
        for gpu in [&device, &processor] {
            let kernels = if gpu.is_on_processor() { "processor" } else { "adapter" };
            let row = measure(gpu, &scene, &view, &settings, every)?;
            let name = match every {
                0 => "no gradient".to_owned(),
                1 => "all".to_owned(),
                n => format!("rows 1/{n}"),
            };
            println!(
                "{kernels:>9} {size:>4}x{size:<4} {count:>7} {name:>14} | {:8.2} {:8.2} {:6.2} | {:14.1e} {:>20}",
                row.forward,
                row.backward,
                row.backward / row.forward,
                row.error,
                row.slope.map_or(String::new(), |(analytic, real)| format!("{real:.4} of {analytic:.4}"))
            );
        }
    }
    Ok(())
}

struct Row {
    forward: f64,
    backward: f64,
    error: f64,
    /// Returns the slopes of the loss along the unit gradient: by the derivative, and by a finite step through all
    /// discontinuities.
    slope: Option<(f64, f64)>,
}

/// Bands of 64 rows carry a gradient, every `every`-th of them (0: none).
fn measure(
    gpu: &GpuContext,
    scene: &Scene,
    view: &Camera,
    settings: &RasterSettings,
    every: usize,
) -> Result<Row, Box<dyn Error>> {
    let (width, height) = (view.intrinsics.width, view.intrinsics.height);
    let mut moved = scene.clone();
    for c in &mut moved.center_scale {
        let wave = (DVec3::new(c[1].into(), c[2].into(), c[0].into()) * 9.0).to_array().map(f64::sin);
        c.iter_mut().zip(wave).for_each(|(c, w)| *c += 0.01 * w as f32);
    }
    let counts = |at: usize| every > 0 && (at / width as usize / 64).is_multiple_of(every);
    let wanted = render(&moved, view, settings, width, height);
    let drawn = render(scene, view, settings, width, height);
    let loss = |picture: &Picture| -> f64 {
        let pairs = picture.color.iter().zip(&wanted.color).enumerate().filter(|(at, _)| counts(*at));
        pairs.map(|(_, (a, b))| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>()).sum()
    };
    let slope_of = |at: usize| {
        if !counts(at) {
            return [0.0; 4];
        }
        std::array::from_fn(|i| 2.0 * (drawn.color[at][i] - wanted.color[at][i]) as f32)
    };
    let pixels = drawn.color.len();
    let lists = touched(scene, view, settings, (width, height));
    let mut incoming = Incoming { color: (0..pixels).map(slope_of).collect(), depth_carry: vec![[0.0; 4]; pixels] };
    let expected_all = backward(scene, view, settings, width, &lists, &incoming);
    for (at, _) in lists.unclear.iter().enumerate().filter(|(_, unclear)| **unclear) {
        incoming.color[at] = [0.0; 4];
    }
    let expected = backward(scene, view, settings, width, &lists, &incoming);

    let gaussians = upload(gpu, scene)?;
    let mut forward = Rasterizer::new(gpu, gaussians.count())?;
    let mut back = BackwardRasterizer::new(gpu)?;
    let target = RenderTarget::new(gpu, width, height)?;
    let gradients = ImageGradients::zeroed(gpu, width, height)?;
    gradients.color.write(gpu, &incoming.color);
    let out = GaussianGradients::zeroed(gpu, gaussians.count())?;
    let (mut forwards, mut backwards) = (Vec::new(), Vec::new());
    for run in 0..RUNS + 2 {
        let begin = Instant::now();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        forward.encode(gpu, &mut encoder, &gaussians, view, settings, &target)?;
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
        let middle = Instant::now();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        out.clear(&mut encoder);
        back.encode(gpu, &mut encoder, &forward, &gaussians, &target, (&gradients, Carry::Sum), &out)?;
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
        if run >= 2 {
            forwards.push((middle - begin).as_secs_f64() * 1e3);
            backwards.push(middle.elapsed().as_secs_f64() * 1e3);
        }
    }
    let ours = out.center.read(gpu)?;
    let size = |v: &mut dyn Iterator<Item = DVec3>| v.map(DVec3::length_squared).sum::<f64>().sqrt();
    let off = size(&mut ours.iter().zip(&expected.center).map(|(a, b)| vec3(*a) - *b));
    let all = size(&mut expected.center.iter().copied());
    let error = if off == 0.0 { 0.0 } else { off / all };

    // 0.2 mm for the one that moves most.
    let norm = size(&mut expected_all.center.iter().copied());
    let longest = expected_all.center.iter().map(|g| g.length()).fold(0.0, f64::max);
    let slope = (every == 1 && longest > 0.0).then(|| {
        let step = 2e-4 * norm / longest;
        let at = |sign: f64| {
            let mut other = scene.clone();
            for (c, g) in other.center_scale.iter_mut().zip(&expected_all.center) {
                let by = *g * (sign * step / norm);
                c.iter_mut().zip(by.to_array()).for_each(|(c, by)| *c += by as f32);
            }
            loss(&render(&other, view, settings, width, height))
        };
        (norm, (at(1.0) - at(-1.0)) / (2.0 * step))
    });
    Ok(Row { forward: median(forwards), backward: median(backwards), error, slope })
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied().unwrap_or(f64::NAN)
}
