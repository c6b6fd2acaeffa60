//! Arguments of `flyrig avatar`.

use std::{ops::Range, path::PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use flyrig_avatar::DEFAULT_ATLAS_SIDE;
use flyrig_body::DEFAULT_NODE_COUNT;
use flyrig_fusion::{PerceptionSettings, TrackingSettings};
use flyrig_report::arguments::{parse_fps, parse_minutes, parse_range, parse_size};

use crate::cli::LagArgs;

/// About 7 mm apart on an adult.
const GAUSSIANS: u32 = 41_000;

#[derive(Debug, Subcommand)]
pub enum AvatarAction {
    /// Build a person's avatar from the images of a take: it is tracked as live, then fitted to all images together.
    Build(BuildArgs),
    /// Drive an avatar by the poses of a take, render the held-out cameras and score them.
    Eval(EvalArgs),
    /// Drive an avatar by a recorded motion and write images.
    Render(RenderArgs),
    /// Change an avatar's colours by a painted texture, or its shape.
    Edit(EditArgs),
    /// Write an avatar for other programs: splats in a pose (PLY, glTF), a textured mesh with bones (glTF), the texture (PNG).
    Export(ExportArgs),
    /// Print the provenance and size of an avatar.
    Info {
        /// The avatar (*.flyavatar).
        avatar: PathBuf,
    },
}

/// A take and how its person is found.
#[derive(Debug, Clone, Args)]
pub struct TakeArgs {
    /// Folder in EasyMocap layout: a calibration, images/CAM, optional mask/CAM and a skinned *.glb. Or a calibrated recording, *.mcap.
    pub dataset: PathBuf,
    /// Cameras that are looked at, comma separated.
    #[arg(long, value_delimiter = ',', required = true)]
    pub inputs: Vec<String>,
    /// Frames FIRST..END, END excluded; all of them otherwise.
    #[arg(long, value_parser = parse_range)]
    pub frames: Option<Range<u64>>,
    /// Frame rate of the folder; a recording has its own.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    #[command(flatten)]
    pub perception: PerceptionSettings,
    #[command(flatten)]
    pub tracking: TrackingSettings,
    #[command(flatten)]
    pub lags: LagArgs,
}

/// Order of spherical harmonics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Order {
    #[value(name = "0")]
    Zero,
    #[value(name = "1")]
    One,
    #[value(name = "2")]
    Two,
}

/// How an avatar is learnt.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// Every number of every Gaussian by itself.
    Direct,
    /// Networks that neighbouring Gaussians share, and an atlas of colours (LoGAvatar).
    #[value(name = "logavatar")]
    LogAvatar,
    /// Of these the networks alone: the colours of every Gaussian by themselves.
    LocalGeometry,
    /// Of these the atlas alone: place, size and opacity of every Gaussian by themselves.
    LocalColors,
}

/// How the surface lies in the atlas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Atlas {
    /// By the body's texture coordinates.
    Uv,
    /// Seen from the front and from the back.
    FrontBack,
}

/// Settings of the methods with networks.
#[derive(Debug, Args)]
pub struct LocalArgs {
    /// Gaussians around an anchor (--method logavatar or local-geometry).
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=64))]
    pub group: u8,
    /// Stages that geometry is predicted in (--method logavatar or local-geometry).
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=8))]
    pub stages: u8,
    /// How the surface lies in the atlas of colours (--method logavatar or local-colors).
    #[arg(long, value_enum, default_value = "uv")]
    pub atlas: Atlas,
    /// Texels along a side of the atlas (--method logavatar or local-colors).
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u16).range(16..=2048))]
    pub texels: u16,
}

#[derive(Debug, Args)]
pub struct BuildArgs {
    #[command(flatten)]
    pub take: TakeArgs,
    /// The avatar to write (*.flyavatar).
    #[arg(long)]
    pub out: PathBuf,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = GAUSSIANS, value_parser = clap::value_parser!(u32).range(1000..=1_000_000))]
    pub gaussians: u32,
    /// Nodes of the deformation graph.
    #[arg(long, default_value_t = DEFAULT_NODE_COUNT)]
    pub nodes: usize,
    /// Order of spherical harmonics of the colours: how much they may depend on the direction.
    #[arg(long, value_enum, default_value = "0")]
    pub harmonics: Order,
    /// Minutes of fitting; tracking comes before. Longer fits explain the take's images better, and others worse.
    #[arg(long, default_value_t = 1.5, value_parser = parse_minutes, conflicts_with = "steps")]
    pub minutes: f64,
    /// Steps of fitting in place of minutes: the same steps and seed give the same bytes.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub steps: Option<u64>,
    /// How much neighbouring Gaussians pull each other; 0 for not at all.
    #[arg(long, default_value_t = 5.0, value_parser = parse_pull)]
    pub pull: f32,
    /// Whether to learn the light of the take's room apart from the colours.
    #[arg(long, default_value_t = true, action = clap::ArgAction::Set)]
    pub light: bool,
    /// Whether to correct the poses of the take while the avatar is learnt.
    #[arg(long, default_value_t = false, action = clap::ArgAction::Set)]
    pub refine_poses: bool,
    /// Whether to correct the weights by which the bones move each Gaussian.
    #[arg(long, default_value_t = false, action = clap::ArgAction::Set)]
    pub skin_correction: bool,
    /// How the avatar is learnt.
    #[arg(long, value_enum, default_value = "direct")]
    pub method: Method,
    #[command(flatten)]
    pub local: LocalArgs,
    /// Weight of the error of fine detail (unsharp mask); 0 for none.
    #[arg(long, default_value_t = 0.0, value_parser = parse_sharpen)]
    pub sharpen: f32,
    /// Seed of the order of images, and of networks.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

fn parse_sharpen(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(weight) if (0.0..=100.0).contains(&weight) => Ok(weight),
        _ => Err(format!("'{text}' is not between 0 and 100")),
    }
}

fn parse_pull(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(pull) if (0.0..=1000.0).contains(&pull) => Ok(pull),
        _ => Err(format!("'{text}' is not between 0 and 1000")),
    }
}

#[derive(Debug, Args)]
pub struct EvalArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    #[command(flatten)]
    pub take: TakeArgs,
    /// Cameras to render and score, comma separated.
    #[arg(long, value_delimiter = ',', required = true)]
    pub holdout: Vec<String>,
    /// Folder for images and scores.
    #[arg(long)]
    pub out: PathBuf,
    /// Move its clothes as the images show it, in place of the pose alone.
    #[arg(long)]
    pub deformed: bool,
    /// Whether Gaussians that lie closer than the view's pixels are merged: small images are drawn faster.
    #[arg(long, default_value_t = true, action = clap::ArgAction::Set)]
    pub level_of_detail: bool,
}

#[derive(Debug, Args)]
pub struct RenderArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// Recorded motion: BVH or animated glTF.
    #[arg(long)]
    pub motion: PathBuf,
    /// Folder for images.
    #[arg(long)]
    pub out: PathBuf,
    /// Frames of the motion FIRST..END, END excluded, at 30 a second.
    #[arg(long, default_value = "0..30", value_parser = parse_range)]
    pub frames: Range<u64>,
    /// Size of the images, pixels.
    #[arg(long, default_value = "512x768", value_parser = parse_size)]
    pub size: [u32; 2],
    /// Whether Gaussians that lie closer than the view's pixels are merged: small images are drawn faster.
    #[arg(long, default_value_t = true, action = clap::ArgAction::Set)]
    pub level_of_detail: bool,
}

#[derive(Debug, Args)]
pub struct EditArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// The edited avatar to write (*.flyavatar).
    #[arg(long)]
    pub out: PathBuf,
    /// A texture as `flyrig avatar export --out TEXTURE.png` writes it, with colours painted over: texels that differ are taken over.
    #[arg(long)]
    pub texture: Option<PathBuf>,
    /// Texels along a side of the texture.
    #[arg(long, default_value_t = DEFAULT_ATLAS_SIDE)]
    pub side: u32,
    /// Shape targets NAME=VALUE, comma separated, against the average body, such as stomach-tone=-0.8,upperarm-scale-vert=0.5.
    #[arg(long, value_delimiter = ',', value_parser = parse_target)]
    pub shape: Vec<(String, f32)>,
}

fn parse_target(text: &str) -> Result<(String, f32), String> {
    let fail = || format!("'{text}' is not NAME=VALUE, such as stomach-tone=-0.8");
    let (name, value) = text.split_once('=').ok_or_else(fail)?;
    Ok((name.trim().to_owned(), value.trim().parse().map_err(|_| fail())?))
}

#[derive(Debug, Args)]
pub struct ExportArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    /// The file to write: splats as *.ply, or as *.glb (KHR_gaussian_splatting); the texture as *.png.
    #[arg(long)]
    pub out: PathBuf,
    /// Write a textured mesh with bones in place of splats (*.glb), animated by --motion.
    #[arg(long)]
    pub mesh: bool,
    /// Texels along a side of the texture.
    #[arg(long, default_value_t = DEFAULT_ATLAS_SIDE)]
    pub side: u32,
    /// Motion that it is posed by (BVH or glTF); at rest otherwise.
    #[arg(long)]
    pub motion: Option<PathBuf>,
    /// Frame of the motion that splats show, at 30 a second.
    #[arg(long, default_value_t = 0)]
    pub frame: u64,
}
