//! `flyrig-bench landmarks`: bias and spread of the landmark network on people whose pose is known.
//!
//! The result is the table in `tracker/src/landmarks/bias.rs`.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use flyrig_body::load_gltf;
use flyrig_capture::{FolderOptions, FolderReplay};
use flyrig_fusion::next_frame;
use flyrig_report::{arguments::FpsArgs, progress_bar};
use flyrig_takes::dataset;
use flyrig_tracker::{LANDMARK_NAMES, LandmarkStudy, PoseNet, RelativeSpread, SpreadBy};

/// Arguments of the command.
#[derive(Debug, Args)]
pub struct BenchLandmarksArgs {
    /// Data sets with an animated glTF body, as `flyrig sim export` writes them; all of their cameras are used.
    #[arg(required = true)]
    pub datasets: Vec<PathBuf>,
    /// Interval of the used frames.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    pub every: u64,
    /// Landmark network, as `--network` of `flyrig run` names it.
    #[arg(long, value_name = "NETWORK", default_value = "full")]
    pub network: PathBuf,
    #[command(flatten)]
    pub rate: FpsArgs,
}

/// Runs the command.
pub fn landmarks(args: &BenchLandmarksArgs) -> Result<()> {
    let mut study = LandmarkStudy::new(PoseNet::load(&args.network, false)?);
    for folder in &args.datasets {
        let name = folder.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let human = load_gltf(&dataset::gltf_file(folder)?)?;
        let track = human.track.with_context(|| format!("the glTF file of {name} holds no animation"))?;
        let rig = dataset::load_rig(folder, &[])?;
        let options = FolderOptions { fps: args.rate.fps, frames: None, with_masks: false };
        let bar = progress_bar(rig.cameras.len() as u64, format!("{name} cameras"));
        for camera in &rig.cameras {
            for mut source in FolderReplay::open(folder, Some(std::slice::from_ref(&camera.id)), &options)? {
                let mut number = 0;
                while let Some(frame) = next_frame(&mut source)? {
                    if number % args.every == 0 {
                        study.add(camera, &frame.image, &human.template, &track.at(frame.capture_nanos))?;
                    }
                    number += 1;
                }
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
    }
    println!(
        "{:>3} {:<20} {:>7} {:>7} {:>7} {:>8} {:>6} {:>6}",
        "", "landmark", "x mm", "y mm", "z mm", "spread", "peak", "seen"
    );
    for bias in study.biases() {
        let [x, y, z] = (bias.bias_m * 1e3).to_array();
        let (name, spread) = (LANDMARK_NAMES[bias.landmark], bias.spread_m * 1e3);
        let peak = bias.peak_cells.map_or("-".to_owned(), |cells| format!("{cells:.2}"));
        println!(
            "{:>3} {name:<20} {x:>7.1} {y:>7.1} {z:>7.1} {spread:>8.1} {peak:>6} {:>6}",
            bias.landmark, bias.count
        );
    }
    println!("\nspread as a multiple of the above");
    for RelativeSpread { by, up_to, times, count } in study.spreads() {
        let by = match by {
            SpreadBy::Peak => "peak, over its median, up to",
            SpreadBy::Confidence => "confidence beside a peak, up to",
            SpreadBy::ConfidenceAlone => "confidence without a peak, up to",
        };
        println!("{by:<32} {up_to:.2} {times:>6.2} {count:>6}");
    }
    Ok(())
}
