//! `flyrig avatar render`: renders an avatar driven by a recorded motion.

use std::{
    ops::Range,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, Result, bail};
use clap::Args;
use flyrig_avatar::{Avatar, DetailedScene};
use flyrig_body::{RetargetOptions, load_bvh, load_gltf_motion};
use flyrig_gpu::GpuContext;
use flyrig_report::{
    arguments::{parse_range, parse_size},
    png, progress_bar, stop,
};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens, Pose, PoseTrack};
use glam::{DQuat, DVec2, DVec3};

use super::inputs::{load, print_far};

/// Arguments of `flyrig avatar render`.
#[derive(Debug, Args)]
pub struct AvatarRenderArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// Recorded motion: BVH or animated glTF.
    #[arg(long)]
    pub motion: PathBuf,
    /// Folder of the images.
    #[arg(long)]
    pub out: PathBuf,
    /// Frames of the motion FIRST..END, END excluded, at 30 per second.
    #[arg(long, default_value = "0..30", value_parser = parse_range)]
    pub frames: Range<u64>,
    /// Size of the images, pixels.
    #[arg(long, default_value = "512x768", value_parser = parse_size)]
    pub size: [u32; 2],
}

/// Frame rate of the images, frames per second.
pub(super) const FPS: f64 = 30.0;
/// Distance and height of the camera, metres.
const AWAY_M: f64 = 3.6;
const HEIGHT_M: f64 = 1.1;

/// Runs `render`.
pub fn render(args: &AvatarRenderArgs, gpu: &GpuContext) -> Result<()> {
    let avatar = load(&args.avatar)?;
    let track = motion(&avatar, &args.motion)?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let mut scene = DetailedScene::new(gpu, avatar, true)?;
    let bar = progress_bar(args.frames.end - args.frames.start, "avatar render");
    let (mut far, mut drawn) = (0.0, 0);
    for frame in args.frames.clone() {
        if stop::requested() {
            break;
        }
        let pose = pose_at(&track, frame);
        scene.pose(&pose, None);
        far += scene.avatar().far_share(&pose);
        let view = scene.draw(&camera(args.size, pose.root_translation))?;
        drawn += scene.drawn().0;
        png::write_view(&args.out.join(format!("{frame:06}.png")), &view)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    let frames = (args.frames.end - args.frames.start).max(1) as f64;
    let gaussians = scene.avatar().gaussians();
    println!("images of {:.0} of {gaussians} Gaussians in {}", drawn as f64 / frames, args.out.display());
    print_far(far / frames);
    Ok(())
}

/// Retargets a recorded motion to the avatar's skeleton.
pub(super) fn motion(avatar: &Avatar, path: &Path) -> Result<PoseTrack> {
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default();
    let clip = match ending.as_str() {
        "bvh" => load_bvh(path)?.motion(),
        "glb" | "gltf" => load_gltf_motion(path)?,
        _ => bail!("{} is neither BVH nor glTF (*.bvh, *.glb, *.gltf)", path.display()),
    };
    let options = RetargetOptions { reach_m: Some(0.5), ..RetargetOptions::default() };
    Ok(clip.retarget(&avatar.template.skeleton, &options)?)
}

/// Returns the pose of a frame.
pub(super) fn pose_at(track: &PoseTrack, frame: u64) -> Pose {
    track.at((frame as f64 / FPS * 1e9) as i64)
}

/// Returns a camera in front of the person.
fn camera([width, height]: [u32; 2], root: DVec3) -> Camera {
    let focal = 1.4 * f64::from(height);
    let place = DVec3::new(root.x, root.y - AWAY_M, HEIGHT_M);
    // The world has z up; a camera looks along its own z, with y down.
    let camera_from_world = DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
    Camera {
        id: "view".into(),
        intrinsics: Intrinsics {
            width,
            height,
            focal_px: DVec2::splat(focal),
            // Pixel centres are at integers.
            center_px: DVec2::new(f64::from(width) - 1.0, f64::from(height) - 1.0) * 0.5,
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry { rotation: camera_from_world, translation: -(camera_from_world * place) },
        time_offset_nanos: 0,
        color: Default::default(),
    }
}
