//! `flyrig avatar export`: writes an avatar for other programs.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use flyrig_avatar::{Atlas, Avatar, Bones, DEFAULT_ATLAS_SIDE, PosedAvatar, write_splat_glb};
use flyrig_body::{GlbContents, write_glb};
use flyrig_renderer::{AnisotropicSplats, write_anisotropic_ply};
use flyrig_report::{png, write_whole};
use flyrig_types::PoseTrack;
use glam::{DQuat, Quat};

use super::{inputs::load, motion::DrivenMotion};

/// Arguments of `flyrig avatar export`.
#[derive(Debug, Args)]
pub struct AvatarExportArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// The file to write: splats as *.ply, or as *.glb (KHR_gaussian_splatting); the texture as *.png.
    #[arg(long)]
    pub out: PathBuf,
    /// Write a textured mesh of the clothed surface with bones (*.glb) instead of splats, animated by --motion.
    #[arg(long)]
    pub mesh: bool,
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
    ensure!(
        !args.mesh || ending == "glb",
        "--mesh writes glTF; name the file {}",
        args.out.with_extension("glb").display()
    );
    match ending.as_str() {
        "png" => texture(&avatar, args),
        "glb" if args.mesh => mesh(&avatar, args),
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

fn mesh(avatar: &Avatar, args: &AvatarExportArgs) -> Result<()> {
    let texture = encode(&avatar.atlas(args.resolution.side)?)?;
    let mut surface = avatar.surface();
    let motion = args.motion.as_deref().map(|motion| DrivenMotion::load(&surface, motion)).transpose()?;
    let track = motion.map(|motion| y_up(motion.track())).transpose()?;
    surface.normals = avatar.template.normals_at(&surface.positions);
    write_glb(&args.out, &surface, GlbContents { track: track.as_ref(), texture: Some(&texture) })?;
    let (vertices, joints) = (surface.positions.len(), surface.skeleton.joints().len());
    println!("textured mesh of {vertices} vertices with {joints} joints in {}", args.out.display());
    Ok(())
}

/// Rotates a motion from z up to glTF's y up.
fn y_up(track: &PoseTrack) -> Result<PoseTrack> {
    let turn = DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2);
    let turned = track.keys().iter().map(|(nanos, pose)| {
        let mut pose = pose.clone();
        pose.root_translation = turn * pose.root_translation;
        if let Some(root) = pose.joint_rotations.first_mut() {
            *root = (turn * *root).normalize();
        }
        (*nanos, pose)
    });
    Ok(PoseTrack::new(turned.collect())?)
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

#[cfg(test)]
mod tests {
    use flyrig_body::{
        DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, load_gltf, sample_surface, skin_mesh,
    };
    use flyrig_renderer::HarmonicOrder;
    use glam::DVec3;

    use super::*;

    #[test]
    fn the_mesh_is_the_clothed_surface() {
        let folder = tempfile::tempdir().unwrap();
        let [avatar_path, out] = ["a.flyavatar", "a.glb"].map(|name| folder.path().join(name));
        let template = default_template(&ShapeParams::default()).unwrap();
        let gaussians = sample_surface(&template, 2000, 5).unwrap();
        let graph = build_graph(&template, &gaussians, 60, DEFAULT_SIGMA2_M2).unwrap();
        let mut avatar = Avatar::new(&template, &gaussians, Some(&graph), &[], HarmonicOrder::Zero).unwrap();
        // Clothes that stand off by 5 cm to the front.
        for mean in &mut avatar.hanging.as_mut().unwrap().mean {
            *mean = DVec3::Z * 0.05;
        }
        write_whole(&avatar_path, &avatar.to_bytes().unwrap()).unwrap();
        export(&AvatarExportArgs {
            avatar: avatar_path,
            out: out.clone(),
            mesh: true,
            motion: None,
            frame: 0,
            resolution: TextureArgs { side: 32 },
        })
        .unwrap();
        let written = load_gltf(&out).unwrap().template;
        let at_rest = |template: &flyrig_body::Template| skin_mesh(template, &template.skeleton.rest_pose()).0;
        for ((clothed, found), body) in
            at_rest(&avatar.surface()).iter().zip(at_rest(&written)).zip(at_rest(&avatar.template))
        {
            assert!(clothed.distance(found) < 1e-4, "{found} is not {clothed}");
            assert!((found - body).z > 0.04, "{found} lies on the body, {body}");
        }
    }
}
