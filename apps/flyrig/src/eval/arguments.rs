//! Arguments of `flyrig eval`.

use std::path::PathBuf;

use clap::Args;
use flyrig_fusion::{AppearanceOptions, BodySettings, BudgetSettings, SessionSettings};
use flyrig_takes::{KnownBody, ReplaySettings};
use flyrig_types::CameraId;

use super::plan::Split;
use crate::arguments::{DatasetArgs, HoldoutArgs};

/// Arguments of `flyrig eval`.
#[derive(Debug, Clone, Args)]
#[command(mut_arg("holdout", |arg| arg.required(false).help(
    "Cameras to render and score, comma separated; by default each camera in turn where there are four or more"
)))]
pub struct EvalArgs {
    #[command(flatten)]
    pub take: DatasetArgs,
    #[command(flatten)]
    pub holdout: HoldoutArgs,
    /// Folder of images, surfaces, the report and the page that plays the take.
    #[arg(long, default_value = "out/eval")]
    pub out: PathBuf,
    /// Write a film of a camera that walks around the person while the take plays (*.mp4 or *.avi).
    #[arg(long, value_name = "FILE")]
    pub orbit: Option<PathBuf>,
    #[command(flatten)]
    pub body: BodySettings,
    /// Avatar of the person (`flyrig avatar build`), from which tracking and colours start.
    #[arg(long, value_name = "FILE")]
    pub avatar: Option<PathBuf>,
    /// Steps of fitting after each frame set, with --learn.
    #[arg(long, default_value_t = 4, value_name = "STEPS", requires = "learn", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub learn_steps: u32,
    #[command(flatten)]
    pub appearance: AppearanceOptions,
    #[command(flatten)]
    pub budget: BudgetSettings,
}

impl EvalArgs {
    /// Returns the settings of the body, with the avatar if one is named.
    pub fn body(&self) -> BodySettings {
        BodySettings { avatar: self.avatar.clone().unwrap_or_default(), ..self.body.clone() }
    }

    /// Returns the name of the take.
    pub fn name(&self) -> String {
        self.take.dataset.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
    }

    /// Returns the settings of the reconstruction of a split.
    pub fn replay(&self, split: &Split, known: Option<KnownBody>) -> ReplaySettings {
        let mut lags_nanos = self.take.lags.nanos();
        // A camera that this split does not read; one of another name is an error.
        let has = |names: &[String], id: &CameraId| names.iter().any(|name| name == id.as_str());
        let is_read = |id: &CameraId| has(&split.inputs, id) || has(&split.holdout, id);
        lags_nanos.retain(|id, _| is_read(id) || !has(&self.take.inputs, id));
        ReplaySettings {
            dataset: self.take.dataset.clone(),
            inputs: split.inputs.clone(),
            holdout: split.holdout.clone(),
            session: SessionSettings {
                perception: self.take.perception.settings.clone(),
                body: self.body(),
                tracking: self.take.tracking.clone(),
                appearance: self.appearance.clone(),
                budget: self.budget,
            },
            fps: self.take.rate.fps,
            frames: self.take.range.frames.clone(),
            lags_nanos,
            true_masks: false,
            true_joints: Vec::new(),
            body: known,
        }
    }
}
