//! `flyrig avatar edit`: replaces texture or shape.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::Args;
use flyrig_body::ShapeParams;

use super::{
    export::{TextureArgs, read_texture},
    inputs::load,
};

/// Arguments of `flyrig avatar edit`.
#[derive(Debug, Args)]
pub struct AvatarEditArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// The edited avatar to write (*.flyavatar).
    #[arg(long)]
    pub out: PathBuf,
    /// A repainted texture of `flyrig avatar export --out TEXTURE.png`: texels that differ from the export are applied.
    #[arg(long)]
    pub texture: Option<PathBuf>,
    /// Changes of shape NAME=VALUE relative to the average body, comma separated, such as stomach-tone=-0.8,upperarm-scale-vert=0.5.
    #[arg(long, value_delimiter = ',', value_parser = parse_target)]
    pub shape: Vec<(String, f32)>,
    #[command(flatten)]
    pub resolution: TextureArgs,
}

fn parse_target(text: &str) -> Result<(String, f32), String> {
    let fail = || format!("'{text}' is not NAME=VALUE, such as stomach-tone=-0.8");
    let (name, value) = text.split_once('=').ok_or_else(fail)?;
    Ok((name.trim().to_owned(), value.trim().parse().map_err(|_| fail())?))
}

/// Runs the command.
pub fn edit(args: &AvatarEditArgs) -> Result<()> {
    ensure!(
        args.texture.is_some() || !args.shape.is_empty(),
        "nothing to edit; give --texture or --shape (flyrig avatar edit --help)"
    );
    let mut avatar = load(&args.avatar)?;
    if let Some(path) = &args.texture {
        let painted = avatar.paint(&read_texture(path, args.resolution.side)?)?;
        println!(
            "{} texels differ: {} Gaussians recoloured, {} added",
            painted.texels, painted.recolored, painted.added
        );
        if painted.texels > 0 {
            avatar.card.edits.push(format!("texture {}", path.display()));
        }
    }
    if !args.shape.is_empty() {
        let change = ShapeParams(args.shape.iter().cloned().collect());
        let before = height_m(&avatar);
        avatar.reshape(&change)?;
        avatar.card.edits.extend(args.shape.iter().map(|(name, value)| format!("shape {name}={value}")));
        println!("height {before:.2} m -> {:.2} m", height_m(&avatar));
    }
    avatar.save(&args.out)?;
    println!("{} Gaussians in {}", avatar.gaussians(), args.out.display());
    Ok(())
}

fn height_m(avatar: &flyrig_avatar::Avatar) -> f32 {
    let heights = || avatar.template.positions.iter().map(|place| place.y);
    heights().fold(f32::NEG_INFINITY, f32::max) - heights().fold(f32::INFINITY, f32::min)
}
