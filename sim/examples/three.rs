//! Times.
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator};
fn cpu() -> f64 { let s = std::fs::read_to_string("/proc/self/stat").unwrap_or_default(); s.split_whitespace().skip(13).take(2).filter_map(|x| x.parse::<f64>().ok()).sum::<f64>() * 10.0 }
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let mut simulator = Simulator::new(&gpu, &SimConfig::default())?;
    let t0 = std::time::Instant::now(); let c0 = cpu();
    for frame in 0..20u64 { let nanos = simulator.frame_nanos(frame); for slot in 0..3 { simulator.capture(nanos, slot)?; } }
    println!("{:.1} ms wall {:.1} cpu-ms a frame of 3 cameras", t0.elapsed().as_secs_f64()*1e3/20.0, (cpu()-c0)/20.0);
    Ok(())
}
