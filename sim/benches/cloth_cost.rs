//! Benchmark of loose cloth.
//!
//! `cargo bench -p flyrig-sim --bench cloth_cost -- [CLIP] [SECS] [SEED ...]`
//!
//! Requests the clothed surface at 30 frames per second, twice: first the cloth is simulated, then it is read from the
//! cache.

use std::error::Error;
use std::time::Instant;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator, describe_person};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).filter(|text| text != "--bench").collect();
    let clip = args.first().map_or("dance", String::as_str);
    let secs: f64 = args.get(1).map_or(Ok(8.0), |text| text.parse())?;
    let seeds: Vec<u64> = args.iter().skip(2).map(|text| text.parse()).collect::<Result<_, _>>()?;
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    for seed in if seeds.is_empty() { vec![1, 5, 16, 9] } else { seeds } {
        let config: SimConfig = toml::from_str(&format!(
            "seed = {seed}\nwidth = 32\nheight = 32\ntexture_px = 64\nmotion.kind = \"{clip}\""
        ))?;
        let mut simulator = Simulator::new(&gpu, &config)?;
        let frames = (secs * 30.0) as i64;
        let mut round = |largest: &mut f32| {
            let start = Instant::now();
            for frame in 0..frames {
                let surface = simulator.clothed_surface(frame * 1_000_000_000 / 30);
                *largest = surface.displacement.iter().map(|d| d.length()).fold(*largest, f32::max);
            }
            start.elapsed().as_secs_f64()
        };
        let mut largest = 0.0;
        let (first, again) = (round(&mut largest), round(&mut largest));
        println!(
            "seed {seed} ({}): {:.1} ms to compute a second of cloth ({:.2} of skinning and the rest at 30 frames a second, \
             {:.2} ms a frame); it moves by up to {:.0} mm",
            describe_person(&config),
            (first - again) / secs * 1e3,
            (first - again) / again,
            again / frames as f64 * 1e3,
            largest * 1e3
        );
        let start = Instant::now();
        let mut fresh = Simulator::new(&gpu, &config)?;
        let setup = start.elapsed();
        let start = Instant::now();
        fresh.clothed_surface((secs * 0.77e9) as i64);
        println!(
            "    a lone instant {:.1} ms, after {:.0} ms for the person",
            start.elapsed().as_secs_f64() * 1e3,
            setup.as_secs_f64() * 1e3
        );
    }
    Ok(())
}
