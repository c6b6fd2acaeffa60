//! `flyrig sync-check`: estimates the cameras' time offsets from motion in their images.

use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use clap::Args;
use flyrig_capture::{CaptureThreads, Pacing, PopError, SourceOpener, ThreadsConfig, to_rgb8_into};
use flyrig_gpu::GpuContext;
use flyrig_report::stop;
use flyrig_sync::{
    ClockKind, LagEstimate, MotionSignal, SilhouetteTrack, SyncSettings, estimate_lags, estimate_silhouette_lags,
};
use flyrig_takes::{Calibration, SilhouetteFinder, Take, TakeSpan};
use flyrig_types::{CameraId, Image, Rig};

use crate::arguments::{CalibratedInputArgs, parse_most_ms};

/// Arguments of `flyrig sync-check`.
#[derive(Debug, Args)]
#[command(mut_arg("secs", |arg| arg.alias("seconds")))]
pub struct SyncCheckArgs {
    /// Largest time offset of the search, milliseconds.
    #[arg(long, default_value_t = 250.0, value_parser = parse_most_ms)]
    pub most_ms: f64,
    #[command(flatten)]
    pub input: CalibratedInputArgs,
}

const ADD_TO_CAMERA: &str = "add it to the lag_ms that its [[source.cameras]] has (0 without one)";
const ADD: &str = "add it to the camera's time_offset_ms in calibration.toml, or to [sync] lags_ms or --lag CAM=MS, which replace that";

/// Runs the command. `gpu` opens a graphics adapter, for simulated cameras alone.
pub fn sync_check(args: &SyncCheckArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let mut take = args.input.open(gpu)?;
    let cameras: Vec<CameraId> = take.sources.iter().map(|source| source.camera().clone()).collect();
    ensure!(cameras.len() > 1, "a time offset needs at least two cameras; name another one");
    let advice = if take.is_live { ADD_TO_CAMERA } else { ADD };
    let (estimates, frames, legend, advice_if_missing) = match take.calibration.take() {
        Some(Calibration { rig, plates }) if !take.is_live => {
            let (estimates, frames) = by_silhouettes(args, &rig, plates, take)?;
            let legend = "by silhouettes; +- is the standard error, fit how much better the lag fits than others";
            let advice_if_missing = "the estimate is less certain than 5 ms: let one person whom all cameras see whole jump, squat and wave \
                        above the head, for eight seconds";
            (estimates, frames, legend, advice_if_missing)
        }
        _ => {
            ensure!(
                take.sync.clocks == ClockKind::Shared,
                "sync.clocks is \"triggered\": every camera has a clock of its own, and without the rig's clocks in step what moves \
                 tells no lag; record the take and check the recording"
            );
            if take.is_live {
                eprintln!(
                    "sync-check: jump and wave both arms before all cameras for {} s, please",
                    args.input.span.secs
                );
            }
            let (estimates, frames) = by_motion(args, take.sources, &cameras, &take.sync, take.is_live)?;
            let advice_if_missing = "its motion does not correlate with that of other cameras, is too slow, or too short (under five seconds): jump and wave both \
                        arms before all cameras; surer, with a calibration: flyrig record, and sync-check of the recording";
            let legend = "from motion; +- is the disagreement between camera pairs, fit the best correlation with another camera";
            (estimates, frames, legend, advice_if_missing)
        }
    };
    print(&estimates, &frames);
    println!("{legend}");
    if estimates.iter().any(|estimate| estimate.lag_nanos.is_none()) {
        println!(
            "?: {advice_if_missing}. Or the offset is larger than --most-ms {}, or the clocks drift: compare --seconds 5 of an early and a late part \
             (--from-secs)",
            args.most_ms
        );
    } else {
        println!("offset ms is each camera's time offset from the first camera: {advice}");
    }
    Ok(())
}

/// Estimates the time offsets from motion in the images; returns them with the number of compared images per camera.
fn by_motion(
    args: &SyncCheckArgs,
    sources: Vec<SourceOpener>,
    cameras: &[CameraId],
    sync: &SyncSettings,
    is_live: bool,
) -> Result<(Vec<LagEstimate>, Vec<usize>)> {
    let mut signals: Vec<MotionSignal> = cameras.iter().cloned().map(MotionSignal::new).collect();
    let pacing = if is_live { Pacing::AsDelivered } else { Pacing::Lossless };
    let threads = CaptureThreads::start_opening(sources, ThreadsConfig { queue_capacity: 8 * cameras.len(), pacing })?;
    let (started, mut rgb, mut first) = (Instant::now(), Vec::new(), None);
    while !stop::requested() {
        let frame = match threads.queue().pop(Duration::from_millis(200)) {
            Ok(frame) => frame,
            Err(PopError::Closed) => break,
            Err(PopError::Timeout)
                if is_live
                    && started.elapsed().as_secs_f64() > args.input.span.from_secs + args.input.span.secs + 5.0 =>
            {
                break;
            }
            Err(PopError::Timeout) => continue,
        };
        let from = *first.get_or_insert(frame.capture_nanos);
        let at = frame.capture_nanos.saturating_sub(from) as f64 * 1e-9;
        if at > args.input.span.from_secs + args.input.span.secs {
            break;
        }
        if at < args.input.span.from_secs {
            continue;
        }
        let image = &frame.image;
        if let Some(slot) = cameras.iter().position(|camera| *camera == frame.camera)
            && to_rgb8_into(image, &mut rgb).is_ok()
        {
            let lag = sync.lags_nanos.get(&frame.camera).copied().unwrap_or_default();
            let nanos = frame.capture_nanos.saturating_sub(lag);
            signals[slot].add(nanos, &rgb, image.width() as usize, image.height() as usize);
        }
    }
    if let Some(stats) = threads.stats().into_iter().find(|stats| stats.frames == 0)
        && let Some(error) = stats.last_error
        && is_live
    {
        bail!("no image of camera {} came; the last: {error}", stats.camera);
    }
    drop(threads);
    let estimates = estimate_lags(&signals, (args.most_ms * 1e6) as i64);
    Ok((estimates, signals.iter().map(MotionSignal::comparisons).collect()))
}

fn print(estimates: &[LagEstimate], frames: &[usize]) {
    println!("{:<14} {:>7} {:>9} {:>8} {:>6}", "camera", "frames", "offset ms", "+- ms", "fit");
    for (estimate, frames) in estimates.iter().zip(frames) {
        let lag = estimate.lag_nanos.map_or_else(|| "?".to_owned(), |nanos| format!("{:.1}", nanos as f64 * 1e-6));
        let error = estimate.disagreement_nanos * 1e-6;
        let error = if error < 1e3 { format!("{error:.1}") } else { "?".to_owned() };
        println!("{:<14} {frames:>7} {lag:>9} {error:>8} {:>6.2}", estimate.camera, estimate.correlation);
    }
}

/// Estimates the time offsets from a person's silhouettes; returns them with the number of silhouettes per camera.
fn by_silhouettes(
    args: &SyncCheckArgs,
    rig: &Rig,
    plates: Vec<Option<Image>>,
    take: Take,
) -> Result<(Vec<LagEstimate>, Vec<usize>)> {
    let mut silhouettes = SilhouetteFinder::new(rig, plates, take.given_masks)?;
    let mut pictures = vec![0usize; rig.cameras.len()];
    // One camera may lead by as much as another lags.
    let spread_nanos = (args.most_ms * 2e6) as u64;
    let span =
        TakeSpan { secs: [args.input.span.from_secs, args.input.span.from_secs + args.input.span.secs], spread_nanos };
    let errors = take.for_each_set(rig, span, "silhouettes, ms of the take", |set| {
        set.present().for_each(|(slot, _)| pictures[slot] += 1);
        silhouettes.add(set)
    })?;
    let tracks = silhouettes.into_tracks();
    let frames: Vec<usize> = tracks.iter().map(SilhouetteTrack::masks).collect();
    if let Some((slot, error)) =
        (0..pictures.len()).filter(|&slot| pictures[slot] == 0).find_map(|slot| Some((slot, errors.get(slot)?)))
    {
        bail!("no image of camera {} could be used; the last: {error}", rig.cameras[slot].id);
    }
    Ok((estimate_silhouette_lags(&tracks, (args.most_ms * 1e6) as i64), frames))
}

#[cfg(test)]
mod tests {
    use crate::arguments::{CalibrationArgs, InputArgs, SpanArgs};
    use flyrig_capture::CameraSource as _;
    use flyrig_gpu::AdapterChoice;
    use flyrig_report::arguments::FpsArgs;
    use flyrig_sim::{Fault, FaultKind, FaultScript, MotionConfig, MotionKind, SimConfig, SimTime, Simulator};
    use flyrig_takes::dataset::select_cameras;
    use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

    use std::sync::{Arc, Mutex};

    use super::*;

    const NAMES: [&str; 4] = ["00", "02", "03", "05"];

    /// Four of seven simulated cameras whose timestamps have random offsets.
    struct Lagging {
        /// Offset from the first camera, milliseconds.
        lags_ms: [f64; 4],
        rig: Rig,
        sources: Vec<SourceOpener>,
    }

    impl Lagging {
        fn new(gpu: &GpuContext, seed: u64, kind: MotionKind, side: u32, frames: u64) -> Self {
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
                width: side,
                height: side,
                frames: Some(frames),
                ..SimConfig::default()
            };
            let simulator = Simulator::new(gpu, &config).unwrap();
            let rig =
                select_cameras(&simulator.reported_rig(), &NAMES.map(str::to_owned), "the simulated rig").unwrap();
            let simulator = Arc::new(Mutex::new(simulator));
            let sources = flyrig_sim::sources(&simulator, SimTime::Exact);
            let chosen = sources.into_iter().filter(|source| NAMES.contains(&source.camera().as_str()));
            let sources = chosen.map(|source| SourceOpener::ready(Box::new(source))).collect();
            Self { lags_ms: lags_ms.map(|lag| lag - lags_ms[0]), rig, sources }
        }

        /// Returns the error of each estimate (milliseconds; `None` if there is none) with its standard error or disagreement.
        fn off(&self, estimates: &[LagEstimate]) -> Vec<(Option<f64>, f64)> {
            let off = |(estimate, lag): (&LagEstimate, f64)| {
                let off = estimate.lag_nanos.map(|found| found as f64 * 1e-6 - lag);
                println!("{estimate:?}, in truth {lag:.2} ms: off by {off:.2?} ms");
                (off, estimate.disagreement_nanos * 1e-6)
            };
            estimates.iter().zip(self.lags_ms).map(off).collect()
        }

        fn by_motion(mut self) -> Vec<(Option<f64>, f64)> {
            let sources = std::mem::take(&mut self.sources);
            let (estimates, _) =
                by_motion(&args(), sources, &NAMES.map(CameraId::from), &SyncSettings::default(), false).unwrap();
            self.off(&estimates)
        }

        /// Estimates from silhouettes that are found in the images, without plates.
        fn by_silhouettes(mut self) -> Vec<(Option<f64>, f64)> {
            let take = Take::from_sources(std::mem::take(&mut self.sources));
            let (estimates, frames) = by_silhouettes(&args(), &self.rig, NAMES.map(|_| None).into(), take).unwrap();
            println!("{frames:?} silhouettes");
            self.off(&estimates)
        }
    }

    fn args() -> SyncCheckArgs {
        SyncCheckArgs {
            most_ms: 250.0,
            input: CalibratedInputArgs {
                source: InputArgs { input: Vec::new(), rate: FpsArgs { fps: 30.0 } },
                calibration: CalibrationArgs { calibration: None },
                span: SpanArgs { secs: 20.0, from_secs: 0.0 },
            },
        }
    }

    #[test]
    #[ignore = "minutes: run by make test-long"]
    fn random_lags_of_a_person_who_waves_are_found_by_motion() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        for (off, _) in Lagging::new(&gpu, 1, MotionKind::Wave, 128, 240).by_motion() {
            assert!(off.is_some_and(|off| off.abs() <= 2.0), "off by {off:?} ms");
        }
    }

    #[test]
    #[ignore = "minutes: run by make test-long"]
    fn random_lags_of_a_person_who_jumps_are_found_by_silhouettes() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        for (off, _) in Lagging::new(&gpu, 5, MotionKind::Jump, 192, 120).by_silhouettes() {
            assert!(off.is_some_and(|off| off.abs() <= 2.0), "off by {off:?} ms");
        }
    }

    #[test]
    #[ignore = "minutes: run by make test-long"]
    fn lags_by_motion_are_right_or_not_reported() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        // Slow movements look different from every side: no estimate is better than a wrong one.
        let waving = (2..6).map(|seed| (MotionKind::Wave, seed));
        for (kind, seed) in waving.chain([(MotionKind::Squat, 6), (MotionKind::Turn, 7)]) {
            println!("{kind:?} {seed}");
            for (off, _) in Lagging::new(&gpu, seed, kind, 128, 240).by_motion() {
                assert!(off.is_none_or(|off| off.abs() <= 3.0), "{kind:?} {seed}: off by {off:?} ms");
            }
        }
    }

    #[test]
    #[ignore = "minutes: run by make test-long"]
    fn lags_by_silhouettes_are_right_within_their_error_or_not_reported() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        use MotionKind::{CrossArms, Dance, Jump, Squat, Turn, Walk, Wave};
        let all = [(Jump, 11), (Jump, 12), (Squat, 13), (Dance, 14)];
        let hard = [(Walk, 15), (Wave, 2), (Turn, 16), (CrossArms, 17)];
        for (kind, seed) in all.into_iter().chain(hard) {
            println!("{kind:?} {seed}");
            for (off, error) in Lagging::new(&gpu, seed, kind, 256, 240).by_silhouettes() {
                let is_all = all.contains(&(kind, seed));
                assert!(off.is_some() || !is_all, "{kind:?} {seed}: not reported, standard error {error} ms");
                let bound = if is_all { 2.0 } else { 2.0f64.max(3.0 * error) };
                assert!(off.is_none_or(|off| off.abs() <= bound), "{kind:?} {seed}: off by {off:?} of {bound} ms");
            }
        }
    }
}
