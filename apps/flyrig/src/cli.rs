//! The command line.

use std::{
    env,
    path::{Path, PathBuf},
    slice::from_ref,
};

use clap::{
    Parser, Subcommand,
    error::{ContextKind, ContextValue, ErrorKind},
};
use flyrig_report::arguments::ProgramArgs;
use flyrig_training::TrainArgs;

use crate::{
    arguments::TrustArgs, avatar::AvatarAction, calibrate::CalibrateAction, demo::DemoArgs, eval::EvalArgs,
    import::ImportArgs, keys::KeysAction, mesh::MeshArgs, plate::PlateArgs, recording::RecordArgs, replay::ReplayArgs,
    serve::ServeArgs, sim_export::SimAction, stream_recording::PlayArgs, sync_check::SyncCheckArgs, view::ViewArgs,
    watch::WatchArgs,
};

/// Live free-viewpoint video of a person from a few cameras.
///
/// Start with `flyrig demo`: it runs a simulated rig, publishes the result, watches it from a second process and
/// writes a report with images. `flyrig eval` scores a data set of yours against held-out cameras. For a permanent
/// rig, print a configuration, edit it and run it:
///
///     flyrig doctor
///     flyrig config print > rig.toml
///     flyrig config check rig.toml
///     flyrig run rig.toml
///     flyrig watch --view main --out frames
#[derive(Debug, Parser)]
#[command(version, verbatim_doc_comment)]
pub struct Cli {
    /// Log one JSON object per line.
    #[arg(long, global = true)]
    pub log_json: bool,
    #[command(flatten)]
    pub program: ProgramArgs,
    #[command(subcommand)]
    pub command: Command,
}

impl Cli {
    /// Parses the command line of this process; ends it with help or an error.
    pub fn from_arguments() -> Self {
        Self::try_parse().unwrap_or_else(|mut error| {
            let words: Vec<String> = env::args_os().map(|word| word.to_string_lossy().into_owned()).collect();
            if let (ErrorKind::UnknownArgument, Some(tip)) = (error.kind(), list_tip(&words)) {
                error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip.into()]));
            }
            error.exit()
        })
    }
}

/// Returns how a list of cameras is written, if one was written with blanks.
fn list_tip(words: &[String]) -> Option<String> {
    let is_list = |word: &String| word == "--inputs" || word == "--holdout";
    words.windows(3).filter(|words| is_list(&words[0])).find_map(|words| {
        let (first, second) = (words[1].trim_end_matches(','), words[2].trim_end_matches(','));
        let is_name = |word: &str| !word.is_empty() && !word.starts_with('-') && !word.contains(',');
        let list = || format!("names of cameras are comma separated: {} {first},{second}", words[0]);
        (is_name(first) && is_name(second)).then(list)
    })
}

/// Subcommands of `flyrig`.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the simulated rig with a separate viewer process and write a report.
    Demo(DemoArgs),
    /// Run a rig from a configuration until Ctrl-C.
    Run {
        /// Configuration (TOML); see `flyrig config print`.
        config: PathBuf,
        /// Record the cameras into this new MCAP file as well.
        #[arg(long)]
        record: Option<PathBuf>,
        /// Show a live table of the cameras instead of a line of rates.
        #[arg(long)]
        table: bool,
        #[command(flatten)]
        trust: TrustArgs,
    },
    /// Send the cameras of this computer to a rig on another one (source.kind = "network" there) until Ctrl-C. Uses the tables [rig],
    /// [source], [capture], [transport] and [health] of the configuration; V4L2 cameras need no calibration.
    Capture {
        /// Configuration (TOML); see `flyrig config print`.
        config: PathBuf,
        /// Key of role "cameras" (`flyrig keys add`): connect to its rig, and do not listen.
        #[arg(long)]
        key: Option<PathBuf>,
    },
    /// Record the cameras of a configuration into an MCAP file, without tracking.
    Record(RecordArgs),
    /// Make a take of videos or images and a calibration of other programs, and correct the calibration by the person in it.
    Import(ImportArgs),
    /// Read a recording, print a summary, and export it with --export. To run the rig on it, set source.kind = "mcap".
    Replay(ReplayArgs),
    /// Estimate each camera's time offset from the first camera: from silhouettes of a person where the calibration is known
    /// (recordings, folders), otherwise from motion in the images (live cameras).
    SyncCheck(SyncCheckArgs),
    /// Record images of the empty scene (plates), from which masks are computed by difference.
    Plate(PlateArgs),
    /// Calibrate a rig: print a board, then calibrate lenses and poses from a take that shows it.
    Calibrate {
        #[command(subcommand)]
        action: CalibrateAction,
    },
    /// List cameras with identifiers, formats and buses, and graphics adapters; suggest fixes of problems.
    Doctor {
        /// Configuration whose cameras are checked, with the bandwidth of their buses.
        config: Option<PathBuf>,
    },
    /// Show the people of a running rig in a window, from freely chosen viewpoints.
    View(ViewArgs),
    /// Serve a web page on which browsers show the people of a running rig. `flyrig run` serves it as well where web.listen is set.
    Serve(ServeArgs),
    /// Manage the keys with which viewers, cameras and relays connect to a rig from other computers.
    Keys {
        #[command(subcommand)]
        action: KeysAction,
    },
    /// Publish a recorded person stream at its original pace, to test viewers without a rig; or make a film of it with --orbit.
    Play(PlayArgs),
    /// Print rates and latency of a running rig, write images or a video.
    Watch(WatchArgs),
    /// Evaluate a take: hold cameras out, render them and score them; write a report, a page that plays the take in 3D, and a film.
    Eval(EvalArgs),
    /// Build the avatar of a person, score it, drive it by recorded motion, export it.
    Avatar {
        #[command(subcommand)]
        action: AvatarAction,
    },
    /// Write the person of a take, or an avatar, as a closed mesh with texture and bones (glTF, USDZ, OBJ, 3MF, PLY); or the splats of
    /// another tool (*.ply) as one without bones.
    Mesh(MeshArgs),
    /// Print the default configuration of the simulated rig, or export a simulated capture.
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

impl Command {
    /// Returns the line that a command prints at once if it takes a while to open its input; the commands themselves print what follows.
    pub fn first_line(&self) -> Option<String> {
        let cameras = |name: &str, config: &Path| Some(format!("{name}: opening the cameras of {}", config.display()));
        let take = |name: &str, paths: &[PathBuf]| {
            let paths: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
            Some(format!("{name}: opening {}", paths.join(", ")))
        };
        match self {
            Self::Demo(_) => Some("demo: simulating a rig".to_owned()),
            Self::Run { config, .. } => cameras("run", config),
            Self::Record(args) => cameras("record", &args.config),
            Self::Capture { config, .. } => cameras("capture", config),
            Self::Replay(args) => take("replay", from_ref(&args.recording)),
            Self::Import(args) => take("import", &args.inputs),
            Self::SyncCheck(args) => take("sync-check", &args.input.source.input),
            Self::Plate(args) => take("plate", from_ref(&args.input)),
            Self::Calibrate { action } => action.input().and_then(|(name, paths)| take(name, paths)),
            Self::Eval(args) => take("eval", from_ref(&args.take.dataset)),
            Self::Mesh(args) => take("mesh", from_ref(&args.take.dataset)),
            Self::Avatar { action } => action.input().and_then(|(name, path)| take(name, from_ref(path))),
            Self::Sim { action: SimAction::Export(args) } => {
                Some(format!("sim export: simulating {} frames for {}", args.frames, args.out.display()))
            }
            Self::Train(args) => Some(format!("train: preparing the samples of {}", args.out.display())),
            Self::Sim { action: SimAction::Print }
            | Self::Doctor { .. }
            | Self::View(_)
            | Self::Serve(_)
            | Self::Watch(_)
            | Self::Play(_)
            | Self::Keys { .. }
            | Self::Config { .. } => None,
        }
    }
}

/// Subcommands of `flyrig config`.
#[derive(Debug, Subcommand)]
pub enum ConfigAction {
    /// Print the default configuration with a comment on every key.
    Print,
    /// Check a configuration, and open the files, folders and addresses that it names.
    Check {
        /// Configuration (TOML).
        config: PathBuf,
        /// Check the text alone, with the simulator's file: nothing else that it names is opened.
        #[arg(long)]
        offline: bool,
    },
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn numbers_with_a_minus_are_no_options() {
        assert!(Cli::try_parse_from(["flyrig", "watch", "--eye", "-1,2,3", "--target", "-1,0,1"]).is_ok());
    }

    #[test]
    fn a_list_with_blanks_is_answered_with_commas() {
        let tip = |line: &str| list_tip(&line.split(' ').map(str::to_owned).collect::<Vec<_>>());
        let expected = Some("names of cameras are comma separated: --inputs 00,02".to_owned());
        assert_eq!(tip("flyrig eval take --inputs 00 02 --holdout 01"), expected);
        assert_eq!(tip("flyrig eval take --inputs 00, 02"), expected);
        for other in ["flyrig eval take --inputs 00 --holdout 01", "flyrig eval --inputs 00,02 take", "flyrig eval a b"]
        {
            assert_eq!(tip(other), None, "{other}");
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
