//! Times the rasteriser on the built-in body and prints the error beside every time.
//!
//! `cargo bench -p flyrig-renderer --bench raster -- [PICTURE_FOLDER]`

#[path = "../tests/support/mod.rs"]
mod support;

use std::error::Error;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use flyrig_gpu::{AdapterChoice, GpuContext, GpuTimer};
use flyrig_renderer::{Outputs, RasterSettings, Rasterizer, RenderTarget};
use flyrig_types::Camera;
use support::body_scene::{body, camera, save_png};
use support::reference::{Picture, Scene, render as reference};
use support::{Difference, Pictures, upload};

const RUNS: usize = 15;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args().skip(1).find(|argument| argument != "--bench").map(PathBuf::from);
    let device = GpuContext::new(&AdapterChoice::Best)?;
    let processor = device.on_processor();
    let commit = Command::new("git").args(["rev-parse", "--short", "HEAD"]).output().ok();
    let commit = commit.map(|out| String::from_utf8_lossy(&out.stdout).trim().to_owned()).unwrap_or_default();
    println!(
        "{} and {}, commit {}",
        device.adapter_name(),
        processor.adapter_name(),
        if commit.is_empty() { "unknown" } else { &commit }
    );
    println!("times: median of {RUNS} runs, milliseconds; errors: linear colour and alpha over the body's pixels\n");
    println!(
        "{:>9} {:>9} {:>7} {:>5} {:>6} | {:>6} {:>7} {:>6} {:>6} {:>7} | {:>7} {:>6} | {:>17} | {:>24}",
        "kernels",
        "image",
        "count",
        "cull",
        "output",
        "proj.",
        "sort",
        "lists",
        "blend",
        "total",
        "visible",
        "pairs",
        "own f64 max mean",
        "full f64 max mean >1/255"
    );
    let full_scene = body(115_000)?;
    let scenes = [115_000, 57_000, 29_000].map(|count| (count, body(count)));
    for (name, width, height) in [("512x512", 512, 512), ("1920x1080", 1920, 1080)] {
        let camera = camera(&full_scene, width, height, 0.5);
        let all = RasterSettings { cull_backfacing: false, ..Default::default() };
        let full = reference(&full_scene, &camera, &all, width, height);
        for (count, scene) in &scenes {
            let scene = scene.as_ref().map_err(ToString::to_string)?;
            for (cull, outputs, output) in [
                (true, Outputs::COLOR, "color"),
                (true, Outputs::ALL, "all"),
                (false, Outputs::COLOR, "color"),
                (false, Outputs::ALL, "all"),
            ] {
                let settings = RasterSettings { cull_backfacing: cull, outputs, ..Default::default() };
                let own = reference(scene, &camera, &settings, width, height);
                for gpu in [&device, &processor] {
                    let kernels = if gpu.is_on_processor() { "processor" } else { "adapter" };
                    let run = measure(gpu, scene, &camera, &settings)?;
                    let (max, mean, _) = body_error(&run.pictures, &own);
                    let (full_max, full_mean, seen) = body_error(&run.pictures, &full);
                    let [project, sort, lists, blend] = run.stages;
                    println!(
                        "{kernels:>9} {name:>9} {count:>7} {cull:>5} {output:>6} | {project:6.2} {sort:7.2} {lists:6.2} {blend:6.2} {:7.2} | \
                     {:>7} {:>6} | {max:8.1e} {mean:8.1e} | {full_max:8.1e} {full_mean:8.1e} {:5.2}%",
                        run.total,
                        run.visible,
                        run.pairs,
                        seen * 100.0
                    );
                    if let (Some(folder), "all") = (&folder, output) {
                        std::fs::create_dir_all(folder)?;
                        let file = format!("{name}-{count}-{}.png", if cull { "culled" } else { "uncut" });
                        save_png(&folder.join(file), &run.pictures.color, width, height)?;
                    }
                }
            }
        }
    }
    Ok(())
}

struct Run {
    stages: [f64; 4],
    total: f64,
    visible: u32,
    pairs: u32,
    pictures: Pictures,
}

fn measure(gpu: &GpuContext, scene: &Scene, camera: &Camera, settings: &RasterSettings) -> Result<Run, Box<dyn Error>> {
    let size = (camera.intrinsics.width, camera.intrinsics.height);
    let gaussians = upload(gpu, scene)?;
    let mut rasterizer = Rasterizer::new(gpu, scene.center_scale.len())?;
    let target = RenderTarget::new(gpu, size.0, size.1)?;
    // The processor's clock measures its kernels as a whole.
    let mut timer = (!gpu.is_on_processor()).then(|| GpuTimer::new(gpu, 4));
    let mut totals = Vec::new();
    let mut stages = [const { Vec::new() }; 4];
    for run in 0..RUNS + 2 {
        let begin = Instant::now();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        rasterizer.encode_timed(gpu, &mut encoder, &gaussians, (camera, settings), &target, timer.as_mut())?;
        if let Some(timer) = &mut timer {
            timer.resolve(&mut encoder);
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
        let total = begin.elapsed();
        let times: Vec<Duration> = match (&mut timer, rasterizer.processor_times()) {
            (Some(timer), _) => timer.collect(gpu)?.iter().map(|stage| stage.time).collect(),
            (None, times) => times.map_or_else(Vec::new, Vec::from),
        };
        if run >= 2 {
            totals.push(total);
            for (list, stage) in stages.iter_mut().zip(times) {
                list.push(stage);
            }
        }
    }
    let stats = rasterizer.stats(gpu)?;
    let pictures = Pictures {
        color: target.color.read(gpu)?,
        depth: target.depth.read(gpu)?,
        canonical: target.canonical.read(gpu)?,
    };
    Ok(Run {
        stages: stages.map(median),
        total: median(totals),
        visible: stats.visible_gaussians,
        pairs: stats.pairs,
        pictures,
    })
}

fn median(mut times: Vec<Duration>) -> f64 {
    times.sort();
    times.get(times.len() / 2).map_or(f64::NAN, |t| t.as_secs_f64() * 1e3)
}

/// Largest and mean error of colour and alpha where either image shows the body, and the share of those
/// pixels that differ by more than 1/255.
fn body_error(ours: &Pictures, reference: &Picture) -> (f64, f64, f64) {
    let d = Difference::between(ours, reference);
    let seen = |i: &usize| ours.color[*i][3] > 0.0 || reference.color[*i][3] > 0.0;
    let share = (0..ours.color.len()).filter(seen).count().max(1) as f64 / ours.color.len().max(1) as f64;
    (d.color_max, d.color_mean / share, d.color_visible / share)
}
