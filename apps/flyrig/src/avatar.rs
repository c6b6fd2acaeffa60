//! `flyrig avatar`: personal avatars.

mod backdrop;
mod build;
mod checkpoint;
mod edit;
mod eval;
mod export;
mod framing;
mod inputs;
mod motion;
mod parts;
mod render;

use std::path::PathBuf;

use anyhow::Result;
use clap::Subcommand;
use flyrig_gpu::GpuContext;

pub(crate) use self::{
    inputs::{load, open_replay},
    motion::DrivenMotion,
};

/// Subcommands of `flyrig avatar`.
#[derive(Debug, Subcommand)]
pub enum AvatarAction {
    /// Build the avatar of a person from a take: the person is tracked as live, then the avatar is fitted to all images together. From a file of
    /// body.person (*.person), take the avatar that a rig has learnt.
    Build(build::AvatarBuildArgs),
    /// Drive an avatar by the poses of a take, render the held-out cameras and score them.
    Eval(eval::AvatarEvalArgs),
    /// Drive an avatar by a motion and write a video or images.
    Render(render::AvatarRenderArgs),
    /// Change the colours of an avatar by a painted texture, or its shape.
    Edit(edit::AvatarEditArgs),
    /// Write an avatar for other programs: splats in a pose (PLY, glTF), the texture (PNG). `flyrig mesh` writes meshes.
    Export(export::AvatarExportArgs),
    /// Print the provenance and size of an avatar.
    Info {
        /// The avatar (*.flyavatar).
        avatar: PathBuf,
    },
}

impl AvatarAction {
    /// Returns the command's name and the input that it opens; `None` for a command that takes no time.
    pub fn input(&self) -> Option<(&'static str, &PathBuf)> {
        match self {
            Self::Build(args) => Some(("avatar build", &args.take.dataset)),
            Self::Eval(args) => Some(("avatar eval", &args.take.dataset)),
            Self::Render(args) => Some(("avatar render", &args.avatar)),
            Self::Edit(_) | Self::Export(_) | Self::Info { .. } => None,
        }
    }
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
