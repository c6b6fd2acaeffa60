//! Time of direct appearance by stage and its error against the f64 reference, in every setting:
//! `cargo bench -p flyrig-renderer --bench appearance -- [GAUSSIANS] [NODES] [PIXELS]`

#[path = "../tests/appearance_support/mod.rs"]
mod appearance_support;

use std::{collections::BTreeMap, error::Error, time::Duration, time::Instant};

use appearance_support::{reference, scene};
use flyrig_gpu::{AdapterChoice, GpuContext, GpuTimer};
use flyrig_renderer::{AppearanceSettings, DiffusionHierarchy, DirectAppearance, GaussianBuffers};
use glam::DVec4;

const RUNS: u32 = 20;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments =
        std::env::args().skip(1).filter(|argument| argument != "--bench").map(|argument| argument.parse::<usize>());
    let mut next = |default: usize| arguments.next().unwrap_or(Ok(default));
    let (gaussians, nodes, size) = (next(115_000)?, next(1620)?, next(512)?);
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    println!("{}: {gaussians} Gaussians, {nodes} nodes, 3 views of {size}x{size}", gpu.adapter_name());

    let person = scene::person(gaussians, nodes);
    let frame = scene::frame(&person, 0.3);
    let started = Instant::now();
    let levels = DiffusionHierarchy::new(&person.graph)?.levels;
    let counts: Vec<_> = levels.iter().map(|level| level.edges.len()).collect();
    println!("levels {counts:?} in {:.1} ms", started.elapsed().as_secs_f64() * 1e3);
    let buffers = GaussianBuffers::zeroed(&gpu, gaussians)?;
    buffers.canonical.write(&gpu, &person.canonical);
    buffers.center_scale.write(&gpu, &frame.center_scale);
    buffers.normal.write(&gpu, &frame.normal);
    let views: Vec<_> = scene::ring(size as u32)
        .iter()
        .map(|camera| scene::view(&frame, camera, [255, 0, 255], scene::pattern))
        .collect();
    let maps = scene::upload(&gpu, &views)?;
    let inputs = scene::inputs(&views, &maps);

    let mut appearance = DirectAppearance::new(&gpu, &person.surface, &person.graph, 3)?;
    let mut timer = GpuTimer::new(&gpu, 4);
    println!("space time |    max error   mean error | median ms: whole call, GPU stages");
    for (space, time) in [(true, true), (true, false), (false, true), (false, false)] {
        let settings = AppearanceSettings { space, time, ..Default::default() };
        appearance.reset();
        let mut update = |timer: &mut GpuTimer| -> Result<(), Box<dyn Error>> {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            appearance.update_timed(&gpu, &mut encoder, &buffers, &inputs, &settings, Some(timer))?;
            timer.resolve(&mut encoder);
            gpu.queue.submit([encoder.finish()]);
            Ok(gpu.wait()?)
        };
        update(&mut timer)?;
        let ours = buffers.color.read(&gpu)?;
        let mut state = reference::State { memory: vec![DVec4::ZERO; gaussians], last: None };
        let expected = reference::update(&person, &levels, &frame, &views, &settings, &mut state);
        let errors: Vec<f64> = ours
            .iter()
            .zip(&expected)
            .map(|(a, b)| (DVec4::from_array(a.map(f64::from)).truncate() - *b).abs().max_element())
            .collect();
        let (max, mean) = (errors.iter().copied().fold(0.0, f64::max), errors.iter().sum::<f64>() / gaussians as f64);
        timer.collect(&gpu)?;

        let mut calls = Vec::new();
        let mut stages: BTreeMap<&str, Vec<Duration>> = BTreeMap::new();
        for _ in 0..RUNS {
            let started = Instant::now();
            update(&mut timer)?;
            calls.push(started.elapsed());
            for stage in timer.collect(&gpu)? {
                stages.entry(stage.name).or_default().push(stage.time);
            }
        }
        print!("{space:5} {time:4} | {max:12.2e} {mean:12.2e} | {:8.2}", median_ms(&mut calls));
        for (name, times) in &mut stages {
            print!("   {name} {:.2}", median_ms(times));
        }
        println!();
    }
    Ok(())
}

fn median_ms(times: &mut [Duration]) -> f64 {
    times.sort();
    times.get(times.len() / 2).map_or(0.0, |time| time.as_secs_f64() * 1e3)
}
