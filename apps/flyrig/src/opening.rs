//! Takes that the commands open: what a command line names, or the cameras of a configuration.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use flyrig_gpu::GpuContext;
use flyrig_takes::{Needs, Take, TakeInput, TakeOptions};

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
