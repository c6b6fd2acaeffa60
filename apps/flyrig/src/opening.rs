//! Takes that the commands open: what a command line names, or the cameras of a configuration.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use flyrig_gpu::GpuContext;
use flyrig_monitor::ImageOrigin;
use flyrig_takes::{Needs, SourceKind, Take, TakeInput, TakeOptions};

use crate::config::Config;

/// Opens the take that a command line names. `gpu` opens a graphics adapter, for simulated cameras alone.
///
/// # Errors
/// Names a file, camera or setting that is missing or wrong.
pub fn open_take(paths: &[PathBuf], options: &TakeOptions<'_>, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Take> {
    let read = |path: &Path| {
        let config = match options.needs {
            Needs::Frames => Config::load_for_capture(path)?,
            Needs::Calibration => Config::load(path)?,
        };
        Ok(config.take().lossless())
    };
    Take::open(&TakeInput::from_paths(paths, read)?, options, gpu)
}

/// Opens the cameras of a configuration; only simulated ones need `gpu`.
///
/// # Errors
/// Names a file, camera or setting that is missing or wrong.
pub fn open_cameras(config: &Config, needs: Needs, gpu: Option<&GpuContext>) -> Result<Take> {
    let input = TakeInput::Configuration(Box::new(config.take()));
    let gpu = || gpu.cloned().context("the simulated rig needs a graphics adapter");
    Take::open(&input, &TakeOptions { needs, ..TakeOptions::default() }, &gpu)
}

/// Checks that a path is a file, and neither a folder nor a configuration, before it is read as a recording. `read` says what is read by
/// which command, and `instead` which command reads a folder.
///
/// # Errors
/// Says what is there, and what to use.
pub fn require_recording(path: &Path, read: &str, instead: &str) -> Result<()> {
    let name = path.display();
    ensure!(path.exists(), "{name} does not exist; {read}");
    ensure!(!path.is_dir(), "{name} is a folder; {read}. {instead}");
    let is_config = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("toml"));
    ensure!(!is_config, "{name} is no recording but a configuration; run it with `flyrig run {name}`");
    Ok(())
}

/// Returns where the images of a configuration come from, for advice on silent cameras.
pub fn image_origin(kind: SourceKind) -> ImageOrigin {
    match kind {
        SourceKind::Cameras => ImageOrigin::Cameras,
        SourceKind::Network => ImageOrigin::Network,
        SourceKind::Sim => ImageOrigin::Simulated,
        SourceKind::Folder | SourceKind::Video | SourceKind::Mcap => ImageOrigin::Stored,
    }
}
