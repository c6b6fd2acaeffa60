//! `flyrig-bench record`: bytes, processor time and loss of recordings of uncompressed cameras.
//!
//! Plain cameras of this process deliver images of a simulated person with sensor noise, as YUYV.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, Mutex, atomic::Ordering},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_capture::{
    CameraSource, CaptureThreads, Compression, McapReplay, Recorded, Recorder, ThreadsConfig, to_rgb8,
};
use flyrig_gpu::GpuContext;
use flyrig_report::{arguments::parse_seconds, stop};
use flyrig_sim::{SensorConfig, SimConfig, SimTime, Simulator};
use flyrig_types::{CameraId, Image, PixelFormat};

use super::{
    processor_time::{cpu_share, cpu_ticks},
    steady::{Steady, host_clock},
};
use crate::harness::arguments::PlainCameras;

/// Arguments of the command.
#[derive(Debug, Args)]
pub struct BenchRecordArgs {
    /// Seconds for each quality.
    #[arg(long, default_value_t = 5.0, value_parser = parse_seconds)]
    pub seconds: f64,
    /// JPEG qualities, comma separated; 0 records images uncompressed.
    #[arg(long, value_delimiter = ',', default_values_t = [0, 80, 90, 95, 98], value_parser = clap::value_parser!(u8).range(0..=100))]
    pub qualities: Vec<u8>,
    /// Folder of the recordings, which are removed again; the system's folder of temporary files otherwise.
    #[arg(long)]
    pub folder: Option<PathBuf>,
    #[command(flatten)]
    pub rig: PlainCameras,
}

/// Images that a camera delivers in turn.
const PICTURES: usize = 4;
/// Full well and read noise of the sensor of a webcam, electrons.
const FULL_WELL: f64 = 8000.0;
const READ_NOISE: f64 = 4.0;

/// Result of one quality.
struct Row {
    quality: u8,
    recorded: Recorded,
    /// Seconds between the two samples of processor time.
    seconds: f64,
    /// Cores used by the compression of one camera, and by the thread that writes the file.
    compressing: f64,
    writing: f64,
    /// PSNR of the recorded images in RGB; infinite for identical images.
    psnr_db: f64,
}

/// Runs the command.
pub fn record(args: &BenchRecordArgs, gpu: &GpuContext) -> Result<()> {
    let pictures = pictures(args.rig.size, gpu)?;
    let folder = args.folder.clone().unwrap_or_else(std::env::temp_dir);
    let [width, height] = args.rig.size;
    println!(
        "{} cameras of {width}x{height} YUYV at {} a second, {} s each\n\n\
         | JPEG quality | MB/s a camera | of the raw | PSNR, dB | compressing, cores a camera | writing, cores | frames | dropped |\n\
         |---|---|---|---|---|---|---|---|",
        args.rig.cameras, args.rig.fps, args.seconds
    );
    for &quality in &args.qualities {
        ensure!(!stop::requested(), "stopped");
        let path = folder.join(format!("flyrig-bench-{}-{quality}.mcap", std::process::id()));
        let row = run(args, quality, &path, &pictures);
        let removed = std::fs::remove_file(&path);
        println!("{}", row?.line(args.rig.cameras));
        removed.with_context(|| format!("cannot remove {}", path.display()))?;
    }
    Ok(())
}

impl Row {
    fn line(&self, cameras: u32) -> String {
        let quality = if self.quality == 0 { "as they come".to_owned() } else { self.quality.to_string() };
        let recorded = &self.recorded;
        format!(
            "| {quality} | {:.2} | {:.1} % | {} | {:.3} | {:.3} | {} | {} |",
            recorded.bytes as f64 / 1e6 / self.seconds.max(1e-9) / f64::from(cameras),
            100.0 * recorded.bytes as f64 / recorded.bytes_sent.max(1) as f64,
            if self.psnr_db.is_finite() { format!("{:.1}", self.psnr_db) } else { "same".to_owned() },
            self.compressing,
            self.writing,
            recorded.frames,
            recorded.dropped
        )
    }
}

fn run(args: &BenchRecordArgs, quality: u8, path: &Path, pictures: &Arc<Vec<Vec<u8>>>) -> Result<Row> {
    let stop = stop::flag();
    let compression = (quality > 0).then_some(Compression { quality, keep_all: false });
    let recorder = Recorder::create(path, &[], compression)?;
    let clock = host_clock();
    let mut sources: Vec<Box<dyn CameraSource>> = Vec::new();
    for slot in 0..args.rig.cameras {
        let id = CameraId::from(format!("{slot:02}"));
        let camera = Steady::new(id, &clock, PixelFormat::Yuyv, args.rig.size, Arc::clone(pictures), args.rig.fps);
        sources.push(Box::new(recorder.tap(camera)?));
    }
    let threads = CaptureThreads::start(sources, ThreadsConfig::default())?;
    let (before, started) = (cpu_ticks(), Instant::now());
    let run = flyrig_types::saturating_secs(args.seconds);
    while started.elapsed() < run && !stop.load(Ordering::Relaxed) {
        // Recorded on their way; here they are only taken out.
        let _ = threads.queue().pop(Duration::from_millis(100));
    }
    let (seconds, after) = (started.elapsed().as_secs_f64(), cpu_ticks());
    drop(threads);
    let recorded = recorder.finish();
    if let Some(problem) = &recorded.problem {
        anyhow::bail!("{}: {problem}", path.display());
    }
    let shares = cpu_share(&before, &after, seconds);
    let of = |name: &str| {
        let threads = shares.iter().filter(|(thread, _)| thread.starts_with(name));
        // The sum of none is minus zero.
        threads.fold(0.0, |sum, (_, share)| sum + share)
    };
    let compressing = of("jpeg ") / f64::from(args.rig.cameras);
    let psnr_db = psnr_db(path, args.rig.size, pictures)?;
    Ok(Row { quality, recorded, seconds, compressing, writing: of("recorder"), psnr_db })
}

/// Returns the PSNR of the first recorded images of the first camera against the sent ones, decibels.
fn psnr_db(path: &Path, [width, height]: [u32; 2], pictures: &[Vec<u8>]) -> Result<f64> {
    let mut replay = McapReplay::open(&"00".into(), path)?;
    let (mut square, mut count) = (0.0, 0usize);
    for _ in 0..pictures.len() {
        let Ok(frame) = replay.next_frame(Duration::ZERO) else { break };
        let sent = pictures[frame.sequence as usize % pictures.len()].clone();
        let sent = to_rgb8(&Image::new(width, height, PixelFormat::Yuyv, sent)?)?;
        let found = to_rgb8(&frame.image)?;
        square += found.iter().zip(&sent).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum::<f64>();
        count += sent.len();
    }
    ensure!(count > 0, "no frame came back");
    Ok(10.0 * (255.0 * 255.0 * count as f64 / square).log10())
}

/// Renders images of a simulated person, as YUYV.
fn pictures([width, height]: [u32; 2], gpu: &GpuContext) -> Result<Arc<Vec<Vec<u8>>>> {
    ensure!(width % 2 == 0, "YUYV needs an even width, not {width}");
    let sensor = SensorConfig {
        full_well_electrons: Some(FULL_WELL),
        read_noise_electrons: READ_NOISE,
        ..SensorConfig::default()
    };
    let config = SimConfig { width, height, sensors: vec![sensor], ..SimConfig::default() };
    let simulator = Arc::new(Mutex::new(Simulator::new(gpu, &config)?));
    let mut sources = flyrig_sim::sources(&simulator, SimTime::Exact);
    let camera = sources.first_mut().context("the simulated rig has no camera")?;
    let picture = |_| -> Result<Vec<u8>> { Ok(yuyv(&to_rgb8(&camera.next_frame(Duration::MAX)?.image)?)) };
    Ok(Arc::new((0..PICTURES).map(picture).collect::<Result<_>>()?))
}

/// Converts RGB to YUYV in BT.601 with limited range, as cameras send it; two pixels share their mean chroma.
fn yuyv(rgb: &[u8]) -> Vec<u8> {
    let byte = |value: f64| value.round().clamp(0.0, 255.0) as u8;
    let pair = |pair: &[u8]| {
        let at = |pixel: usize, channel: usize| f64::from(pair[pixel * 3 + channel]) / 255.0;
        let luma = |pixel| 0.299 * at(pixel, 0) + 0.587 * at(pixel, 1) + 0.114 * at(pixel, 2);
        let both = |channel: usize| (at(0, channel) + at(1, channel)) / 2.0;
        let mean = (luma(0) + luma(1)) / 2.0;
        let (u, v) = ((both(2) - mean) / 1.772, (both(0) - mean) / 1.402);
        [16.0 + 219.0 * luma(0), 128.0 + 224.0 * u, 16.0 + 219.0 * luma(1), 128.0 + 224.0 * v].map(byte)
    };
    rgb.chunks_exact(6).flat_map(pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_become_yuyv_and_back() {
        let rgb: Vec<u8> = (0..24u8).flat_map(|n| [n * 10, 200 - n * 5, 40 + n / 2 * 3].repeat(2)).collect();
        let image = Image::new(4, 12, PixelFormat::Yuyv, yuyv(&rgb)).unwrap();
        let back = to_rgb8(&image).unwrap();
        assert!(back.iter().zip(&rgb).all(|(a, b)| a.abs_diff(*b) <= 3), "{back:?}");
    }

    #[test]
    fn every_quality_is_measured() {
        let folder = tempfile::tempdir().unwrap();
        // Long enough for some frames, whatever else the machine does.
        let (seconds, size, qualities) = (4.0, [64, 48], vec![]);
        let rig = PlainCameras { cameras: 2, fps: 30.0, size };
        let args = BenchRecordArgs { seconds, rig, qualities, folder: None };
        let pictures = Arc::new(vec![vec![90; 64 * 48 * 2], vec![160; 64 * 48 * 2]]);
        let raw = run(&args, 0, &folder.path().join("raw.mcap"), &pictures).unwrap();
        assert!(raw.psnr_db.is_infinite() && raw.recorded.frames > 0);
        let jpeg = run(&args, 90, &folder.path().join("jpeg.mcap"), &pictures).unwrap();
        assert!(jpeg.psnr_db > 35.0 && jpeg.recorded.bytes < jpeg.recorded.bytes_sent);
        assert!(jpeg.line(2).starts_with("| 90 | "), "{}", jpeg.line(2));
    }
}
