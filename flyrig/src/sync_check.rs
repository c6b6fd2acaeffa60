//! `flyrig sync-check`: do the cameras' stamps agree with what moves in their pictures?

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Result, bail, ensure};
use flyrig_body::{ShapeParams, default_template};
use flyrig_calib::{ClockKind, LagEstimate, MotionSignal, PointTrack, SyncConfig, estimate_lags, estimate_point_lags};
use flyrig_capture::{
    CameraSource, CaptureThreads, FolderOptions, FolderReplay, Pacing, PopError, ThreadsConfig, VideoOptions,
    VideoReplay, to_rgb8_into,
};
use flyrig_gpu::GpuContext;
use flyrig_tracker::{PoseConfig, PoseEstimator, PoseNet, TrackErrorKind};
use flyrig_types::CameraId;

use crate::{
    cli::SyncCheckArgs,
    config::{Config, SourceKind},
    dataset,
    intake::{Intake, Pictures},
    record, run, stop,
};

/// Runs the command. `gpu` opens a graphics adapter, for simulated cameras alone.
pub fn sync_check(args: &SyncCheckArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let (sources, is_live) = open(args, gpu)?;
    let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
    ensure!(cameras.len() > 1, "one camera alone has no lag; name at least two");
    if let Some(folder) = &args.calibration {
        ensure!(
            !is_live,
            "--calibration looks at every frame, which takes longer than live cameras wait; record them first (flyrig \
             record) and give the recording"
        );
        return by_person(args, folder, sources, &cameras);
    }
    if is_live {
        eprintln!("sync-check: jump and wave both arms before all cameras for {} s, please", args.seconds);
    }
    let (estimates, frames) = by_motion(args, sources, &cameras, is_live)?;
    print(&estimates, &frames);
    if estimates.iter().any(|estimate| estimate.lag_nanos.is_none()) {
        println!(
            "?: nothing moves there as elsewhere, too slowly, or not for long enough (five seconds): jump and wave both arms \
             before all cameras, or name the --calibration"
        );
    } else {
        println!(
            "lag ms is how much later than the first camera's a camera's stamps are: add it to the lag_ms that its \
             [[source.cameras]] has (0 without one)"
        );
    }
    Ok(())
}

/// The lags by what moves in the pictures, and how many pictures of each camera were compared.
fn by_motion(
    args: &SyncCheckArgs,
    sources: Sources,
    cameras: &[CameraId],
    is_live: bool,
) -> Result<(Vec<LagEstimate>, Vec<usize>)> {
    let mut signals: Vec<MotionSignal> = cameras.iter().cloned().map(MotionSignal::new).collect();
    let pacing = if is_live { Pacing::AsDelivered } else { Pacing::Lossless };
    let threads = CaptureThreads::start(sources, ThreadsConfig { queue_capacity: 8 * cameras.len(), pacing })?;
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
    Ok((estimates, signals.iter().map(MotionSignal::len).collect()))
}

fn print(estimates: &[LagEstimate], frames: &[usize]) {
    println!("{:<14} {:>7} {:>9} {:>12} {:>13}", "camera", "frames", "lag ms", "correlation", "disagree ms");
    for (estimate, frames) in estimates.iter().zip(frames) {
        let lag = estimate.lag_nanos.map_or_else(|| "?".to_owned(), |nanos| format!("{:.1}", nanos as f64 * 1e-6));
        println!(
            "{:<14} {frames:>7} {lag:>9} {:>12.2} {:>13.1}",
            estimate.camera,
            estimate.correlation,
            estimate.disagreement_nanos * 1e-6
        );
    }
}

/// By where the joints of a person are: for takes too short for motion alone.
fn by_person(args: &SyncCheckArgs, folder: &Path, sources: Sources, cameras: &[CameraId]) -> Result<()> {
    ensure!(cameras.len() > 2, "two cameras cannot tell which point they see; name at least three");
    let rig = dataset::pick(&dataset::load_rig(folder, cameras)?, &cameras_named(cameras), "the calibration")?;
    let mut estimator = PoseEstimator::new(
        PoseNet::embedded()?,
        &default_template(&ShapeParams::default())?,
        &rig,
        PoseConfig::default(),
    )?;
    let mut tracks: Vec<PointTrack> = rig.cameras.iter().map(PointTrack::new).collect();
    let mut frames = vec![0; tracks.len()];
    let mut intake =
        Intake::start(sources, Pictures::OfRig(&rig), &SyncConfig::default(), ClockKind::Shared, Pacing::Lossless)?;
    let (mut first, mut unseen) = (None, 0);
    while !intake.ended() && !stop::requested() {
        let Some(set) = intake.next_set(Duration::from_millis(200)) else { continue };
        let from = *first.get_or_insert(set.master_nanos);
        if set.master_nanos.saturating_sub(from) as f64 * 1e-9 > args.seconds {
            break;
        }
        match estimator.estimate(&set) {
            Ok(estimate) => {
                for (slot, frame) in set.present() {
                    let Some(Some(keypoints)) = estimate.keypoints.get(slot) else { continue };
                    let pixels: Vec<_> = keypoints
                        .iter()
                        .map(|keypoint| (keypoint.usable() && keypoint.confidence > 0.5).then_some(keypoint.pixel))
                        .collect();
                    tracks[slot].add(frame.capture_nanos, &pixels);
                    frames[slot] += 1;
                }
            }
            Err(error) if error.kind == TrackErrorKind::Lost => unseen += 1,
            Err(error) => return Err(error.into()),
        }
    }
    if let Some((slot, error)) =
        (0..frames.len()).filter(|&slot| frames[slot] == 0).find_map(|slot| Some((slot, intake.last_error(slot)?)))
    {
        bail!("no picture of camera {} could be used; the last: {error}", cameras[slot]);
    }
    let estimates = estimate_point_lags(&tracks, (args.most_ms * 1e6) as i64);
    print(&estimates, &frames);
    println!(
        "correlation: how much better the lag explains the joints than others do; disagreement: of halves of the joints"
    );
    if unseen > 0 {
        println!("in {unseen} sets nobody was seen");
    }
    if estimates.iter().any(|estimate| estimate.lag_nanos.is_none()) {
        println!("?: the joints do not tell; let one person walk through the view of all cameras");
    }
    Ok(())
}

fn cameras_named(cameras: &[CameraId]) -> Vec<String> {
    cameras.iter().map(CameraId::to_string).collect()
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

#[cfg(test)]
mod tests {
    use flyrig_gpu::AdapterChoice;
    use flyrig_sim::{Fault, FaultKind, FaultScript, MotionConfig, MotionKind, SimConfig, SimTime, Simulator};
    use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

    use super::*;

    const NAMES: [&str; 4] = ["00", "02", "03", "05"];

    /// Lags that were simulated and lags that were found, milliseconds after the first camera.
    fn simulated(gpu: &GpuContext, seed: u64, kind: MotionKind) -> Vec<(f64, LagEstimate)> {
        let mut rng = SmallRng::seed_from_u64(seed);
        let lags_ms = NAMES.map(|_| rng.random_range(-100.0f64..100.0));
        let offset = |(name, ms): (&str, f64)| Fault {
            camera: Some(name.to_owned()),
            ms: Some(ms),
            ..Fault::new(FaultKind::Offset)
        };
        let config = SimConfig {
            seed,
            motion: MotionConfig { kind, ..MotionConfig::default() },
            faults: FaultScript { seed, faults: NAMES.into_iter().zip(lags_ms).map(offset).collect() },
            width: 128,
            height: 128,
            frames: Some(240),
            ..SimConfig::default()
        };
        let simulator = std::sync::Arc::new(std::sync::Mutex::new(Simulator::new(gpu, &config).unwrap()));
        let sources: Sources = flyrig_sim::sources(&simulator, SimTime::Exact)
            .into_iter()
            .filter(|source| NAMES.contains(&source.camera().as_str()))
            .map(|source| Box::new(source) as Box<dyn CameraSource>)
            .collect();
        let args = SyncCheckArgs { input: Vec::new(), seconds: 20.0, most_ms: 250.0, fps: 30.0, calibration: None };
        let (estimates, _) = by_motion(&args, sources, &NAMES.map(CameraId::from), false).unwrap();
        lags_ms.map(|lag| lag - lags_ms[0]).into_iter().zip(estimates).collect()
    }

    fn assert_found(gpu: &GpuContext, seed: u64) {
        for (lag_ms, estimate) in simulated(gpu, seed, MotionKind::Wave) {
            let found = estimate.lag_nanos.unwrap() as f64 * 1e-6;
            let off = found - lag_ms;
            println!("seed {seed} {}: {found:.1} ms, off by {off:.2} ms", estimate.camera);
            assert!(off.abs() <= 2.0, "seed {seed} {}: off by {off} ms", estimate.camera);
        }
    }

    #[test]
    fn random_lags_of_a_person_who_waves_are_found() {
        assert_found(&GpuContext::new(&AdapterChoice::Best).unwrap(), 1);
    }

    #[test]
    #[ignore = "minutes: run by make test-long"]
    fn lags_are_right_or_not_told() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        // Slow movements look different from every side: no answer is better than a wrong one.
        let waving = (2..6).map(|seed| (MotionKind::Wave, seed));
        for (kind, seed) in waving.chain([(MotionKind::Squat, 6), (MotionKind::Turn, 7)]) {
            for (lag_ms, estimate) in simulated(&gpu, seed, kind) {
                let off = estimate.lag_nanos.map(|found| found as f64 * 1e-6 - lag_ms);
                let disagreement = estimate.disagreement_nanos * 1e-6;
                println!("{kind:?} {seed} {}: off by {off:?} ms, disagreement {disagreement:.1} ms", estimate.camera);
                assert!(
                    off.is_none_or(|off| off.abs() <= 3.0),
                    "{kind:?} {seed} {}: off by {off:?} ms",
                    estimate.camera
                );
            }
        }
    }
}
