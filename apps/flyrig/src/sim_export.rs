//! `flyrig sim export`: a simulated capture as a data set.

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::Result;
use clap::{Args, Subcommand};
use flyrig_capture::FolderOptions;
use flyrig_gpu::GpuContext;
use flyrig_report::{progress_bar, stop};
use flyrig_sim::{CalibrationError, ExportOptions, SimConfig, Simulator, export};
use flyrig_takes::mark_checked;

use crate::{config::Config, simulator_file};

/// Arguments of `flyrig sim export`.
#[derive(Debug, Args)]
pub struct SimExportArgs {
    /// Configuration of the simulated rig (TOML), as `flyrig sim print` prints it, or a rig's with a table [sim]; the defaults otherwise.
    pub config: Option<PathBuf>,
    /// New folder of the capture.
    #[arg(long)]
    pub out: PathBuf,
    /// Number of frames of every camera.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub frames: u64,
    /// Skip the ground truth: depth, canonical positions, poses, surfaces and true times.
    #[arg(long)]
    pub no_truth: bool,
}

/// Subcommands of `flyrig sim`.
#[derive(Debug, Subcommand)]
pub enum SimAction {
    /// Print the default configuration of the simulated rig with a comment on every key.
    Print,
    /// Write a simulated capture in the layout of EasyMocap, which `flyrig eval` reads, with the ground truth.
    Export(SimExportArgs),
}

/// Reads and checks a file of the simulated rig, or a rig's configuration with a table `[sim]`.
///
/// # Errors
/// Those of [`simulator_file::load`] and [`Config::load_for_capture`].
pub fn load_config(path: &Path) -> Result<SimConfig> {
    let is_rig = std::fs::read_to_string(path)
        .is_ok_and(|text| text.parse::<toml::Table>().is_ok_and(|table| table.contains_key("sim")));
    if is_rig { Ok(Config::load_for_capture(path)?.sim) } else { simulator_file::load(path) }
}

/// Runs the command.
pub fn sim_export(args: &SimExportArgs, config: &SimConfig, gpu: &GpuContext) -> Result<()> {
    stop::flag();
    let started = Instant::now();
    let mut simulator = Simulator::new(gpu, config)?;
    let options = ExportOptions { frames: args.frames, truth: !args.no_truth };
    let bar = progress_bar(args.frames, "sim export");
    let exported = export(&mut simulator, &args.out, options, &mut |frames| {
        bar.set_position(frames);
        !stop::requested()
    });
    bar.finish_and_clear();
    let exported = exported?;
    let is_exact = config.calibration_error == CalibrationError::default() && config.sensors.is_empty();
    if is_exact && config.faults.faults.is_empty() {
        mark_checked(&args.out)?;
    }
    let names: Vec<&str> = simulator.rig().cameras.iter().map(|camera| camera.id.as_str()).collect();
    println!(
        "{}: {} frames of {} cameras, {} images in {:.1} s on {}",
        args.out.display(),
        args.frames,
        names.len(),
        exported.pictures,
        started.elapsed().as_secs_f64(),
        gpu.with_adapter()?.adapter_name()
    );
    if exported.lost > 0 {
        println!("{} frames were lost by the fault script; truth/frames.csv says which", exported.lost);
    }
    if names.len() > 1 {
        let rate = if (config.fps - FolderOptions::default().fps).abs() < 1e-9 {
            String::new()
        } else {
            format!(" --fps {}", config.fps)
        };
        println!("score it with: flyrig eval {}{rate}", args.out.display());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_of_a_rigs_configuration_is_read_too() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rig.toml");
        std::fs::write(&file, "[source]\nkind = \"sim\"\n[sim]\nwidth = 32\nheight = 48\n").unwrap();
        let config = load_config(&file).unwrap();
        assert_eq!((config.width, config.height), (32, 48));
        std::fs::write(&file, "[sim]\nwidht = 32\n").unwrap();
        let error = format!("{:#}", load_config(&file).unwrap_err());
        assert!(error.contains("line 2") && error.ends_with("did you mean `width`?"), "{error}");
        std::fs::write(&file, "width = 64\n").unwrap();
        assert_eq!(load_config(&file).unwrap().width, 64);
    }
}
