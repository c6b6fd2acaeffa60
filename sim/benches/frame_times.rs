//! Prints frames per second and memory of simulated cameras on the available adapter, as the rows of a table.
//!
//! `cargo bench -p flyrig-sim --bench frame_times -- [INSTANTS] [WIDTH HEIGHT CAMERAS [OPTION...]]`, options: `blur`,
//! `rolling`, `defocus`, `noise`, `truth`, `office`, `cluttered`, `passer-by`. Without a size: all sizes and numbers of
//! cameras, plain, with blur and with noise, each in a process of its own.

use std::error::Error;
use std::process::Command;
use std::time::Instant;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{OpticsConfig, SceneKind, SensorConfig, SimConfig, Simulator};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).filter(|text| text != "--bench").collect();
    let instants = args.first().map_or(Ok(5), |text| text.parse::<u64>())?;
    if let [_, width, height, cameras, options @ ..] = &args[..] {
        return measure(instants, [width.parse()?, height.parse()?], cameras.parse()?, options);
    }
    println!("| images | cameras | what | set-up s | ms an instant | frames/s | peak MiB |");
    println!("|---|---|---|---|---|---|---|");
    for [width, height] in [["512", "512"], ["1920", "1080"]] {
        for cameras in ["1", "4", "8"] {
            for what in [&[][..], &["noise"], &["blur"]] {
                let instants = instants.to_string();
                let arguments = [instants.as_str(), width, height, cameras].into_iter().chain(what.iter().copied());
                // A process each, so that its memory is its own.
                if !Command::new(std::env::current_exe()?).args(arguments).status()?.success() {
                    return Err(format!("{width} x {height}, {cameras} cameras {what:?} failed").into());
                }
            }
        }
    }
    Ok(())
}

fn measure(instants: u64, [width, height]: [u32; 2], cameras: usize, options: &[String]) -> Result<(), Box<dyn Error>> {
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let mut config = SimConfig { width, height, ..SimConfig::default() };
    config.cameras.count = cameras;
    let mut optics = OpticsConfig::default();
    let mut truth = false;
    for option in options {
        match option.as_str() {
            "blur" => optics.exposure_ms = 16.0,
            "rolling" => optics.readout_ms = 16.0,
            "defocus" => optics.aperture_mm = 20.0,
            "noise" => {
                let full_well_electrons = Some(9000.0);
                config.sensors =
                    vec![SensorConfig { full_well_electrons, read_noise_electrons: 4.0, ..SensorConfig::default() }];
            }
            "truth" => truth = true,
            "office" => config.scene.kind = SceneKind::Office,
            "cluttered" => config.scene.kind = SceneKind::Cluttered,
            "passer-by" => config.scene.passer_by = true,
            _ => return Err(format!("there is no option {option}").into()),
        }
    }
    if optics != OpticsConfig::default() {
        config.optics = vec![optics];
    }
    let start = Instant::now();
    let mut simulator = Simulator::new(&gpu, &config)?;
    let setup = start.elapsed().as_secs_f64();
    let slots: Vec<usize> = (0..cameras).collect();
    let mut milliseconds = Vec::new();
    // The first instant compiles.
    for instant in 0..=instants {
        let nanos = simulator.frame_nanos(instant);
        let start = Instant::now();
        simulator.capture_all(nanos, &slots)?;
        if truth {
            for &slot in &slots {
                simulator.render(nanos, slot)?;
            }
        }
        if instant > 0 {
            milliseconds.push(start.elapsed().as_secs_f64() * 1e3);
        }
    }
    milliseconds.sort_by(f64::total_cmp);
    let median = milliseconds.get(milliseconds.len() / 2).copied().unwrap_or(f64::NAN);
    let peak_mib = std::fs::read_to_string("/proc/self/status")
        .ok()
        .and_then(|status| {
            let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
            line.split_whitespace().nth(1)?.parse::<f64>().ok()
        })
        .map_or_else(|| "?".to_owned(), |kib| format!("{:.0}", kib / 1024.0));
    let what = if options.is_empty() { "plain".to_owned() } else { options.join(", ") };
    println!(
        "| {width} x {height} | {cameras} | {what} | {setup:.1} | {median:.0} | {:.1} | {peak_mib} |",
        cameras as f64 * 1e3 / median
    );
    Ok(())
}
