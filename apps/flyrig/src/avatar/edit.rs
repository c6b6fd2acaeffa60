//! `flyrig avatar edit`: replaces texture or shape.

use anyhow::{Result, ensure};
use flyrig_body::ShapeParams;

use super::{arguments::EditArgs, export::read_texture, inputs::load};

/// Runs the command.
pub fn edit(args: &EditArgs) -> Result<()> {
    ensure!(
        args.texture.is_some() || !args.shape.is_empty(),
        "nothing to edit; give --texture or --shape (flyrig avatar edit --help)"
    );
    let mut avatar = load(&args.avatar)?;
    if let Some(path) = &args.texture {
        let painted = avatar.paint(&read_texture(path, args.side)?)?;
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
