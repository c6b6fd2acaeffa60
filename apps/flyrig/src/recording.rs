//! `flyrig record`: cameras into a file, and the recorder that other commands share.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::atomic::Ordering,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use flyrig_calib::calibration_toml;
use flyrig_capture::{
    CameraStats, CaptureThreads, Compression, MessageTap, Pacing, PopError, Recorded, Recorder, RecorderConfig,
    SourceOpener, ThreadsConfig,
};
use flyrig_fusion::WatchEvent;
use flyrig_gpu::GpuContext;
use flyrig_monitor::{Arrivals, Monitor, ended_by_itself};
use flyrig_report::stop;
use flyrig_takes::{
    Needs, SourceKind, Take,
    recorded::{camera_notes, log, schema},
};
use flyrig_types::{CameraId, Rig};
use foxglove::messages::Log;

use crate::{
    arguments::StopArgs,
    config::{Config, RecordSection},
    opening::{image_origin, open_cameras},
    pose_recording::PoseRecording,
};

/// Arguments of `flyrig record`.
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// Configuration (TOML); see `flyrig config print`.
    pub config: PathBuf,
    /// New MCAP file, which Foxglove and other readers open.
    #[arg(long)]
    pub out: PathBuf,
    #[command(flatten)]
    pub stop: StopArgs,
}

/// Topics of the events of a watched rig and of its corrected calibrations.
const WATCH: &str = "watch";
const CORRECTED: &str = "corrected/calibration.toml";
/// Interval between lines with counts.
const PRINT_EVERY: Duration = Duration::from_secs(5);

/// Opens a recording file and writes the names of the cameras and the rig, if it is known. Sources that are read without loss are recorded
/// without loss.
pub fn recorder(
    path: &Path,
    cameras: &[CameraId],
    rig: Option<&Rig>,
    settings: &RecordSection,
    pacing: Pacing,
) -> Result<Recorder> {
    ensure!(!path.exists(), "{} is there already; name a new file", path.display());
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        ensure!(folder.is_dir(), "{}: its folder {} does not exist; create it first", path.display(), folder.display());
    }
    let keep_all = pacing == Pacing::Lossless;
    let quality = settings.jpeg_quality;
    let compression = (quality > 0).then_some(Compression { quality, keep_all });
    let notes = camera_notes(cameras, rig)?;
    let settings = RecorderConfig { compression, rotation: settings.rotate, ..RecorderConfig::default() };
    Ok(Recorder::create_with(path, &notes, &settings)?)
}

/// Returns the cameras, recorded whenever they are opened and read.
pub fn tap(recorder: &Recorder, cameras: Vec<SourceOpener>) -> Result<Vec<SourceOpener>> {
    cameras.into_iter().map(|camera| Ok(camera.recorded(recorder.source_tap())?)).collect()
}

/// Formats a finished recording in one line.
///
/// # Errors
/// The recording broke off.
pub fn summary(recorded: &Recorded, path: &Path) -> Result<String> {
    let mut text = format!("{} frames, {:.1} MB in {}", recorded.frames, recorded.bytes as f64 / 1e6, path.display());
    // Messages are slightly longer than their images.
    if recorded.bytes_sent > recorded.bytes {
        text += &format!(", as JPEG; {:.1} MB as the cameras sent them", recorded.bytes_sent as f64 / 1e6);
    }
    if recorded.dropped > 0 {
        text +=
            &format!("; {} more were dropped: compressing them took too long, or the disk was full", recorded.dropped);
    }
    match &recorded.problem {
        Some(problem) => bail!("the recording broke off after {text}: {problem}"),
        None => Ok(text),
    }
}

/// Results of a running rig on their way into a recording.
pub struct RigRecording {
    /// Poses of the person.
    pub poses: PoseRecording,
    watch: MessageTap,
    calibrations: MessageTap,
}

impl RigRecording {
    /// Opens channels of their own in the file.
    pub fn new(recorder: &Recorder) -> Self {
        let poses = PoseRecording::new(recorder);
        let [watch, calibrations] = [WATCH, CORRECTED].map(|topic| recorder.messages(topic, schema::<Log>()));
        Self { poses, watch, calibrations }
    }

    /// Records an event of the rig's watch, with the rig if the event has corrected it.
    ///
    /// # Errors
    /// The calibration cannot be encoded.
    pub fn record_watch(&mut self, event: &WatchEvent, rig: &Rig) -> Result<()> {
        self.watch.record(event.nanos, log(WATCH, event.to_string())?);
        if event.corrected.is_some() {
            self.calibrations.record(event.nanos, log(CORRECTED, calibration_toml(rig, &[])?)?);
        }
        Ok(())
    }
}

/// Runs `flyrig record`.
pub fn record(config: &Config, args: &RecordArgs, gpu: Option<&GpuContext>) -> Result<()> {
    let stop = stop::flag();
    let mut monitor = Monitor::start(&config.health.listen, false)?
        .with_keys(&config.transport.keys)
        .with_origin(image_origin(config.source.kind));
    let take = open_recorded(config, gpu)?;
    let (pacing, rig) = (take.pacing(), take.calibration.map(|calibration| calibration.rig));
    let ids: Vec<CameraId> = take.sources.iter().map(|camera| camera.camera().clone()).collect();
    let recorder = recorder(&args.out, &ids, rig.as_ref(), &config.record, pacing)?;
    let tapped = tap(&recorder, take.sources)?;
    let threads = CaptureThreads::start_opening(tapped, ThreadsConfig { pacing, ..ThreadsConfig::default() })?;
    eprintln!("record: {} cameras to {} (Ctrl-C ends)", ids.len(), args.out.display());
    Monitor::ready();
    let started = Instant::now();
    let is_over = || {
        let has_time = args.stop.seconds.is_none_or(|seconds| started.elapsed().as_secs_f64() < seconds);
        stop.load(Ordering::Relaxed) || !has_time
    };
    let has_ended = record_frames(&threads, &ids, &recorder, &mut monitor, is_over);
    let stats = threads.stats();
    drop(threads);
    for camera in &stats {
        let lost = camera.health.lost_by_driver;
        let error = camera.last_error.as_ref().map_or_else(String::new, |error| format!("; last error: {error}"));
        eprintln!("record: camera {}: {} frames, {lost} lost before us{error}", camera.camera, camera.frames);
    }
    let recorded = recorder.finish();
    require_frames(&recorded, &stats)?;
    println!("record: {}", summary(&recorded, &args.out)?);
    ensure!(!has_ended || !config.source.kind.is_live(), ended_by_itself(&stats));
    Ok(())
}

/// Opens the cameras to record; uncalibrated ones as well, since a take to calibrate from precedes the calibration.
fn open_recorded(config: &Config, gpu: Option<&GpuContext>) -> Result<Take> {
    if config.source.kind == SourceKind::Cameras && !config.source.has_calibration() {
        eprintln!("record: no calibration; the recording is for flyrig calibrate, or gets one as source.calibration");
        return open_cameras(config, Needs::Frames, gpu);
    }
    config.check_scene()?;
    open_cameras(config, Needs::Calibration, gpu)
}

/// Reads frames, which are recorded as they pass, until the recording breaks off or `is_over`. Returns whether all cameras have ended.
fn record_frames(
    threads: &CaptureThreads,
    ids: &[CameraId],
    recorder: &Recorder,
    monitor: &mut Monitor,
    is_over: impl Fn() -> bool,
) -> bool {
    let mut arrivals = Arrivals::new(ids);
    let mut printed = Instant::now();
    while !is_over() && recorder.state().problem.is_none() {
        match threads.queue().pop(Duration::from_millis(100)) {
            Ok(frame) => {
                arrivals.add(&frame.camera);
                monitor.stepped();
            }
            Err(PopError::Timeout) => {}
            Err(PopError::Closed) => return true,
        }
        monitor.report(|| (arrivals.health(threads), Some(recorder.state())));
        if printed.elapsed() >= PRINT_EVERY {
            let state = recorder.state();
            eprintln!("record: {} frames, {:.1} MB", state.frames, state.bytes as f64 / 1e6);
            printed = Instant::now();
        }
    }
    false
}

/// Removes a recording without frames and explains it: the file would stop the next attempt.
fn require_frames(recorded: &Recorded, stats: &[CameraStats]) -> Result<()> {
    if recorded.frames > 0 || recorded.problem.is_some() {
        return Ok(());
    }
    fs::remove_file(&recorded.file).with_context(|| format!("cannot remove {}", recorded.file.display()))?;
    let last = stats.iter().find_map(|camera| camera.last_error.as_ref());
    let why = last.map_or_else(|| "no camera delivered anything".to_owned(), ToString::to_string);
    bail!("no frame was recorded, so {} was not kept: {why}", recorded.file.display());
}
