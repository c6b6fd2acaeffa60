//! Groups of arguments that several commands share.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use anyhow::{Result, ensure};
use clap::Args;
use flyrig_access::{KeyFile, Role};
use flyrig_fusion::TrackingSettings;
use flyrig_gpu::GpuContext;
use flyrig_report::arguments::{FpsArgs, FramesArgs, parse_seconds};
use flyrig_takes::{Take, TakeOptions, check_take};
use flyrig_transport::TransportConfig;
use flyrig_types::CameraId;

use crate::{
    opening::open_take,
    take_choices::{PerceptionArgs, cameras_of},
};

/// Cameras to read: live ones or a take.
#[derive(Debug, Clone, Args)]
pub struct InputArgs {
    /// A configuration (*.toml), a recording (*.mcap), a folder with images/CAM, or the videos of all cameras.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    #[command(flatten)]
    pub rate: FpsArgs,
}

/// Part of the input that is used.
#[derive(Debug, Clone, Args)]
pub struct SpanArgs {
    /// Seconds of the input that are used.
    #[arg(long, default_value_t = 20.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Seconds that are skipped at the beginning.
    #[arg(long, default_value_t = 0.0, value_parser = parse_from_seconds)]
    pub from_secs: f64,
}

/// Calibration of an input.
#[derive(Debug, Clone, Args)]
pub struct CalibrationArgs {
    /// Folder of a calibration that replaces that of the input; required where the input has none.
    #[arg(long)]
    pub calibration: Option<PathBuf>,
}

/// Cameras with a calibration, and the part of them that is used.
#[derive(Debug, Clone, Args)]
pub struct CalibratedInputArgs {
    #[command(flatten)]
    pub source: InputArgs,
    #[command(flatten)]
    pub calibration: CalibrationArgs,
    #[command(flatten)]
    pub span: SpanArgs,
}

impl CalibratedInputArgs {
    /// Opens the take. `gpu` opens a graphics adapter, for simulated cameras alone.
    ///
    /// # Errors
    /// Names a file, camera or setting that is missing or wrong.
    pub fn open(&self, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Take> {
        let calibration = self.calibration.calibration.as_deref();
        let options = TakeOptions { fps: self.source.rate.fps, calibration, ..TakeOptions::default() };
        open_take(&self.source.input, &options, gpu)
    }
}

/// Folder that a command writes a calibration, a board or plates to.
#[derive(Debug, Clone, Args)]
pub struct TargetArgs {
    /// Folder of the new files.
    #[arg(long)]
    pub out: PathBuf,
    /// Replace files that exist already.
    #[arg(long)]
    pub force: bool,
}

/// Board of a calibration.
#[derive(Debug, Clone, Args)]
pub struct BoardArgs {
    /// Description of the board, as `flyrig calibrate board` writes it.
    #[arg(long, default_value = "board/board.toml")]
    pub board: PathBuf,
}

/// Inputs of the calibration of a rig from boards.
#[derive(Debug, Clone, Args)]
pub struct SolveArgs {
    #[command(flatten)]
    pub board: BoardArgs,
    /// Folder of `flyrig calibrate lens`, or of any calibration, whose lenses are used; without it the lenses are calibrated from the
    /// same boards.
    #[arg(long)]
    pub lenses: Option<PathBuf>,
    /// The take begins with the board on the floor, face up: it defines height 0 and the upward direction.
    #[arg(long)]
    pub floor: bool,
    /// Use the timestamps of the cameras unchanged, without estimating time offsets.
    #[arg(long)]
    pub no_offsets: bool,
}

/// End of a live command.
#[derive(Debug, Clone, Args)]
pub struct StopArgs {
    /// Stop after this many seconds.
    #[arg(long, value_parser = parse_seconds)]
    pub seconds: Option<f64>,
}

/// Cameras that are rendered and scored.
#[derive(Debug, Clone, Args)]
pub struct HoldoutArgs {
    /// Cameras to render and score, comma separated.
    #[arg(long, value_delimiter = ',', value_parser = parse_camera, required = true)]
    pub holdout: Vec<String>,
}

/// A recorded take, and how its person is tracked.
#[derive(Debug, Clone, Args)]
pub struct DatasetArgs {
    /// Folder in EasyMocap layout: a calibration, images/CAM, optional mask/CAM and a skinned *.glb. Or a calibrated recording, *.mcap.
    pub dataset: PathBuf,
    /// Input cameras, comma separated; by default all cameras that are not held out.
    #[arg(long, value_delimiter = ',', value_parser = parse_camera)]
    pub inputs: Vec<String>,
    #[command(flatten)]
    pub range: FramesArgs,
    #[command(flatten)]
    pub rate: FpsArgs,
    #[command(flatten)]
    pub perception: PerceptionArgs,
    #[command(flatten)]
    pub tracking: TrackingSettings,
    #[command(flatten)]
    pub lags: LagArgs,
    #[command(flatten)]
    pub trust: TrustArgs,
}

/// Check of a take's calibration.
#[derive(Debug, Clone, Copy, Args)]
pub struct TrustArgs {
    /// Take the calibration as it is: otherwise that of a folder which was never checked is measured on the person in it, and corrected
    /// where that agrees better.
    #[arg(long)]
    pub trust_calibration: bool,
}

impl TrustArgs {
    /// Checks the calibration of a folder that was never checked, unless it is trusted.
    ///
    /// # Errors
    /// The calibration cannot be read, or what was found cannot be written.
    pub fn check(self, take: &Path, fps: f64, gpu: &GpuContext) -> Result<()> {
        if self.trust_calibration { Ok(()) } else { check_take(take, fps, &|| Ok(gpu.clone())) }
    }
}

impl DatasetArgs {
    /// Checks the calibration, and returns the arguments with the cameras and the sources of pose, masks and shape that the command line
    /// leaves open; prints the sources.
    ///
    /// # Errors
    /// The take has no calibration, no such images, or a damaged glTF file.
    pub fn resolve(&self, command: &str, holdout: &[String], gpu: &GpuContext) -> Result<Self> {
        self.trust.check(&self.dataset, self.rate.fps, gpu)?;
        let mut chosen = self.clone();
        if chosen.inputs.is_empty() {
            chosen.inputs = cameras_of(&self.dataset, holdout)?;
        }
        chosen.perception.choose(&self.dataset, &chosen.inputs)?;
        eprintln!("{command}: {}", chosen.perception.sources());
        Ok(chosen)
    }
}

/// Time offsets of cameras.
#[derive(Debug, Clone, Default, Args)]
pub struct LagArgs {
    /// Time offset of a camera's timestamps from the other cameras', milliseconds, as CAM=MS; may be repeated. `flyrig sync-check`
    /// estimates it.
    #[arg(long = "lag", value_name = "CAM=MS", value_parser = parse_lag)]
    pub by_camera: Vec<(String, f64)>,
}

impl LagArgs {
    /// Returns the names of the cameras with an offset.
    pub fn cameras(&self) -> Vec<String> {
        self.by_camera.iter().map(|(camera, _)| camera.clone()).collect()
    }

    /// Returns the offsets to subtract from the timestamps, nanoseconds.
    pub fn nanos(&self) -> BTreeMap<CameraId, i64> {
        self.by_camera.iter().map(|(camera, ms)| (camera.as_str().into(), (ms * 1e6).round() as i64)).collect()
    }
}

/// Connection to a running rig.
#[derive(Debug, Args)]
pub struct RigArgs {
    /// Key file (`flyrig keys add`) for a rig on another computer; a rig on this computer needs none.
    #[arg(id = "key_file", value_name = "KEY")]
    pub key: Option<PathBuf>,
    /// Name of the rig; that of the key otherwise, or "flyrig".
    #[arg(long, conflicts_with = "key_file")]
    pub rig: Option<String>,
    /// Address of the rig or of a router (zenoh endpoint); the addresses of the key otherwise, or "tcp/127.0.0.1:7447".
    #[arg(long)]
    pub connect: Option<String>,
}

impl RigArgs {
    /// Returns the settings of a session with the rig.
    ///
    /// # Errors
    /// The key file does not exist; others of [`KeyFile::read`].
    pub fn transport(&self) -> Result<TransportConfig> {
        let mut config = match &self.key {
            Some(path) => {
                ensure!(
                    path.exists(),
                    "{} does not exist; `flyrig keys add NAME` makes a key, on the rig's computer",
                    path.display()
                );
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

/// Parses 4 to 1000 milliseconds.
///
/// # Errors
/// Names the range.
pub fn parse_most_ms(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(ms) if (4.0..=1000.0).contains(&ms) => Ok(ms),
        _ => Err(format!("'{text}' is not between 4 and 1000 milliseconds")),
    }
}

/// Parses the name of a camera; "01, 02" is the same list as "01,02".
///
/// # Errors
/// The name is empty.
fn parse_camera(text: &str) -> Result<String, String> {
    match text.trim() {
        "" => Err("a camera's name is empty; names are separated by commas, as in 01,02,04".to_owned()),
        name => Ok(name.to_owned()),
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
    use super::*;

    #[test]
    fn offsets_of_cameras_are_parsed() {
        let lag = |text: &str| parse_lag(text).ok();
        assert_eq!(lag("03=-50.2"), Some(("03".to_owned(), -50.2)));
        assert!(["", "03", "03=", "=3", "03=nan", "03=2000", "03:3"].into_iter().all(|bad| lag(bad).is_none()));
    }
}
