//! `flyrig import`: a take from the files of other programs.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use flyrig_gpu::GpuContext;
use flyrig_report::{arguments::FpsArgs, stop};
use flyrig_takes::{ImportOptions, import, parse_pair};

use crate::calibrate::parse_scale;

/// Arguments of `flyrig import`.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// Folder with videos, or with a folder of images per camera, here or one level below; or the videos of all cameras.
    #[arg(required = true)]
    pub inputs: Vec<PathBuf>,
    /// File or folder of the calibration, in any format of `flyrig calibrate convert`; searched for in and beside the folder otherwise.
    #[arg(long)]
    pub calibration: Option<PathBuf>,
    /// New folder of the take.
    #[arg(long)]
    pub out: PathBuf,
    /// Take the calibration as it is: otherwise time offsets, poses and colours are measured on the person, and corrected where that
    /// agrees better.
    #[arg(long)]
    pub trust_calibration: bool,
    /// Name of a camera in the footage and in the calibration, where it is not sure; may be repeated.
    #[arg(long = "name", value_name = "FOOTAGE=CALIBRATION", value_parser = parse_pair)]
    pub names: Vec<(String, String)>,
    /// Length of the calibration's unit, metres: the measured length for COLMAP and nerfstudio, whose unit is arbitrary.
    #[arg(long, default_value_t = 1.0, value_parser = parse_scale)]
    pub scale: f64,
    #[command(flatten)]
    pub rate: FpsArgs,
}

/// Runs the command.
pub fn run(args: &ImportArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let options = ImportOptions {
        inputs: args.inputs.clone(),
        calibration: args.calibration.clone(),
        scale: args.scale,
        names: args.names.clone(),
        out: args.out.clone(),
        fps: args.rate.fps,
        trusts_calibration: args.trust_calibration,
    };
    import(&options, gpu)
}
