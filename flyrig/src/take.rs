//! A take: a configuration, a recording, a folder of images, or videos, opened with or without its calibration.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use flyrig_capture::{FolderOptions, FolderReplay, Pacing, SourceOpener, VideoOptions, VideoReplay};
use flyrig_fusion::Origin;
use flyrig_gpu::GpuContext;
use flyrig_report::dataset;
use flyrig_sync::SyncSettings;
use flyrig_types::{CameraId, Image, Rig};

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

/// Opens a take without its calibration. `gpu` opens a graphics adapter, for simulated cameras alone; `fps` is the frame rate of a
/// folder.
pub fn open(input: &[PathBuf], fps: f64, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Take> {
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
        [folder] if folder.is_dir() => Ok(Take::replayed(folder_sources(folder, fps, false)?)),
        [path] if !path.exists() => bail!("{} does not exist", path.display()),
        videos => Ok(Take::replayed(video_sources(videos)?)),
    }
}

/// A take and what is known of its cameras.
pub struct CalibratedTake {
    pub sources: Vec<SourceOpener>,
    pub is_live: bool,
    /// Where the cameras are, and their empty images as far as there are any.
    pub calibration: Option<(Rig, Vec<Option<Image>>)>,
    /// Whether masks that come with the images are used.
    pub given_masks: bool,
    /// What is taken off the stamps already.
    pub sync: SyncSettings,
}

impl CalibratedTake {
    /// Of a recording, folder or videos by themselves.
    fn replayed(sources: Vec<SourceOpener>, calibration: Option<(Rig, Vec<Option<Image>>)>, given_masks: bool) -> Self {
        Self { sources, is_live: false, calibration, given_masks, sync: SyncSettings::default() }
    }
}

/// Opens a take with its calibration: its own, or that of a folder.
pub fn open_calibrated(
    input: &[PathBuf],
    fps: f64,
    folder_of_calibration: Option<&Path>,
    gpu: &dyn Fn() -> Result<GpuContext>,
) -> Result<CalibratedTake> {
    let mut take = match input {
        [path] if has_ending(path, "toml") => {
            let mut config = Config::load(path)?;
            let is_sim = config.source.kind == SourceKind::Sim;
            // Simulated cameras can wait.
            config.source.real_time &= !is_sim;
            let gpu = is_sim.then(gpu).transpose()?;
            let is_live = config.source.kind.is_live();
            let source = source::open(&config, gpu.as_ref())?;
            let given_masks = config.perception.masks == Origin::Given;
            CalibratedTake {
                sources: source.cameras,
                is_live,
                calibration: Some((source.rig, source.plates)),
                given_masks,
                sync: config.sync,
            }
        }
        [path] if has_ending(path, "mcap") => {
            let rig = recording::recorded_rig(path)?;
            let plates = rig.cameras.iter().map(|_| None).collect();
            let sources = source::ready(recording::replay_sources(path, &rig)?);
            CalibratedTake::replayed(sources, Some((rig, plates)), false)
        }
        [folder] if folder.is_dir() => {
            let is_calibrated = ["intri.yml", "extri.yml"].iter().all(|file| folder.join(file).exists());
            let mut sources = folder_sources(folder, fps, false)?;
            let masks = folder.join("mask");
            let with_masks = (is_calibrated || folder_of_calibration.is_some())
                && sources.iter().all(|source| masks.join(source.camera().as_str()).is_dir());
            if with_masks {
                sources = folder_sources(folder, fps, true)?;
            }
            let calibration = (is_calibrated && folder_of_calibration.is_none())
                .then(|| calibration(folder, &sources))
                .transpose()?;
            CalibratedTake::replayed(sources, calibration, with_masks)
        }
        [path] => {
            bail!("{} is no configuration, recording or folder; name several videos, or one of these", path.display())
        }
        videos => CalibratedTake::replayed(video_sources(videos)?, None, false),
    };
    if let Some(folder) = folder_of_calibration {
        ensure!(
            !take.is_live,
            "--calibration looks at every frame, which takes longer than live cameras wait; record them first (flyrig \
             record) and give the recording"
        );
        take.calibration = Some(calibration(folder, &take.sources)?);
    }
    Ok(take)
}

/// What a folder says of the sources' cameras, in their order.
fn calibration(folder: &Path, sources: &[SourceOpener]) -> Result<(Rig, Vec<Option<Image>>)> {
    let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
    let names: Vec<String> = cameras.iter().map(CameraId::to_string).collect();
    let rig = dataset::pick(&dataset::load_rig(folder, &cameras)?, &names, "the calibration")?;
    let plates = dataset::plates(&folder.join("background"), &rig)?;
    Ok((rig, plates))
}

fn has_ending(path: &Path, ending: &str) -> bool {
    path.extension().is_some_and(|found| found.eq_ignore_ascii_case(ending))
}

fn folder_sources(folder: &Path, fps: f64, with_masks: bool) -> Result<Vec<SourceOpener>> {
    let options = FolderOptions { fps, with_masks, ..FolderOptions::default() };
    Ok(source::ready(FolderReplay::open(folder, None, &options)?))
}

fn video_sources(videos: &[PathBuf]) -> Result<Vec<SourceOpener>> {
    let video = |path: &PathBuf| -> Result<VideoReplay> {
        let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        Ok(VideoReplay::open(&name.into(), path, &VideoOptions::default())?)
    };
    Ok(source::ready(videos.iter().map(video).collect::<Result<_>>()?))
}
