//! A take: a configuration, a recording, a folder of images, or videos, opened without any calibration.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use flyrig_capture::{FolderOptions, FolderReplay, Pacing, SourceOpener, VideoOptions, VideoReplay};
use flyrig_gpu::GpuContext;

use crate::{
    config::{Config, SourceKind},
    live, recording, source,
};

/// Cameras of a take.
pub struct Take {
    pub sources: Vec<SourceOpener>,
    pub pacing: Pacing,
}

impl Take {
    fn replayed(sources: Vec<SourceOpener>) -> Self {
        Self { sources, pacing: Pacing::Lossless }
    }
}

/// Opens a take. `gpu` opens a graphics adapter, for simulated cameras alone; `fps` is the frame rate of a folder.
pub fn open(input: &[PathBuf], fps: f64, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Take> {
    let has_ending =
        |path: &Path, ending: &str| path.extension().is_some_and(|found| found.eq_ignore_ascii_case(ending));
    match input {
        [path] if has_ending(path, "toml") => {
            let mut config = Config::load_for_capture(path)?;
            if config.source.kind == SourceKind::Cameras {
                // Cameras need no calibration to give images.
                return Ok(Take { sources: live::openers(&config.source)?, pacing: Pacing::AsDelivered });
            }
            let is_sim = config.source.kind == SourceKind::Sim;
            config.source.real_time &= !is_sim;
            let gpu = is_sim.then(gpu).transpose()?;
            let pacing = if config.source.kind.is_live() { Pacing::AsDelivered } else { Pacing::Lossless };
            Ok(Take { sources: source::open_without_plates(&config, gpu.as_ref())?.cameras, pacing })
        }
        [path] if has_ending(path, "mcap") => {
            let rig = recording::recorded_rig(path)?;
            Ok(Take::replayed(source::ready(recording::replay_sources(path, &rig)?)))
        }
        [folder] if folder.is_dir() => {
            let options = FolderOptions { fps, ..FolderOptions::default() };
            Ok(Take::replayed(source::ready(FolderReplay::open(folder, None, &options)?)))
        }
        [path] if !path.exists() => bail!("{} does not exist", path.display()),
        videos => {
            let video = |path: &PathBuf| -> Result<VideoReplay> {
                let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
                Ok(VideoReplay::open(&name.into(), path, &VideoOptions::default())?)
            };
            Ok(Take::replayed(source::ready(videos.iter().map(video).collect::<Result<_>>()?)))
        }
    }
}
