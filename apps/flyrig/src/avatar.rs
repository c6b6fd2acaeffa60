//! `flyrig avatar`: personal avatars.

mod build;
mod checkpoint;
mod edit;
mod eval;
mod export;
mod parts;
mod render;

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Subcommand;
use flyrig_avatar::Avatar;
use flyrig_body::Template;
use flyrig_fusion::{AppearanceOptions, BodySettings, BudgetSettings, SessionSettings};
use flyrig_gpu::GpuContext;
use flyrig_report::{Replay, ReplaySettings};

use crate::{arguments::DatasetArgs, recording};

/// Subcommands of `flyrig avatar`.
#[derive(Debug, Subcommand)]
pub enum AvatarAction {
    /// Build the avatar of a person from a take: the person is tracked as live, then the avatar is fitted to all images together.
    Build(build::AvatarBuildArgs),
    /// Drive an avatar by the poses of a take, render the held-out cameras and score them.
    Eval(eval::AvatarEvalArgs),
    /// Drive an avatar by a recorded motion and write images.
    Render(render::AvatarRenderArgs),
    /// Change the colours of an avatar by a painted texture, or its shape.
    Edit(edit::AvatarEditArgs),
    /// Write an avatar for other programs: splats in a pose (PLY, glTF), a textured mesh with bones (glTF), the texture (PNG).
    Export(export::AvatarExportArgs),
    /// Print the provenance and size of an avatar.
    Info {
        /// The avatar (*.flyavatar).
        avatar: PathBuf,
    },
}

/// Runs the command.
pub fn avatar(action: &AvatarAction, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    match action {
        // Kernels of the processor where there is no GPU: a software adapter is slower.
        AvatarAction::Build(args) => build::build(args, &gpu()?.fastest()),
        AvatarAction::Eval(args) => eval::eval(args, &gpu()?.fastest()),
        AvatarAction::Render(args) => render::render(args, &gpu()?.fastest()),
        AvatarAction::Edit(args) => edit::edit(args),
        AvatarAction::Export(args) => export::export(args),
        AvatarAction::Info { avatar } => {
            let avatar = load(avatar)?;
            let (nodes, joints) =
                (avatar.hanging.as_ref().map_or(0, |graph| graph.nodes.len()), avatar.template.skeleton.joints().len());
            println!("{}", serde_json::to_string_pretty(&avatar.card)?);
            println!(
                "{} Gaussians, harmonics of order {:?}, {nodes} nodes, {joints} joints, {} vertices",
                avatar.gaussians(),
                avatar.parameters.order(),
                avatar.template.positions.len()
            );
            Ok(())
        }
    }
}

fn load(path: &Path) -> Result<Avatar> {
    Ok(Avatar::load(path)?)
}

/// Says how much of the body was in poses that the avatar was never seen in, in the mean of all frames.
fn print_far(share: f64) {
    if share > 0.0 {
        println!(
            "{:.1} % of the body was in poses unlike those that the avatar was built from (over 30 degrees from all of them); a take that \
             shows such poses makes it better",
            100.0 * share
        );
    }
}

/// Opens a take to be tracked.
///
/// With a known body an estimated pose moves that one.
fn open_replay(
    take: &DatasetArgs,
    holdout: &[String],
    (body, known): (&BodySettings, Option<&Template>),
    gpu: &GpuContext,
) -> Result<Replay> {
    let settings = ReplaySettings {
        dataset: take.dataset.clone(),
        recorded: recording::rig_of_take(&take.dataset)?,
        inputs: take.inputs.clone(),
        holdout: holdout.to_vec(),
        session: SessionSettings {
            perception: take.perception.clone(),
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
