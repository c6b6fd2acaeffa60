//! The command line.

use std::path::PathBuf;

use clap::{Parser, Subcommand};
use flyrig_report::arguments::ProgramArgs;
use flyrig_training::TrainArgs;

use crate::{
    avatar::AvatarAction, calibrate::CalibrateAction, demo::DemoArgs, eval::EvalArgs, keys::KeysAction,
    plate::PlateArgs, recording::RecordArgs, replay::ReplayArgs, serve::ServeArgs, sim_export::SimAction,
    stream_recording::PlayArgs, sync_check::SyncCheckArgs, view::ViewArgs, watch::WatchArgs,
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

/// Subcommands of `flyrig config`.
#[derive(Debug, Subcommand)]
pub enum ConfigAction {
    /// Print the default configuration with a comment on every key.
    Print,
    /// Check a configuration, and the simulator's file that it names.
    Check {
        /// Configuration (TOML).
        config: PathBuf,
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
    fn the_service_file_starts_what_there_is() {
        let service = include_str!("../../../packaging/flyrig.service");
        let start = service.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let cli = Cli::try_parse_from(start.split_whitespace()).unwrap();
        assert!(matches!(cli.command, Command::Run { .. }));
        assert!(service.contains("Type=notify") && service.contains("WatchdogSec="));
    }
}
