//! A take: a configuration, a recording, a folder of images, or videos, opened with or without its calibration.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use anyhow::{Result, bail, ensure};
use flyrig_capture::{FolderOptions, FolderReplay, Pacing, SourceOpener, VideoOptions, VideoReplay};
use flyrig_fusion::{InputFormat, Intake, Origin};
use flyrig_gpu::GpuContext;
use flyrig_report::{dataset, progress_bar, stop};
use flyrig_sync::SyncSettings;
use flyrig_types::{CameraId, FrameSet, Image, Rig};

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
            let (cameras, _) = recording::recorded_cameras(path)?;
            Ok(Take::replayed(source::ready(recording::replay_sources(path, &cameras)?)))
        }
        [folder] if folder.is_dir() => Ok(Take::replayed(folder_sources(folder, fps, false)?)),
        [path] if !path.exists() => bail!("{} does not exist", path.display()),
        videos => Ok(Take::replayed(video_sources(videos)?)),
    }
}

/// A take with its calibration.
pub struct CalibratedTake {
    pub sources: Vec<SourceOpener>,
    pub is_live: bool,
    /// The rig and its plates by slot; `None` without a calibration.
    pub calibration: Option<(Rig, Vec<Option<Image>>)>,
    /// Whether to use the masks of the take.
    pub given_masks: bool,
    /// How frames are joined; its time offsets are subtracted from the timestamps.
    pub sync: SyncSettings,
}

impl CalibratedTake {
    /// Creates the take of a recording, a folder or videos.
    fn replayed(sources: Vec<SourceOpener>, calibration: Option<(Rig, Vec<Option<Image>>)>, given_masks: bool) -> Self {
        Self { sources, is_live: false, calibration, given_masks, sync: SyncSettings::default() }
    }
}

/// Errors of the images of a take, by slot.
pub struct ReadErrors(Vec<Option<String>>);

impl ReadErrors {
    /// Returns the last error of a camera.
    pub fn of(&self, slot: usize) -> Option<&str> {
        self.0.get(slot)?.as_deref()
    }
}

/// Calls `each` with every set whose time lies within `secs` (from, to) of the first one's, until Ctrl-C, under a progress bar. Sets
/// wait for cameras by up to `spread_nanos` longer than usual: nothing is lost by waiting in a recording.
pub fn each_set(
    sources: Vec<SourceOpener>,
    rig: &Rig,
    sync: SyncSettings,
    spread_nanos: u64,
    secs: [f64; 2],
    label: &'static str,
    mut each: impl FnMut(&FrameSet) -> Result<()>,
) -> Result<ReadErrors> {
    let max_wait_nanos = Some(sync.max_wait_nanos.unwrap_or(1_000_000_000).saturating_add(spread_nanos));
    let sync = SyncSettings { max_wait_nanos, ..sync };
    let mut intake = Intake::start_opening(sources, InputFormat::OfRig(rig), &sync, Pacing::Lossless)?;
    let bar = progress_bar((secs[1] * 1e3) as u64, label);
    let mut first = None;
    while !intake.ended() && !stop::requested() {
        let Some(set) = intake.next_set(Duration::from_millis(200)) else { continue };
        let from = *first.get_or_insert(set.master_nanos);
        let at = set.master_nanos.saturating_sub(from) as f64 * 1e-9;
        if at > secs[1] {
            break;
        }
        bar.set_position((at * 1e3) as u64);
        // Timestamps jitter by less than a millisecond.
        if at >= secs[0] - 1e-3 {
            each(&set)?;
        }
    }
    bar.finish_and_clear();
    Ok(ReadErrors((0..rig.cameras.len()).map(|slot| intake.last_error(slot).map(|error| error.to_string())).collect()))
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
            let (cameras, rig) = recording::recorded_cameras(path)?;
            let sources = source::ready(recording::replay_sources(path, &cameras)?);
            let without_plates = |rig: Rig| {
                let plates = rig.cameras.iter().map(|_| None).collect();
                (rig, plates)
            };
            CalibratedTake::replayed(sources, rig.map(without_plates), false)
        }
        [folder] if folder.is_dir() => {
            let has = |file: &str| folder.join(file).exists();
            let is_calibrated = has("calibration.toml") || has("intri.yml") && has("extri.yml");
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
    if let Some((rig, _)) = &take.calibration {
        take.sync = take.sync.with_offsets_of(&rig.cameras);
    }
    Ok(take)
}

/// Reads calibration and plates of the sources' cameras from a folder.
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
