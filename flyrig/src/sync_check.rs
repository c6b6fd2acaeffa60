//! `flyrig sync-check`: do the cameras' stamps agree with what moves in their pictures?

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Result, bail, ensure};
use flyrig_calib::{MotionSignal, estimate_lags};
use flyrig_capture::{
    CameraSource, CaptureThreads, FolderOptions, FolderReplay, Pacing, PopError, ThreadsConfig, VideoOptions,
    VideoReplay, to_rgb8_into,
};
use flyrig_gpu::GpuContext;
use flyrig_types::CameraId;

use crate::{
    cli::SyncCheckArgs,
    config::{Config, SourceKind},
    record, run, stop,
};

/// Runs the command. `gpu` opens a graphics adapter, for simulated cameras alone.
pub fn sync_check(args: &SyncCheckArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let (sources, is_live) = open(args, gpu)?;
    let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
    ensure!(cameras.len() > 1, "one camera alone has no lag; name at least two");
    let mut signals: Vec<MotionSignal> = cameras.iter().cloned().map(MotionSignal::new).collect();
    let pacing = if is_live { Pacing::AsDelivered } else { Pacing::Lossless };
    let threads = CaptureThreads::start(sources, ThreadsConfig { queue_capacity: 8 * cameras.len(), pacing })?;
    if is_live {
        eprintln!("sync-check: move up and down before all cameras for {} s, please", args.seconds);
    }
    let (started, mut rgb, mut first) = (Instant::now(), Vec::new(), None);
    while !stop::requested() {
        let frame = match threads.queue().pop(Duration::from_millis(200)) {
            Ok(frame) => frame,
            Err(PopError::Closed) => break,
            Err(PopError::Timeout) if is_live && started.elapsed().as_secs_f64() > args.seconds + 5.0 => break,
            Err(PopError::Timeout) => continue,
        };
        let from = *first.get_or_insert(frame.capture_nanos);
        if frame.capture_nanos.saturating_sub(from) as f64 * 1e-9 > args.seconds {
            break;
        }
        let image = &frame.image;
        if let Some(slot) = cameras.iter().position(|camera| *camera == frame.camera)
            && to_rgb8_into(image, &mut rgb).is_ok()
        {
            signals[slot].add(frame.capture_nanos, &rgb, image.width() as usize, image.height() as usize);
        }
    }
    drop(threads);
    let estimates = estimate_lags(&signals, (args.most_ms * 1e6) as i64);
    println!("{:<14} {:>7} {:>9} {:>12} {:>13}", "camera", "frames", "lag ms", "correlation", "disagree ms");
    for (estimate, signal) in estimates.iter().zip(&signals) {
        let lag = estimate.lag_nanos.map_or_else(|| "?".to_owned(), |nanos| format!("{:.1}", nanos as f64 * 1e-6));
        println!(
            "{:<14} {:>7} {lag:>9} {:>12.2} {:>13.1}",
            estimate.camera,
            signal.len(),
            estimate.correlation,
            estimate.disagreement_nanos * 1e-6
        );
    }
    if estimates.iter().any(|estimate| estimate.lag_nanos.is_none()) {
        println!(
            "?: nothing moves there as elsewhere, or not for long enough (five seconds); move up and down before all cameras"
        );
    } else {
        println!(
            "lag ms is how much later than the first camera's a camera's stamps are: lag_ms of its [[source.cameras]]"
        );
    }
    Ok(())
}

type Sources = Vec<Box<dyn CameraSource>>;

fn open(args: &SyncCheckArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<(Sources, bool)> {
    let has_ending =
        |path: &Path, ending: &str| path.extension().is_some_and(|found| found.eq_ignore_ascii_case(ending));
    let boxed = |source| Box::new(source) as Box<dyn CameraSource>;
    match args.input.as_slice() {
        [path] if has_ending(path, "toml") => {
            let config = Config::load(path)?;
            let gpu = (config.source.kind == SourceKind::Sim).then(gpu).transpose()?;
            Ok((run::open(&config, gpu.as_ref())?.sources, config.source.kind.is_live()))
        }
        [path] if has_ending(path, "mcap") => Ok((record::replay_sources(path, &record::recorded_rig(path)?)?, false)),
        [folder] if folder.is_dir() => {
            let options = FolderOptions { fps: args.fps, ..FolderOptions::default() };
            let sources = FolderReplay::open(folder, None, &options)?;
            Ok((sources.into_iter().map(|source| Box::new(source) as Box<dyn CameraSource>).collect(), false))
        }
        [path] => {
            bail!("{} is no configuration, recording or folder; name several videos, or one of these", path.display())
        }
        videos => {
            let video = |path: &PathBuf| -> Result<Box<dyn CameraSource>> {
                let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
                Ok(boxed(VideoReplay::open(&name.into(), path, &VideoOptions::default())?))
            };
            Ok((videos.iter().map(video).collect::<Result<_>>()?, false))
        }
    }
}
