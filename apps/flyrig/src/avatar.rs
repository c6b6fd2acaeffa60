//! `flyrig avatar`: personal avatars.

pub mod arguments;
mod build;
mod checkpoint;
mod edit;
mod eval;
mod export;
mod inputs;
mod parts;
mod render;

use anyhow::Result;
use flyrig_gpu::GpuContext;

use self::{arguments::AvatarAction, inputs::load};

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
