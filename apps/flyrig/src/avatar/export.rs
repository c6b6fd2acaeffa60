//! `flyrig avatar export`: writes an avatar for other programs.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use flyrig_avatar::{Atlas, Avatar, Bones, DEFAULT_ATLAS_SIDE, PosedAvatar, write_splat_glb};
use flyrig_renderer::{AnisotropicSplats, write_anisotropic_ply};
use flyrig_report::{png, write_whole};
use glam::Quat;

use super::{inputs::load, motion::DrivenMotion};

/// Arguments of `flyrig avatar export`.
#[derive(Debug, Args)]
pub struct AvatarExportArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// The file to write: splats as *.ply, or as *.glb (KHR_gaussian_splatting); the texture as *.png.
    #[arg(long)]
    pub out: PathBuf,
    /// Motion that poses it (BVH or glTF, or the name of a generated one); the rest pose otherwise.
    #[arg(long)]
    pub motion: Option<PathBuf>,
    /// Frame of the motion for splats, at 30 per second.
    #[arg(long, default_value_t = 0)]
    pub frame: u64,
    #[command(flatten)]
    pub resolution: TextureArgs,
}

/// Resolution of a texture.
#[derive(Debug, Args)]
pub struct TextureArgs {
    /// Texels along a side of the texture.
    #[arg(long, default_value_t = DEFAULT_ATLAS_SIDE)]
    pub side: u32,
}

/// Runs the command.
pub fn export(args: &AvatarExportArgs) -> Result<()> {
    let avatar = load(&args.avatar)?;
    let ending = args.out.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default();
    match ending.as_str() {
        "png" => texture(&avatar, args),
        "ply" | "glb" => splats(&avatar, args, &ending),
        _ => bail!("{} is neither *.ply, *.glb nor *.png", args.out.display()),
    }
}

fn texture(avatar: &Avatar, args: &AvatarExportArgs) -> Result<()> {
    let atlas = avatar.atlas(args.resolution.side)?;
    write_whole(&args.out, &encode(&atlas)?)?;
    println!(
        "texture of {0} x {0} texels, {1} of them on the body, in {2}; paint it, then: flyrig avatar edit {3} --texture {2} --out NEW.flyavatar",
        atlas.side,
        atlas.covered,
        args.out.display(),
        args.avatar.display()
    );
    Ok(())
}

fn encode(atlas: &Atlas) -> Result<Vec<u8>> {
    png::encode_rgb(&atlas.rgb, atlas.side, atlas.side)
}

fn splats(avatar: &Avatar, args: &AvatarExportArgs, ending: &str) -> Result<()> {
    let pose = match &args.motion {
        Some(motion) => {
            let motion = DrivenMotion::load(&avatar.surface(), motion)?;
            motion.check(args.frame)?;
            motion.pose(args.frame)
        }
        None => avatar.template.skeleton.rest_pose(),
    };
    let mut posed = PosedAvatar::default();
    avatar.pose(&Bones::new(&avatar.template.skeleton, &pose), None, &mut posed);
    let splats = AnisotropicSplats {
        center: posed.center,
        scale_opacity: posed.scale_opacity,
        rotation: posed.rotation,
        harmonics: posed.harmonics,
        order: avatar.parameters.order(),
    };
    let count = if ending == "ply" {
        write_anisotropic_ply(&args.out, &splats)?
    } else {
        // Motions have z up, the rest pose has y up.
        let turn = if args.motion.is_some() { -std::f32::consts::FRAC_PI_2 } else { 0.0 };
        write_splat_glb(&args.out, &splats, Quat::from_rotation_x(turn))?
    };
    println!("{count} splats in {}", args.out.display());
    Ok(())
}

/// Reads an edited texture, which must have `side` x `side` texels.
pub(super) fn read_texture(path: &Path, side: u32) -> Result<Atlas> {
    let image = image::open(path).with_context(|| format!("cannot read the texture {}", path.display()))?.into_rgb8();
    let (width, height) = image.dimensions();
    ensure!(
        (width, height) == (side, side),
        "{} has {width}x{height} texels, the avatar's texture {side}x{side}; export it again, or give the --side that it was exported with",
        path.display()
    );
    Ok(Atlas { side, rgb: image.into_raw(), covered: 0 })
}
