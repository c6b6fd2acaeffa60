//! Avatars and takes that the commands open.

use std::path::Path;

use anyhow::{Result, ensure};
use flyrig_avatar::Avatar;
use flyrig_body::Template;
use flyrig_fusion::{AppearanceOptions, BodySettings, BudgetSettings, PersonMemory, SessionSettings};
use flyrig_gpu::GpuContext;
use flyrig_takes::{Replay, ReplaySettings};

use crate::arguments::DatasetArgs;

/// Loads an avatar, or the one in a file of `body.person` that a rig has learnt.
pub(crate) fn load(path: &Path) -> Result<Avatar> {
    ensure!(path.exists(), "{} does not exist; `flyrig avatar build` makes an avatar", path.display());
    let learnt = || PersonMemory::load(path).ok()?.avatar().map(|avatar| (**avatar).clone());
    Avatar::load(path).or_else(|error| learnt().ok_or(error)).map_err(Into::into)
}

/// Prints the mean share of the body in poses unlike those that the avatar was built from.
pub(super) fn print_far(share: f64) {
    if share > 0.0 {
        println!(
            "{:.1} % of the body was in poses unlike those that the avatar was built from (over 30 degrees from all of them); a take that \
             shows such poses improves it",
            100.0 * share
        );
    }
}

/// Opens a take to be tracked. With a known body, estimated poses move that body.
pub(crate) fn open_replay(
    take: &DatasetArgs,
    holdout: &[String],
    (body, known): (&BodySettings, Option<&Template>),
    gpu: &GpuContext,
) -> Result<Replay> {
    let settings = ReplaySettings {
        dataset: take.dataset.clone(),
        inputs: take.inputs.clone(),
        holdout: holdout.to_vec(),
        session: SessionSettings {
            perception: take.perception.settings.clone(),
            body: body.clone(),
            tracking: take.tracking.clone(),
            appearance: AppearanceOptions::default(),
            budget: BudgetSettings::default(),
        },
        fps: take.rate.fps,
        frames: take.range.frames.clone(),
        lags_nanos: take.lags.nanos(),
        true_masks: false,
        true_joints: Vec::new(),
        body: known.map(|template| template.clone().into()),
    };
    Replay::open(&settings, gpu)
}
