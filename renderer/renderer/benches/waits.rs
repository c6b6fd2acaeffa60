//! Compares a frame that waits for the GPU after each stage with one that waits only when it reads the result back.
//!
//! `cargo bench -p flyrig-renderer --bench waits -- [GAUSSIANS] [SIDE]`

use std::error::Error;
use std::time::{Duration, Instant};

use flyrig_body::{DEFAULT_SIGMA2_M2, GpuSkinner, ShapeParams, build_graph, default_template, sample_surface};
use flyrig_gpu::{AdapterChoice, GpuContext, StageTimer, StorageBuffer};
use flyrig_renderer::{
    AppearanceSettings, DirectAppearance, GaussianBuffers, Outputs, RasterSettings, Rasterizer, RenderTarget,
    ViewInput, read_splats,
};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DVec2, DVec3};

const VIEWS: usize = 4;
const RUNS: usize = 41;
const STAGES: [&str; 3] = ["skinning", "visibility", "appearance"];

fn camera(azimuth: f64, side: u32) -> Camera {
    let middle = DVec3::new(0.0, 0.9, 0.0);
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: format!("{azimuth}").into(),
        intrinsics: Intrinsics {
            width: side,
            height: side,
            focal_px: DVec2::splat(1.2 * f64::from(side)),
            center_px: DVec2::splat(0.5 * f64::from(side) - 0.5),
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry::look_at(
            middle + DVec3::new(azimuth.sin(), 0.15, azimuth.cos()) * 3.0,
            middle,
            DVec3::Y,
        ),
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1).filter(|argument| argument != "--bench");
    let count: usize = arguments.next().map_or(Ok(57_000), |text| text.parse())?;
    let side: u32 = arguments.next().map_or(Ok(512), |text| text.parse())?;
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let template = default_template(&ShapeParams::default())?;
    let surface = sample_surface(&template, count, 1)?;
    let graph = build_graph(&template, &surface, 500, DEFAULT_SIGMA2_M2)?;
    let skinner = GpuSkinner::new(&gpu, &surface, &template.skeleton)?;
    let gaussians = GaussianBuffers::zeroed(&gpu, count)?;
    let canonical: Vec<_> = surface.positions.iter().map(|p| p.extend(1.0).to_array()).collect();
    gaussians.canonical.write(&gpu, &canonical);
    gaussians.color.write(&gpu, &vec![[0.5, 0.5, 0.5, 1.0]; count]);
    let mut rasterizer = Rasterizer::new(&gpu, count)?;
    let mut appearance = DirectAppearance::new(&gpu, &surface, &graph, VIEWS)?;
    let cameras: Vec<Camera> = (0..VIEWS).map(|i| camera(1.5 * i as f64, side)).collect();
    let targets = cameras.iter().map(|_| RenderTarget::new(&gpu, side, side)).collect::<Result<Vec<_>, _>>()?;
    let picture = StorageBuffer::from_slice(&gpu, "image", &vec![0xff40_80c0_u32; (side * side) as usize])?;
    let pose = template.skeleton.rest_pose();
    let settings = RasterSettings { outputs: Outputs::SURFACE, ..RasterSettings::default() };
    let mut timer = StageTimer::new(&gpu, STAGES.len() as u32);
    // Host times of the stages, with waits.
    let mut host = [const { Vec::new() }; STAGES.len()];

    let mut frame = |waits: bool, timer: &mut StageTimer| -> Result<Duration, Box<dyn Error>> {
        let start = Instant::now();
        let mut last = start;
        let mut ended = |stage: usize| -> Result<(), Box<dyn Error>> {
            if waits {
                gpu.wait()?;
                host[stage].push(last.elapsed());
                last = Instant::now();
            }
            Ok(())
        };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        timer.begin(&mut encoder);
        let (centers, normals) = (&gaussians.center_scale, &gaussians.normal);
        skinner.encode(&gpu, &mut encoder, &template.skeleton, &pose, None, centers, normals)?;
        timer.mark(&mut encoder, STAGES[0]);
        gpu.queue.submit([encoder.finish()]);
        ended(0)?;
        for (i, (camera, target)) in cameras.iter().zip(&targets).enumerate() {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            rasterizer.encode(&gpu, &mut encoder, &gaussians, camera, &settings, target)?;
            if i + 1 == VIEWS {
                timer.mark(&mut encoder, STAGES[1]);
            }
            gpu.queue.submit([encoder.finish()]);
        }
        ended(1)?;
        let mut inputs = Vec::new();
        for (camera, RenderTarget { canonical, color, .. }) in cameras.iter().zip(&targets) {
            inputs.push(ViewInput { camera, picture: &picture, canonical, rendered: color, gaussians: None });
        }
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        appearance.update(&gpu, &mut encoder, &gaussians, &inputs, &AppearanceSettings::default())?;
        timer.mark(&mut encoder, STAGES[2]);
        timer.finish(&mut encoder);
        gpu.queue.submit([encoder.finish()]);
        ended(2)?;
        read_splats(&gpu, &gaussians)?;
        Ok(start.elapsed())
    };

    let mut measured: Vec<(&str, Duration)> = Vec::new();
    let mut times = [Vec::new(), Vec::new()];
    for run in 0..RUNS + 3 {
        // Alternating, so that whatever else the machine does meets both.
        for (waits, times) in [true, false].into_iter().zip(&mut times) {
            let time = frame(waits, &mut timer)?;
            let stages = timer.collect();
            if run >= 3 {
                times.push(time);
                measured.extend(stages.into_iter().filter(|_| !waits).map(|stage| (stage.name, stage.time)));
            }
        }
    }
    let median = |times: &mut Vec<Duration>| {
        times.sort_unstable();
        times.get(times.len() / 2).map_or(0.0, |time| time.as_secs_f64() * 1e3)
    };
    println!("{}, {count} Gaussians, {VIEWS} views of {side}x{side}, median of {RUNS} frames", gpu.adapter_name());
    for (stage, host) in STAGES.iter().zip(&mut host) {
        let mut on_gpu: Vec<Duration> = measured.iter().filter(|(name, _)| name == stage).map(|(_, t)| *t).collect();
        println!("{stage:>12}: {:8.2} ms by waiting, {:8.2} ms by timestamps", median(host), median(&mut on_gpu));
    }
    let [with, without] = &mut times;
    let ratios: Vec<f64> = with.iter().zip(&*without).map(|(a, b)| a.as_secs_f64() / b.as_secs_f64()).collect();
    let (with, without) = (median(with), median(without));
    println!("   the frame: {with:.2} ms with waits, {without:.2} ms without: ratio {:.3}", with / without);
    let mut ratios = ratios;
    ratios.sort_by(f64::total_cmp);
    println!(
        "ratios of neighbouring frames: median {:.3}, middle half {:.3} to {:.3}",
        ratios[ratios.len() / 2],
        ratios[ratios.len() / 4],
        ratios[3 * ratios.len() / 4]
    );
    Ok(())
}
