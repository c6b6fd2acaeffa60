//! Arguments of `flyrig-bench stream`.

use std::path::PathBuf;

use clap::{Args, builder::TypedValueParser as _};
use flyrig_body::DEFAULT_GAUSSIAN_COUNT;
use flyrig_fusion::Origin;

use super::subject::CodedSubject;
use crate::harness::arguments::{RecordedArgs, SimulationArgs};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-stream")), mut_arg("seed", |arg| arg.default_value("811")))]
pub struct BenchStreamArgs {
    /// Data sets in EasyMocap layout, as `flyrig eval` reads them, or motions of simulated people: sim:turn, sim:dance, sim:walk,
    /// sim:still and so on.
    #[arg(required = true)]
    pub datasets: Vec<CodedSubject>,
    #[command(flatten)]
    pub replay: RecordedArgs,
    /// Sources of pose and masks, comma separated.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "given")]
    pub pose: Vec<Origin>,
    /// Numbers of Gaussians on the person's surface, comma separated.
    #[arg(long, value_delimiter = ',', default_values_t = [DEFAULT_GAUSSIAN_COUNT], value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: Vec<usize>,
    /// Quantisation steps of the colours, in units of 1/255, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "4,8,12,16")]
    pub steps: Vec<f32>,
    /// Constant qualities of colours coded as a video, 0 (best) to 63, comma separated; needs the program ffmpeg.
    #[arg(long, value_delimiter = ',', default_value = "10,20,30", value_parser = clap::value_parser!(u8).range(0..=63))]
    pub crf: Vec<u8>,
    /// Avatar of the person (`flyrig avatar build`): tracking starts from it, and an encoding sends it once and then poses alone.
    #[arg(long, value_name = "FILE")]
    pub avatar: Option<PathBuf>,
    #[command(flatten)]
    pub simulation: SimulationArgs,
}
