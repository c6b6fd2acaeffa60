//! Prints what a simulated picture costs on the adapter at hand.
//!
//! `cargo run --release -p flyrig-sim --example frame_times -- [SIDE_PX] [FRAMES]`

use std::error::Error;
use std::time::Instant;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, default: u32| args.get(index).map_or(Ok(default), |text| text.parse());
    let (side, frames) = (number(0, 512)?, number(1, 10)?);
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let config = SimConfig { width: side, height: side, ..SimConfig::default() };
    let start = Instant::now();
    let mut simulator = Simulator::new(&gpu, &config)?;
    println!("{}; set up in {:.2?}", gpu.adapter_name(), start.elapsed());
    let mesh = simulator.clothed_surface(0);
    println!("{} vertices, {} triangles", mesh.positions.len(), mesh.triangles.len());
    let mut best = [f64::INFINITY; 3];
    let milliseconds = |start: Instant| start.elapsed().as_secs_f64() * 1e3;
    for frame in 0..frames {
        let nanos = simulator.frame_nanos(u64::from(frame));
        let start = Instant::now();
        simulator.capture(nanos, 0)?;
        best[0] = best[0].min(milliseconds(start));
        let start = Instant::now();
        simulator.capture(nanos, 1)?;
        best[1] = best[1].min(milliseconds(start));
        let start = Instant::now();
        simulator.render(nanos, 2)?;
        best[2] = best[2].min(milliseconds(start));
    }
    let [first, next, truth] = best;
    println!(
        "{side} x {side}, best of {frames}: first camera of an instant {first:.1} ms, each further one {next:.1} ms"
    );
    println!("with depth, canonical positions and parts {truth:.1} ms");
    Ok(())
}
