//! Groups of arguments that several benchmarks share.

use std::{ops::Range, path::Path};

use clap::Args;
use flyrig_fusion::{BodySettings, BudgetSettings, Origin, PerceptionSettings, SessionSettings};
use flyrig_report::arguments::{FpsArgs, OutputArgs, parse_fps, parse_range, parse_size};
use flyrig_takes::ReplaySettings;

/// Frames and cameras of recorded data sets.
#[derive(Debug, Args)]
pub struct RecordedArgs {
    /// Input cameras, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "00,03,05")]
    pub inputs: Vec<String>,
    /// Cameras to render and compare, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "01,02,04,06")]
    pub holdout: Vec<String>,
    /// Frames FIRST..END, END excluded; all frames otherwise.
    #[arg(long, value_parser = parse_range)]
    pub frames: Option<Range<u64>>,
    #[command(flatten)]
    pub rate: FpsArgs,
}

impl RecordedArgs {
    /// Returns settings for one data set, with poses and masks from `origin`.
    pub fn settings(&self, dataset: &Path, origin: Origin, gaussians: usize, budget: BudgetSettings) -> ReplaySettings {
        let perception = PerceptionSettings { pose: origin, masks: origin, ..PerceptionSettings::default() };
        let body = BodySettings { gaussians, ..BodySettings::default() };
        ReplaySettings {
            dataset: dataset.to_owned(),
            inputs: self.inputs.clone(),
            holdout: self.holdout.clone(),
            session: SessionSettings { perception, body, budget, ..SessionSettings::default() },
            fps: self.rate.fps,
            frames: self.frames.clone(),
            lags_nanos: Default::default(),
            true_masks: false,
            true_joints: Vec::new(),
            body: None,
        }
    }
}

/// A simulated person before a rig, and the folder of the results.
#[derive(Debug, Args)]
pub struct SimulationArgs {
    #[command(flatten)]
    pub output: OutputArgs,
    /// Seed of the first simulated person; further people have the following seeds.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Width and height of the simulated images, pixels.
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
}

/// Plain cameras of this process.
#[derive(Debug, Args)]
pub struct PlainCameras {
    /// Number of cameras.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=32))]
    pub cameras: u32,
    /// Frames per second of each camera.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Size of the images, WIDTHxHEIGHT.
    #[arg(long, value_parser = parse_size, default_value = "640x360")]
    pub size: [u32; 2],
}
