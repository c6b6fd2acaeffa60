//! `flyrig avatar`: personal avatars.

pub mod arguments;
mod build;
mod checkpoint;
mod edit;
mod eval;
mod export;
mod parts;
mod render;

use std::path::Path;

use anyhow::Result;
use flyrig_avatar::Avatar;
use flyrig_body::Template;
use flyrig_fusion::{AppearanceOptions, BodySettings, BudgetSettings, SessionSettings};
use flyrig_gpu::GpuContext;
use flyrig_takes::{Replay, ReplaySettings};

use arguments::{AvatarAction, TakeArgs};

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
    take: &TakeArgs,
    holdout: &[String],
    (body, known): (&BodySettings, Option<&Template>),
    gpu: &GpuContext,
) -> Result<Replay> {
    let settings = ReplaySettings {
        dataset: take.dataset.clone(),
        inputs: take.inputs.clone(),
        holdout: holdout.to_vec(),
        session: SessionSettings {
            perception: take.perception.clone(),
            body: body.clone(),
            tracking: take.tracking.clone(),
            appearance: AppearanceOptions::default(),
            budget: BudgetSettings::default(),
        },
        fps: take.fps,
        frames: take.frames.clone(),
        lags_nanos: take.lags.nanos(),
        true_masks: false,
        true_joints: Vec::new(),
        body: known.map(|template| template.clone().into()),
    };
    Replay::open(&settings, gpu)
}
