//! The command line.

use std::{collections::BTreeMap, net::SocketAddr, ops::Range, path::PathBuf};

use clap::{Args, Parser, Subcommand, ValueEnum};
use flyrig_access::{AccessError, DEFAULT_PORT, KeyFile, Role};
use flyrig_body::DEFAULT_GAUSSIAN_COUNT;
use flyrig_calib::Format;
use flyrig_fusion::{AppearanceOptions, BodySettings, BudgetSettings, Origin, PerceptionSettings, TrackingSettings};
use flyrig_report::arguments::{parse_fps, parse_minutes, parse_range, parse_seconds, parse_size, parse_speed};
use flyrig_training::TrainArgs;
use flyrig_transport::TransportConfig;
use flyrig_types::CameraId;
use flyrig_web::WebConfig;

use crate::avatar::arguments::AvatarAction;

/// Live free-viewpoint video of a person from a few cameras.
///
/// Start with `flyrig demo`: it runs a simulated rig, publishes the result, watches it from a second process and
/// writes a report with images. `flyrig eval` does the same honestly on a data set of yours. For a rig that stays
/// up, print a configuration, edit it and run it:
///
///     flyrig doctor
///     flyrig config print > rig.toml
///     flyrig config check rig.toml
///     flyrig run rig.toml
///     flyrig watch --view main --out frames
#[derive(Debug, Parser)]
#[command(version, verbatim_doc_comment)]
pub struct Cli {
    /// Log as one JSON object a line.
    #[arg(long, global = true)]
    pub log_json: bool,
    /// Log more: -v debug, -vv trace. RUST_LOG chooses in detail.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// Part of a graphics adapter's name; the fastest one otherwise.
    #[arg(long, global = true)]
    pub adapter: Option<String>,
    /// Write when each stage ran into this file, for Perfetto (ui.perfetto.dev) or about:tracing.
    #[arg(long, global = true, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the simulated rig with a separate viewer process and write a report.
    Demo(DemoArgs),
    /// Run a rig from a configuration until Ctrl-C.
    Run {
        /// The TOML file; see `flyrig config print`.
        config: PathBuf,
        /// Record the cameras into this MCAP file meanwhile; it must not be there yet.
        #[arg(long)]
        record: Option<PathBuf>,
        /// Show a live table of the cameras in place of a line of rates.
        #[arg(long)]
        table: bool,
    },
    /// Send the cameras of this computer to a rig that runs on another one (source.kind = "network" there) until Ctrl-C. Of
    /// the configuration [rig], [source], [capture], [transport] and [health] count; V4L2 cameras need no calibration.
    Capture {
        /// The TOML file; see `flyrig config print`.
        config: PathBuf,
        /// Key of role "cameras" (`flyrig keys add`): connects to its rig, wherever that is, and listens nowhere.
        #[arg(long)]
        key: Option<PathBuf>,
    },
    /// Record the cameras of a configuration into an MCAP file, without tracking.
    Record(RecordArgs),
    /// Play a recording through, summarise its contents, and export it where asked to. To run the rig on it, set
    /// source.kind = "mcap".
    Replay(ReplayArgs),
    /// Estimate each camera's time offset from the first camera: from the silhouettes of a person where the calibration is
    /// known (recordings, folders), else from motion in the images (live cameras).
    SyncCheck(SyncCheckArgs),
    /// Record the empty scene before each camera (plates): masks are then made from the difference to it.
    Plate(PlateArgs),
    /// Calibrate a rig: print a board, then calibrate lenses and poses from a take that shows it.
    Calibrate {
        #[command(subcommand)]
        action: CalibrateAction,
    },
    /// List cameras with their identifiers, formats and buses, and graphics adapters; suggest fixes.
    Doctor {
        /// A TOML file whose cameras are looked for and whose buses are planned.
        config: Option<PathBuf>,
    },
    /// Walk around the people of a running rig, in a window.
    View(ViewArgs),
    /// Serve a web page on which browsers show the people of a running rig. `flyrig run` does it too, where web.listen is set.
    Serve(ServeArgs),
    /// Give keys to those who may connect to a rig from other computers: viewers, cameras, relays.
    Keys {
        #[command(subcommand)]
        action: KeysAction,
    },
    /// Publish a recorded person stream again, at its own pace, to try viewers without a rig.
    Play(PlayArgs),
    /// Watch a running rig: print rates and latency, write images or a video.
    Watch(WatchArgs),
    /// Replay a data set, render its held-out cameras and score them.
    Eval(EvalArgs),
    /// Build a person's avatar, score it, drive it by recorded motion, export it.
    Avatar {
        #[command(subcommand)]
        action: AvatarAction,
    },
    /// Use the simulated rig by itself.
    Sim {
        #[command(subcommand)]
        action: SimAction,
    },
    /// Train the networks of learned appearance.
    Train(TrainArgs),
    /// Print the commented default configuration, or check one.
    Config {
        #[command(subcommand)]
        action: ConfigAction,
    },
}

#[derive(Debug, Args)]
pub struct RecordArgs {
    /// The TOML file; see `flyrig config print`.
    pub config: PathBuf,
    /// The file; must not be there yet. Foxglove and other MCAP readers open it.
    #[arg(long)]
    pub out: PathBuf,
    /// Stop after so many seconds.
    #[arg(long, value_parser = parse_seconds)]
    pub seconds: Option<f64>,
}

#[derive(Debug, Clone, Default, Args)]
pub struct LagArgs {
    /// Time offset of a camera's timestamps against the other cameras', milliseconds, as CAM=MS; may be repeated. `flyrig
    /// sync-check` estimates it.
    #[arg(long = "lag", value_name = "CAM=MS", value_parser = parse_lag)]
    pub by_camera: Vec<(String, f64)>,
}

impl LagArgs {
    /// The cameras that have one.
    pub fn cameras(&self) -> Vec<String> {
        self.by_camera.iter().map(|(camera, _)| camera.clone()).collect()
    }

    /// Offsets that are subtracted from the timestamps, nanoseconds.
    pub fn nanos(&self) -> BTreeMap<CameraId, i64> {
        self.by_camera.iter().map(|(camera, ms)| (camera.as_str().into(), (ms * 1e6).round() as i64)).collect()
    }
}

#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// The MCAP file.
    pub recording: PathBuf,
    /// Write the synchronised images and the calibration into this new folder (EasyMocap layout).
    #[arg(long)]
    pub export: Option<PathBuf>,
    #[command(flatten)]
    pub lags: LagArgs,
}

#[derive(Debug, Args)]
pub struct SyncCheckArgs {
    /// A configuration (*.toml), a recording (*.mcap), a folder with images/CAM, or the videos of all cameras.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// Seconds that are compared.
    #[arg(long, default_value_t = 20.0, value_parser = parse_seconds)]
    pub seconds: f64,
    /// Seconds of the take that are skipped before: an early and a late part show whether clocks drift.
    #[arg(long, default_value_t = 0.0, value_parser = parse_from_seconds)]
    pub from_secs: f64,
    /// Largest time offset that is searched for, milliseconds.
    #[arg(long, default_value_t = 250.0, value_parser = parse_most_ms)]
    pub most_ms: f64,
    /// Frame rate of a folder.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Folder of a calibration, for an input without one: silhouettes of one person are then compared,
    /// which is more reliable than motion. It replaces the input's own calibration.
    #[arg(long)]
    pub calibration: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
pub enum CalibrateAction {
    /// Write a board to print (SVG, PDF) and its description, board.toml.
    Board(CalibrateBoardArgs),
    /// Calibrate the lens of each camera from a take in which it sees the board in many poses.
    Lens(CalibrateLensArgs),
    /// Calibrate the poses, and time offsets, of all cameras from a take in which they see the board together.
    Rig(CalibrateRigArgs),
    /// Calibrate lenses and poses while the board is shown, with hints what to show next, in the terminal and on a local page.
    Live(CalibrateLiveArgs),
    /// Refine poses and time offsets of calibrated cameras from one person who moves before them.
    Person(CalibratePersonArgs),
    /// Match the colours of calibrated cameras: exposure, white balance, response and vignetting, from people before them.
    Color(CalibrateColorArgs),
    /// Convert a calibration of another program, or to one.
    Convert(CalibrateConvertArgs),
}

/// Patterns of boards.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PatternName {
    /// Squares with markers: any part of the board is recognised.
    Charuco,
    /// Squares alone: the whole board must be in the image.
    Chessboard,
}

/// Sizes of paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Paper {
    A4,
    A3,
    A2,
    A1,
    A0,
}

impl Paper {
    /// Long and short side, millimetres.
    pub fn size_mm(self) -> [f64; 2] {
        match self {
            Self::A4 => [297.0, 210.0],
            Self::A3 => [420.0, 297.0],
            Self::A2 => [594.0, 420.0],
            Self::A1 => [841.0, 594.0],
            Self::A0 => [1189.0, 841.0],
        }
    }
}

#[derive(Debug, Args)]
pub struct CalibrateBoardArgs {
    /// Folder of board.svg, board.pdf and board.toml.
    #[arg(long, default_value = "board")]
    pub out: PathBuf,
    /// Squares along the long side.
    #[arg(long, default_value_t = 9)]
    pub columns: u32,
    /// Squares along the short side.
    #[arg(long, default_value_t = 6)]
    pub rows: u32,
    /// Side of a square, millimetres.
    #[arg(long, default_value_t = 30.0)]
    pub square_mm: f64,
    #[arg(long, value_enum, default_value = "charuco")]
    pub pattern: PatternName,
    /// Dictionary of the markers, as OpenCV names it.
    #[arg(long, default_value = "DICT_5X5_100")]
    pub dictionary: String,
    /// Side of a marker as a share of the square's.
    #[arg(long, default_value_t = 0.75)]
    pub marker: f64,
    /// Paper; a sheet of the board's own size otherwise.
    #[arg(long, value_enum)]
    pub paper: Option<Paper>,
    /// Replace files that are there.
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Args)]
pub struct TakeArgs {
    /// A configuration (*.toml), a recording (*.mcap), a folder with images/CAM, or the videos of all cameras.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// Seconds that are looked at.
    #[arg(long, default_value_t = 120.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Time from one set that is looked at to the next, milliseconds.
    #[arg(long, default_value_t = 100.0, value_parser = parse_most_ms)]
    pub every_ms: f64,
    /// Frame rate of a folder.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
}

#[derive(Debug, Args)]
pub struct CalibrateConvertArgs {
    /// A file or folder of the other program; see --from.
    pub input: PathBuf,
    /// Folder of the new files.
    #[arg(long)]
    pub out: PathBuf,
    /// Format of the input, recognised by its names otherwise: flyrig, easymocap, opencv, kalibr, colmap, nerfstudio, qualisys,
    /// anipose (Pose2Sim and caliscope too), mrcal.
    #[arg(long, value_parser = parse_format)]
    pub from: Option<Format>,
    /// Format of the output, one of the same.
    #[arg(long, value_parser = parse_format, default_value = "flyrig")]
    pub to: Format,
    /// Metres of a unit of length in the input: 0.001 for millimetres; for COLMAP and nerfstudio, whose unit is arbitrary, its length in the room.
    #[arg(long, default_value_t = 1.0, value_parser = parse_scale)]
    pub scale: f64,
    /// Folder with images/CAM, for formats that do not say how large the images are; the input otherwise.
    #[arg(long)]
    pub images: Option<PathBuf>,
    /// Replace files that are there.
    #[arg(long)]
    pub force: bool,
}

fn parse_format(text: &str) -> Result<Format, String> {
    let known = Format::ALL.map(Format::name);
    Format::ALL
        .into_iter()
        .find(|format| format.name() == text)
        .ok_or_else(|| format!("no such format; known: {}", known.join(", ")))
}

fn parse_scale(text: &str) -> Result<f64, String> {
    let scale = text.parse().ok().filter(|scale| (1e-9..=1e9).contains(scale));
    scale.ok_or_else(|| "expected metres of a unit, between 1e-9 and 1e9".to_owned())
}

#[derive(Debug, Args)]
pub struct CalibrateLensArgs {
    #[command(flatten)]
    pub take: TakeArgs,
    /// The board's description, as `flyrig calibrate board` writes it.
    #[arg(long, default_value = "board/board.toml")]
    pub board: PathBuf,
    /// Folder of calibration.toml.
    #[arg(long)]
    pub out: PathBuf,
    /// Replace lenses that are there.
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Args)]
pub struct CalibratePersonArgs {
    /// A configuration (*.toml), a recording (*.mcap), a folder with images/CAM, or the videos of all cameras.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// Folder of the calibration to refine, where the take has none or another one.
    #[arg(long)]
    pub calibration: Option<PathBuf>,
    /// Seconds that are looked at.
    #[arg(long, default_value_t = 20.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Seconds that are left out at the beginning.
    #[arg(long, default_value_t = 0.0, value_parser = parse_from_seconds)]
    pub from_secs: f64,
    /// Frame rate of a folder.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Folder of calibration.toml and calibration.json.
    #[arg(long)]
    pub out: PathBuf,
    /// Take the cameras' stamps as they are.
    #[arg(long)]
    pub no_offsets: bool,
    /// Replace a calibration that is there.
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Args)]
pub struct CalibrateLiveArgs {
    /// A configuration (*.toml), a recording (*.mcap), a folder with images/CAM, or the videos of all cameras.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// The board's description, as `flyrig calibrate board` writes it.
    #[arg(long, default_value = "board/board.toml")]
    pub board: PathBuf,
    /// Folder of the calibration.
    #[arg(long)]
    pub out: PathBuf,
    /// Folder of `flyrig calibrate lens`, or of any calibration; the lenses are calibrated from the same boards otherwise.
    #[arg(long)]
    pub lenses: Option<PathBuf>,
    /// Ends once every camera is known to this in the middle of the boards, millimetres (one standard deviation).
    #[arg(long, default_value_t = 1.0, value_parser = parse_target_mm)]
    pub target_mm: f64,
    /// Address of the page; other computers and telephones reach it at 0.0.0.0:8090.
    #[arg(long, default_value = "127.0.0.1:8090")]
    pub listen: String,
    /// Seconds that are looked at, at most.
    #[arg(long, default_value_t = 1800.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Time from one set that is looked at to the next, milliseconds.
    #[arg(long, default_value_t = 100.0, value_parser = parse_most_ms)]
    pub every_ms: f64,
    /// Frame rate of a folder.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// The take begins with the board on the floor, face up: it gives height 0 and the direction up.
    #[arg(long)]
    pub floor: bool,
    /// Take the cameras' stamps as they are.
    #[arg(long)]
    pub no_offsets: bool,
    /// Replace a calibration that is there.
    #[arg(long)]
    pub force: bool,
}

fn parse_target_mm(text: &str) -> Result<f64, String> {
    let target = text.parse().ok().filter(|target| (0.01..=1000.0).contains(target));
    target.ok_or_else(|| "expected millimetres, between 0.01 and 1000".to_owned())
}

#[derive(Debug, Args)]
pub struct CalibrateColorArgs {
    /// A configuration (*.toml), a recording (*.mcap), a folder with images/CAM, or the videos of all cameras.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// Folder of the calibration whose colours are matched, where the take has none or another one.
    #[arg(long)]
    pub calibration: Option<PathBuf>,
    /// Seconds that are looked at.
    #[arg(long, default_value_t = 10.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Seconds that are left out at the beginning.
    #[arg(long, default_value_t = 0.0, value_parser = parse_from_seconds)]
    pub from_secs: f64,
    /// Frame rate of a folder.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// People who are followed at most.
    #[arg(long, default_value_t = 1)]
    pub people: usize,
    /// Folder of calibration.toml and calibration.json.
    #[arg(long)]
    pub out: PathBuf,
    /// Replace a calibration that is there.
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Args)]
pub struct CalibrateRigArgs {
    #[command(flatten)]
    pub take: TakeArgs,
    /// The board's description, as `flyrig calibrate board` writes it.
    #[arg(long, default_value = "board/board.toml")]
    pub board: PathBuf,
    /// Folder of calibration.toml and calibration.json.
    #[arg(long)]
    pub out: PathBuf,
    /// Folder of `flyrig calibrate lens`, or of any calibration; the lenses are calibrated from the take otherwise.
    #[arg(long)]
    pub lenses: Option<PathBuf>,
    /// Solve for the lenses together with the poses.
    #[arg(long)]
    pub refine_lenses: bool,
    /// The take begins with the board on the floor, face up: it gives height 0 and the direction up.
    #[arg(long)]
    pub floor: bool,
    /// Take the cameras' stamps as they are.
    #[arg(long)]
    pub no_offsets: bool,
    /// Replace a calibration that is there.
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Args)]
pub struct PlateArgs {
    /// A configuration (*.toml), a recording (*.mcap) or a folder with images/CAM.
    pub input: PathBuf,
    /// Folder of the calibration or data set; background/CAM.png are written into it.
    #[arg(long)]
    pub out: PathBuf,
    /// Seconds over which each pixel's median is taken.
    #[arg(long, default_value_t = 3.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Frame rate of a folder.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Replace plates that are there, and accept images in which somebody is found.
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Subcommand)]
pub enum SimAction {
    /// Write a simulated capture as a folder that `flyrig eval` and other tools read (EasyMocap layout), with the truth.
    Export(SimExportArgs),
}

#[derive(Debug, Args)]
pub struct SimExportArgs {
    /// The TOML file whose [sim] section is simulated; the default configuration without one.
    pub config: Option<PathBuf>,
    /// Folder to write; must not be there yet.
    #[arg(long)]
    pub out: PathBuf,
    /// Frames of every camera.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub frames: u64,
    /// Leave out depth, canonical positions, poses, surfaces and true times.
    #[arg(long)]
    pub no_truth: bool,
}

#[derive(Debug, Subcommand)]
pub enum ConfigAction {
    /// Print the default configuration with a comment on every key.
    Print,
    /// Read a configuration and say whether it is right.
    Check {
        /// The TOML file.
        config: PathBuf,
    },
}

impl DemoArgs {
    /// How the demo finds its person.
    pub fn perception(&self) -> PerceptionSettings {
        let Self { pose, masks, shape, .. } = *self;
        PerceptionSettings { pose, masks, shape, ..PerceptionSettings::default() }
    }
}

#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Folder of the report; created, its old report replaced.
    #[arg(long, default_value = "out/demo")]
    pub out: PathBuf,
    /// Frames of the simulated rig.
    #[arg(long, default_value_t = 60, conflicts_with = "minutes")]
    pub frames: usize,
    /// Run for so long instead, the motion repeating.
    #[arg(long, value_parser = parse_minutes)]
    pub minutes: Option<f64>,
    /// Seed of the person and the room.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// "turn", "walk", "wave", "squat", "reach", "sit", "lie", "jump", "cross-arms", "dance", "still", "by-seed", "bvh" (a captured
    /// walk from Debian's assimp-testmodels), or a *.bvh, *.glb or *.gltf file.
    #[arg(long, default_value = "turn")]
    pub motion: String,
    /// TOML file with faults of cameras and clocks, like sim/assets/faults.toml.
    #[arg(long)]
    pub faults: Option<PathBuf>,
    /// Pose from the images, or from the simulator.
    #[arg(long, value_enum, default_value = "estimated")]
    pub pose: Origin,
    /// Masks from the images and the empty room, or from the simulator.
    #[arg(long, value_enum, default_value = "estimated")]
    pub masks: Origin,
    /// Shape of the body from the images, or from the simulator; by default from where the pose comes.
    #[arg(long, value_enum)]
    pub shape: Option<Origin>,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT)]
    pub gaussians: usize,
    #[command(flatten)]
    pub tracking: TrackingSettings,
    #[command(flatten)]
    pub appearance: AppearanceOptions,
    #[command(flatten)]
    pub budget: BudgetSettings,
    /// Also score the modes that `direct` adds to (takes three times as long).
    #[arg(long)]
    pub ablation: bool,
    /// Address of the demo's publisher; port 0 takes a free one.
    #[arg(long, default_value = "127.0.0.1:0")]
    pub listen: SocketAddr,
}

/// A running rig.
#[derive(Debug, Args)]
pub struct RigArgs {
    /// Key file for a rig of another computer (`flyrig keys add`); a rig of this computer needs none.
    #[arg(id = "key_file", value_name = "KEY")]
    pub key: Option<PathBuf>,
    /// Name of the rig; that of the key otherwise, or "flyrig".
    #[arg(long, conflicts_with = "key_file")]
    pub rig: Option<String>,
    /// Where the rig or a router listens (zenoh endpoint); the addresses of the key otherwise, or "tcp/127.0.0.1:7447".
    #[arg(long)]
    pub connect: Option<String>,
}

impl RigArgs {
    /// Returns the settings of a session with that rig.
    ///
    /// # Errors
    /// Those of the key file.
    pub fn transport(&self) -> Result<TransportConfig, AccessError> {
        let mut config = match &self.key {
            Some(path) => {
                let mut key = KeyFile::read(path, &[Role::Viewer, Role::Relay])?;
                if let Some(address) = &self.connect {
                    let bare = ["tls/", "tcp/"].iter().find_map(|protocol| address.strip_prefix(protocol));
                    key.connect = vec![bare.unwrap_or(address).to_owned()];
                }
                return Ok(TransportConfig::with_key(key));
            }
            None => TransportConfig::subscriber(self.rig.as_deref().unwrap_or("flyrig")),
        };
        if let Some(endpoint) = &self.connect {
            config.connect = vec![endpoint.clone()];
        }
        Ok(config)
    }
}

#[derive(Debug, Args)]
pub struct RingArgs {
    /// Folder of the rig's keys; the only one in this folder otherwise.
    #[arg(long)]
    pub ring: Option<PathBuf>,
}

/// A key to make.
#[derive(Debug, Args)]
pub struct NewKeyArgs {
    /// Days after which it is refused.
    #[arg(long, default_value_t = 365)]
    pub days: u64,
    /// The file; NAME.key otherwise.
    #[arg(long)]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub ring: RingArgs,
}

#[derive(Debug, Subcommand)]
pub enum KeysAction {
    /// Make the folder of a rig's keys.
    New {
        /// Name of the rig, as rig.name in its configuration.
        rig: String,
        /// Name or address by which other computers reach this one; may be repeated.
        #[arg(long = "host", required = true, value_name = "NAME")]
        hosts: Vec<String>,
        /// Port for viewers; cameras of other computers have the next.
        #[arg(long, default_value_t = DEFAULT_PORT)]
        port: u16,
        /// The folder; RIG-keys otherwise.
        #[arg(long)]
        out: Option<PathBuf>,
    },
    /// Make a key: one file for its holder, who needs nothing else.
    Add {
        /// Name of the holder.
        name: String,
        /// Role: "viewer" watches, "cameras" sends camera images, "relay" watches and serves other viewers.
        #[arg(long, default_value = "viewer", value_parser = parse_role)]
        role: Role,
        #[command(flatten)]
        file: NewKeyArgs,
    },
    /// List everybody who was given a key.
    List {
        #[command(flatten)]
        ring: RingArgs,
    },
    /// Make a new key of a holder; the old one is refused from then on.
    Renew {
        /// Name of the holder.
        name: String,
        #[command(flatten)]
        file: NewKeyArgs,
    },
    /// Refuse a holder from now on; a running rig disconnects it within a second.
    Revoke {
        /// Name of the holder.
        name: String,
        #[command(flatten)]
        ring: RingArgs,
    },
}

fn parse_role(text: &str) -> Result<Role, String> {
    let known = Role::ALL.map(Role::name);
    Role::ALL
        .into_iter()
        .find(|role| role.name() == text)
        .ok_or_else(|| format!("no such role; known: {}", known.join(", ")))
}

#[derive(Debug, Args)]
pub struct WatchArgs {
    #[command(flatten)]
    pub rig: RigArgs,
    /// A published view; or ask for one of your own with --eye.
    #[arg(long, default_value = "main")]
    pub view: String,
    /// Ask for a viewpoint of your own: camera position x,y,z in metres of the rig's world.
    #[arg(long, value_parser = parse_vec3, allow_hyphen_values = true)]
    pub eye: Option<[f64; 3]>,
    /// Point that the viewpoint of --eye looks at.
    #[arg(long, value_parser = parse_vec3, allow_hyphen_values = true, default_value = "0,0,1")]
    pub target: [f64; 3],
    /// Size of the viewpoint of --eye, WIDTHxHEIGHT.
    #[arg(long, value_parser = parse_size, default_value = "512x512")]
    pub size: [u32; 2],
    /// Vertical field of view of the viewpoint of --eye, degrees.
    #[arg(long, default_value_t = 40.0)]
    pub fov_degrees: f64,
    /// Most images a second of the viewpoint of --eye; viewers share the rig's budget of pixels a second.
    #[arg(long, default_value_t = 30.0)]
    pub max_fps: f64,
    /// Write every image as PNG into this folder, or, when the name ends in .mp4 or .avi, a video.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Record the person stream into this file (MCAP), for `flyrig play`; no images are received then.
    #[arg(long, conflicts_with_all = ["out", "eye", "count", "stats"])]
    pub record: Option<PathBuf>,
    /// Stop after so many images.
    #[arg(long)]
    pub count: Option<usize>,
    /// Stop after so many seconds.
    #[arg(long, value_parser = parse_seconds)]
    pub seconds: Option<f64>,
    /// Stop when the rig ends its session.
    #[arg(long)]
    pub until_end: bool,
    /// Write rates and latency as JSON at the end.
    #[arg(long)]
    pub stats: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct PlayArgs {
    /// Recording of `flyrig watch --record`.
    pub recording: PathBuf,
    /// Name of the rig that it is published as.
    #[arg(long, default_value = "flyrig")]
    pub rig: String,
    /// Where viewers of this computer connect (zenoh endpoint).
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    pub listen: String,
    /// Folder of the rig's keys: their holders connect from other computers.
    #[arg(long)]
    pub keys: Option<PathBuf>,
    /// Listen on addresses that other computers reach without keys: in trusted networks only.
    #[arg(long)]
    pub insecure: bool,
    /// Begin again at the end, until Ctrl-C.
    #[arg(long)]
    pub repeat: bool,
    /// Begin when the first viewer is there.
    #[arg(long)]
    pub wait: bool,
    /// Pace against that of the recording.
    #[arg(long, default_value_t = 1.0, value_parser = parse_speed)]
    pub speed: f64,
}

#[derive(Debug, Args)]
pub struct ViewArgs {
    #[command(flatten)]
    pub rig: RigArgs,
    /// Show the newest frame at once; without it, motion is interpolated and shown a frame and a half later.
    #[arg(long)]
    pub lowest_latency: bool,
    /// Move along with the person from the start (F).
    #[arg(long)]
    pub follow: bool,
    /// Name of the rig's camera to stand at first.
    #[arg(long)]
    pub camera: Option<String>,
    /// Size of the window, WIDTHxHEIGHT.
    #[arg(long, value_parser = parse_size, default_value = "1280x720")]
    pub size: [u32; 2],
    /// Save the window as PNG as soon as a person is shown with all colours, and close it.
    #[arg(long)]
    pub screenshot: Option<PathBuf>,
    /// Close after so many seconds.
    #[arg(long, value_parser = parse_seconds)]
    pub seconds: Option<f64>,
}

#[derive(Debug, Args)]
pub struct ServeArgs {
    #[command(flatten)]
    pub rig: RigArgs,
    /// Folder of keys of this relay (`flyrig keys new RIG --host THIS-COMPUTER`): their holders watch the rig through it with `flyrig view`.
    #[arg(long, value_name = "FOLDER")]
    pub keys: Option<PathBuf>,
    #[command(flatten)]
    pub web: WebConfig,
}

#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Folder in EasyMocap layout: intri.yml, extri.yml, images/CAM, optional mask/CAM and a skinned *.glb. Or a calibrated recording,
    /// *.mcap.
    pub dataset: PathBuf,
    /// Cameras that go in, comma separated.
    #[arg(long, value_delimiter = ',', required = true)]
    pub inputs: Vec<String>,
    /// Cameras to render and score, comma separated.
    #[arg(long, value_delimiter = ',', required = true)]
    pub holdout: Vec<String>,
    /// Folder for images, surfaces and the report.
    #[arg(long)]
    pub out: PathBuf,
    #[command(flatten)]
    pub perception: PerceptionSettings,
    #[command(flatten)]
    pub body: BodySettings,
    /// The person's avatar (`flyrig avatar build`): tracking and colours start from it.
    #[arg(long, value_name = "FILE")]
    pub avatar: Option<PathBuf>,
    #[command(flatten)]
    pub tracking: TrackingSettings,
    #[command(flatten)]
    pub appearance: AppearanceOptions,
    #[command(flatten)]
    pub budget: BudgetSettings,
    /// Frames FIRST..END, END excluded; all of them otherwise.
    #[arg(long, value_parser = parse_range)]
    pub frames: Option<Range<u64>>,
    /// Frame rate of the folder; a recording has its own.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    #[command(flatten)]
    pub lags: LagArgs,
}

fn parse_vec3(text: &str) -> Result<[f64; 3], String> {
    let numbers: Vec<f64> =
        text.split(',').filter_map(|n| n.trim().parse().ok()).filter(|n: &f64| n.is_finite()).collect();
    numbers.try_into().ok().filter(|_| text.split(',').count() == 3).ok_or_else(|| format!("'{text}' is not x,y,z"))
}

fn parse_most_ms(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(ms) if (4.0..=1000.0).contains(&ms) => Ok(ms),
        _ => Err(format!("'{text}' is not between 4 and 1000 milliseconds")),
    }
}

fn parse_from_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..=1e6).contains(&seconds) => Ok(seconds),
        _ => Err(format!("'{text}' is not between 0 and 1000000 seconds")),
    }
}

fn parse_lag(text: &str) -> Result<(String, f64), String> {
    let parts = text.split_once('=').and_then(|(camera, lag)| Some((camera.to_owned(), lag.parse::<f64>().ok()?)));
    match parts {
        Some((camera, lag)) if !camera.is_empty() && lag.abs() <= 1000.0 => Ok((camera, lag)),
        _ => Err(format!(
            "'{text}' is not CAM=MS, a camera and its time offset in milliseconds like 03=-50.2 (at most 1000)"
        )),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn odd_arguments_are_refused() {
        assert_eq!(parse_vec3("1,-2.5,3"), Ok([1.0, -2.5, 3.0]));
        for bad in ["", "1,2", "1,2,3,4", "a,b,c", "1,2,nan", "1,,3"] {
            assert!(parse_vec3(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_range("3..7"), Ok(3..7));
        for bad in ["3", "7..3", "3..3", "-1..4", "a..b"] {
            assert!(parse_range(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_size("640x480"), Ok([640, 480]));
        let lag = |text: &str| parse_lag(text).ok();
        assert_eq!(lag("03=-50.2"), Some(("03".to_owned(), -50.2)));
        assert!(["", "03", "03=", "=3", "03=nan", "03=2000", "03:3"].into_iter().all(|bad| lag(bad).is_none()));
        assert!(Cli::try_parse_from(["flyrig", "watch", "--eye", "-1,2,3", "--target", "-1,0,1"]).is_ok());
        for bad in ["0x0", "640", "640x100000", "x"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn the_service_file_starts_what_there_is() {
        let service = include_str!("../../../packaging/flyrig.service");
        let start = service.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let cli = Cli::try_parse_from(start.split_whitespace()).unwrap();
        assert!(matches!(cli.command, Command::Run { .. }));
        assert!(service.contains("Type=notify") && service.contains("WatchdogSec="));
    }
}
