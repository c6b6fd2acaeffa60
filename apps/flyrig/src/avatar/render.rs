//! `flyrig avatar render`: renders an avatar driven by a motion, as images or as a video.

use std::{
    ops::Range,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, Result, bail};
use clap::Args;
use flyrig_avatar::DetailedScene;
use flyrig_body::Template;
use flyrig_gpu::GpuContext;
use flyrig_report::{
    arguments::{parse_range, parse_size},
    png, progress_bar, stop,
};
use flyrig_types::{Camera, Pose, RenderedView};
use glam::DVec3;

use super::{
    backdrop::FloorDisc,
    framing::{ClipView, FramingArgs, PartBoxes},
    inputs::{load, print_far},
    motion::{DrivenMotion, nanos},
};
use crate::video_file::VideoFile;

/// Arguments of `flyrig avatar render`.
#[derive(Debug, Args)]
pub struct AvatarRenderArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// Recorded motion (BVH or animated glTF), or the name of a generated one, such as walk, dance or turn.
    #[arg(long)]
    pub motion: PathBuf,
    /// Video (*.mp4, *.avi), on a floor with the person's shadow, or folder of images with a transparent background.
    #[arg(long)]
    pub out: PathBuf,
    /// Frames of the motion FIRST..END, END excluded, at 30 per second; the whole motion otherwise.
    #[arg(long, value_parser = parse_range)]
    pub frames: Option<Range<u64>>,
    /// Size of the images, pixels.
    #[arg(long, default_value = "512x768", value_parser = parse_size)]
    pub size: [u32; 2],
    #[command(flatten)]
    pub view: FramingArgs,
}

/// Runs `render`.
pub fn render(args: &AvatarRenderArgs, gpu: &GpuContext) -> Result<()> {
    let avatar = load(&args.avatar)?;
    let surface = avatar.surface();
    let motion = DrivenMotion::load(&surface, &args.motion)?;
    let frames = args.frames.clone().unwrap_or(0..motion.frames());
    motion.check(frames.end - 1)?;
    let poses: Vec<Pose> = frames.clone().map(|frame| motion.pose(frame)).collect();
    let boxes = PartBoxes::new(&surface);
    let clip: Vec<Vec<DVec3>> = poses.iter().map(|pose| boxes.corners(&surface.skeleton, pose)).collect();
    let view = ClipView::new(&args.view, args.size, &clip)?;
    let mut out = Output::create(&args.out, args.size, &view, surface)?;
    let mut scene = DetailedScene::new(gpu, avatar, true)?;
    let bar = progress_bar(poses.len() as u64, "avatar render");
    let (mut far, mut gaussians, mut drawn) = (0.0, 0, 0);
    for (frame, pose) in frames.zip(&poses) {
        if stop::requested() {
            break;
        }
        let camera = view.camera(drawn as f64 / poses.len() as f64);
        scene.pose(pose, None);
        far += scene.avatar().far_share(pose);
        out.write(frame, pose, &camera, &scene.draw(&camera)?)?;
        gaussians += scene.drawn().0;
        drawn += 1;
        bar.inc(1);
    }
    bar.finish_and_clear();
    out.finish()?;
    println!(
        "{drawn} frames of {} of {} Gaussians in {}",
        gaussians / drawn.max(1),
        scene.avatar().gaussians(),
        args.out.display()
    );
    let cut = view.cut_off(&clip);
    if cut > 0 {
        println!("the person is cut off in {cut} of {} frames; move --eye back, or leave it out", clip.len());
    }
    print_far(far / drawn.max(1) as f64);
    Ok(())
}

/// Destination of the frames.
enum Output {
    /// Folder of images with a transparent background.
    Images(PathBuf),
    /// Video on a floor.
    Video { file: VideoFile, floor: Box<FloorDisc> },
}

impl Output {
    /// Creates the folder or the video. `surface` casts the shadow.
    fn create(path: &Path, [width, height]: [u32; 2], view: &ClipView, surface: Template) -> Result<Self> {
        let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default();
        match ending.as_str() {
            "mp4" | "avi" => Ok(Self::Video {
                floor: Box::new(FloorDisc::new(view.target.truncate(), view.reach_m, surface)?),
                file: VideoFile::create(path, (width, height))?,
            }),
            "mov" | "mkv" | "webm" | "m4v" | "png" | "jpg" | "jpeg" => bail!(
                "--out {}: name a video *.mp4 or *.avi, or a folder, into which images are written as PNG",
                path.display()
            ),
            _ => {
                std::fs::create_dir_all(path).with_context(|| format!("cannot create {}", path.display()))?;
                Ok(Self::Images(path.to_owned()))
            }
        }
    }

    fn write(&mut self, frame: u64, pose: &Pose, camera: &Camera, view: &RenderedView) -> Result<()> {
        match self {
            Self::Images(folder) => png::write_view(&folder.join(format!("{frame:06}.png")), view),
            Self::Video { file, floor } => file.write(&floor.paint(camera, view, pose), 0, nanos(frame)),
        }
    }

    /// Completes a video.
    fn finish(self) -> Result<()> {
        match self {
            Self::Images(_) => Ok(()),
            Self::Video { file, .. } => file.finish(),
        }
    }
}
