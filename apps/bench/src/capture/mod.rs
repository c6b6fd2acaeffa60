//! `flyrig-bench capture`: frame rate, latency, memory and processor time of capture over a long take.
//!
//! Frames of plain cameras of this process pass through the same stages as those of real cameras: camera threads, decoding, the queue,
//! the synchronizer.

mod processor_time;
pub mod record;
mod steady;

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::{Result, ensure};
use clap::Args;
use flyrig_capture::{CameraSource, FrameStage as _, JpegEncoding, Pacing};
use flyrig_fusion::{InputFormat, Intake, resident_mib};
use flyrig_report::{arguments::parse_minutes, stop};
use flyrig_sync::SyncSettings;
use flyrig_types::{Frame, Image, PixelFormat};

use crate::harness::arguments::PlainCameras;
use processor_time::{cpu_share, cpu_ticks};
use steady::{Steady, host_clock};

/// Arguments of the command.
#[derive(Debug, Args)]
pub struct BenchCaptureArgs {
    /// Duration, minutes.
    #[arg(long, default_value_t = 30.0, value_parser = parse_minutes)]
    pub minutes: f64,
    #[command(flatten)]
    pub rig: PlainCameras,
}

/// Fraction of the run after which memory is measured: buffers and pools have grown by then.
const WARM_UP: f64 = 0.1;
/// Number of memory samples in a run.
const LOOKS: u32 = 180;
const CELLS: u32 = 40;

/// Creates the cameras; every second one sends JPEG.
fn cameras(args: &BenchCaptureArgs) -> Result<Vec<Box<dyn CameraSource>>> {
    let clock = host_clock();
    let [width, height] = args.rig.size;
    let yuyv: Vec<u8> =
        (0..height).flat_map(|y| (0..width).flat_map(move |x| [((x / 8 + y / 8) * 5 % 220 + 16) as u8, 128])).collect();
    let raw = || Image::new(width, height, PixelFormat::Yuyv, yuyv.clone());
    let plain = Frame {
        camera: "plain".into(),
        sequence: 0,
        capture_nanos: 0,
        exposure_nanos: None,
        image: raw()?,
        mask: None,
    };
    let jpeg = JpegEncoding::new(90).process(plain)?;
    let (jpeg, yuyv) = (Arc::new(vec![jpeg.image.bytes().to_vec()]), Arc::new(vec![yuyv]));
    let camera = |slot: u32| {
        let is_jpeg = slot % 2 == 1;
        let (format, pictures) = if is_jpeg { (PixelFormat::Mjpeg, &jpeg) } else { (PixelFormat::Yuyv, &yuyv) };
        let (id, pictures) = (format!("{slot:02}").into(), Arc::clone(pictures));
        Box::new(Steady::new(id, &clock, format, args.rig.size, pictures, args.rig.fps)) as Box<dyn CameraSource>
    };
    Ok((0..args.rig.cameras).map(camera).collect())
}

/// Runs the command.
pub fn capture(args: &BenchCaptureArgs) -> Result<()> {
    let stop = stop::flag();
    let clock = host_clock();
    let mut intake =
        Intake::start(cameras(args)?, InputFormat::AnySize, &SyncSettings::default(), Pacing::AsDelivered)?.live();
    let run = flyrig_types::saturating_secs(args.minutes * 60.0);
    let sets = (run.as_secs_f64() * args.rig.fps * 1.1) as usize;
    // All of its memory is taken before the measurement.
    let mut latencies_us: Vec<u32> = vec![0; sets.max(16)];
    let (mut count, mut memory) = (0, Vec::with_capacity(2 * LOOKS as usize));
    let (started, cpu_before) = (Instant::now(), cpu_ticks());
    let mut look_at = Duration::ZERO;
    while started.elapsed() < run && !stop.load(std::sync::atomic::Ordering::Relaxed) {
        if let Some(set) = intake.next_set(Duration::from_millis(200)) {
            let newest = set.present().map(|(_, frame)| frame.capture_nanos).max().unwrap_or(set.master_nanos);
            let late_us = clock.now_nanos().saturating_sub(newest).max(0) / 1000;
            if let Some(place) = latencies_us.get_mut(count) {
                *place = u32::try_from(late_us).unwrap_or(u32::MAX);
                count += 1;
            }
        }
        if started.elapsed() >= look_at {
            look_at += run / LOOKS;
            memory.extend(resident_mib().map(|mib| (started.elapsed().as_secs_f64(), mib)));
        }
    }
    let seconds = started.elapsed().as_secs_f64();
    let cpu = cpu_ticks();
    print!(
        "{}",
        report(args, &intake, seconds, &mut latencies_us[..count], &memory, &cpu_share(&cpu_before, &cpu, seconds))
    );
    ensure!(count > 0, "no set came");
    Ok(())
}

fn report(
    args: &BenchCaptureArgs,
    intake: &Intake,
    seconds: f64,
    latencies_us: &mut [u32],
    memory: &[(f64, f64)],
    cpu: &BTreeMap<String, f64>,
) -> String {
    latencies_us.sort_unstable();
    let at = |share: f64| {
        let index = (latencies_us.len().saturating_sub(1) as f64 * share).round() as usize;
        latencies_us.get(index).map_or(0.0, |us| f64::from(*us) / 1e3)
    };
    let [width, height] = args.rig.size;
    let health = intake.health();
    let mut text = format!(
        "{} cameras of {width}x{height} at {} per second (YUYV and MJPEG in turn) for {seconds:.1} s\n",
        args.rig.cameras, args.rig.fps
    );
    let _ = writeln!(
        text,
        "sets: {} complete, {} partial, {} skipped\ncapture to set: {:.2} ms p50, {:.2} ms p99, {:.2} ms longest",
        health.complete_sets,
        health.partial_sets,
        health.skipped_sets,
        at(0.5),
        at(0.99),
        at(1.0)
    );
    let warm: Vec<(f64, f64)> = memory.iter().copied().filter(|(secs, _)| *secs >= seconds * WARM_UP).collect();
    if let (Some((_, first)), Some((_, last))) = (warm.first(), warm.last()) {
        let slope = slope(&warm) * 3600.0;
        let _ = writeln!(text, "memory: {first:.1} to {last:.1} MiB, slope {slope:+.2} MiB per hour");
    }
    for (thread, share) in cpu.iter().filter(|(_, share)| **share >= 0.0005) {
        let _ = writeln!(text, "processor: {:.2} % of a core by {thread}", share * 100.0);
    }
    for camera in &health.cameras {
        let stats = &camera.stats;
        let errors: u64 = stats.errors.values().sum();
        let _ = writeln!(
            text,
            "camera {}: {}, {} frames, {} lost before us, {} overtaken, {} waited too long, {} in no set, {errors} errors",
            stats.camera,
            stats.health.mode,
            stats.frames,
            stats.health.lost_by_driver,
            stats.overtaken,
            stats.dropped,
            camera.in_no_set
        );
    }
    let _ = writeln!(text, "memory over time: {}", sparkline(memory));
    text
}

/// Returns the slope of the least-squares line through points.
fn slope(points: &[(f64, f64)]) -> f64 {
    let n = points.len().max(1) as f64;
    let mean = |f: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / n;
    let (x, y) = (mean(&|p| p.0), mean(&|p| p.1));
    let spread = points.iter().map(|p| (p.0 - x).powi(2)).sum::<f64>();
    if spread > 0.0 { points.iter().map(|p| (p.0 - x) * (p.1 - y)).sum::<f64>() / spread } else { 0.0 }
}

/// Formats a subset of the memory samples, MiB.
fn sparkline(memory: &[(f64, f64)]) -> String {
    let step = memory.len().div_ceil(CELLS as usize).max(1);
    memory.iter().step_by(step).map(|(_, mib)| format!("{mib:.1}")).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_is_found() {
        let points: Vec<(f64, f64)> = (0..50).map(|i| (f64::from(i), 3.0 + 0.25 * f64::from(i))).collect();
        assert!((slope(&points) - 0.25).abs() < 1e-12);
        assert!(slope(&[]).abs() < 1e-12 && slope(&points[..1]).abs() < 1e-12);
    }

    #[test]
    fn a_short_run_makes_whole_sets() {
        let args = BenchCaptureArgs { minutes: 0.05, rig: PlainCameras { cameras: 2, fps: 30.0, size: [64, 48] } };
        let mut intake =
            Intake::start(cameras(&args).unwrap(), InputFormat::AnySize, &SyncSettings::default(), Pacing::AsDelivered)
                .unwrap();
        let set = std::iter::repeat_with(|| intake.next_set(Duration::from_secs(5))).flatten().next().unwrap();
        assert!(set.present().all(|(_, frame)| frame.image.format() == PixelFormat::Rgb8));
        let text = report(
            &args,
            &intake,
            3.0,
            &mut [3000, 1000, 2000],
            &[(0.0, 9.0), (1.0, 10.0), (2.0, 11.0)],
            &BTreeMap::new(),
        );
        assert!(text.contains("2.00 ms p50, 3.00 ms p99") && text.contains("slope +3600.00 MiB per hour"), "{text}");
        if cfg!(target_os = "linux") {
            assert!(!cpu_ticks().is_empty());
        }
    }
}
