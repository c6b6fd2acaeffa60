//! `flyrig plate`: records plates, images of the empty scene that masks are computed against.

use std::{
    path::PathBuf,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use flyrig_capture::{CaptureThreads, Pacing, PopError, SourceOpener, ThreadsConfig, to_rgb8};
use flyrig_gpu::GpuContext;
use flyrig_report::{
    arguments::{FpsArgs, parse_seconds},
    png, progress_bar, stop, write_whole,
};
use flyrig_takes::{Needs, TakeOptions, dataset};
use flyrig_tracker::{PoseNet, shows_person};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

use crate::{arguments::TargetArgs, opening::open_take};

/// Arguments of `flyrig plate`.
#[derive(Debug, Args)]
pub struct PlateArgs {
    /// A configuration (*.toml), a recording (*.mcap) or a folder with images/CAM.
    pub input: PathBuf,
    /// Seconds of the median of each pixel.
    #[arg(long, default_value_t = 3.0, value_parser = parse_seconds)]
    pub secs: f64,
    #[command(flatten)]
    pub rate: FpsArgs,
    #[command(flatten)]
    pub target: TargetArgs,
}

/// Number of frames per camera in the median, spread over the time.
const FRAMES: usize = 25;
/// Time that live cameras have for their first frame, seconds.
const PATIENCE_SECS: f64 = 10.0;
/// Difference of a channel from the median beyond which something moved, sRGB bytes.
const MOVED: u8 = 28;
/// Largest fraction of frames in which a still pixel may have moved, and of pixels that may have moved more often.
const MOVED_FRAMES: f64 = 0.2;
const MOVED_PIXELS: f64 = 0.01;

/// Runs the command. `gpu` opens a graphics adapter, for simulated cameras alone.
pub fn plate(args: &PlateArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let options = TakeOptions { fps: args.rate.fps, needs: Needs::Frames, ..TakeOptions::default() };
    let take = open_take(std::slice::from_ref(&args.input), &options, gpu)?;
    let (pacing, sources) = (take.pacing(), take.sources);
    let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
    let folder = args.target.out.join("background");
    let files: Vec<PathBuf> = cameras.iter().map(|camera| dataset::plate_file(&folder, camera)).collect();
    if let Some(known) = files.iter().find(|file| file.exists()).filter(|_| !args.target.force) {
        bail!("{} is there already; --force replaces it", known.display());
    }
    if pacing == Pacing::AsDelivered {
        eprintln!("recording the empty scene for {} s: no person may be in the images", args.secs);
    }
    let scenes = record(args.secs, sources, pacing, &cameras)?;
    let net = PoseNet::embedded()?;
    let mut plates = Vec::new();
    for scene in scenes {
        let plate = scene.plate()?;
        if !args.target.force && shows_person(&net, &plate.image)? {
            bail!(
                "camera {}: a person stands in the image; leave the scene empty and try again, or accept it with --force",
                scene.camera
            );
        }
        if plate.moved > MOVED_PIXELS {
            eprintln!(
                "warning: camera {}: {:.1} % of the image moved; the plate is right only where most frames agree",
                scene.camera,
                100.0 * plate.moved
            );
        }
        plates.push(plate.image);
    }
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    for (file, plate) in files.iter().zip(&plates) {
        write_whole(file, &png::encode_rgb(plate.bytes(), plate.width(), plate.height())?)?;
        println!("{}: {}x{}", file.display(), plate.width(), plate.height());
    }
    println!(
        "next: plates are found by themselves where source.path, or the data set of flyrig eval, is {}; else set plates = \"{}\" \
         in [perception]. Record them again after a camera, its exposure or the lights have changed.",
        args.target.out.display(),
        folder.display()
    );
    Ok(())
}

/// Collects frames of every camera over some seconds.
fn record(secs: f64, sources: Vec<SourceOpener>, pacing: Pacing, cameras: &[CameraId]) -> Result<Vec<Scene>> {
    let mut scenes: Vec<Scene> = cameras.iter().cloned().map(|camera| Scene::new(camera, secs)).collect();
    let config = ThreadsConfig { queue_capacity: 4 * cameras.len(), pacing };
    let threads = CaptureThreads::start_opening(sources, config)?;
    let (started, bar) = (Instant::now(), progress_bar((FRAMES * cameras.len()) as u64, "frames of the empty scene"));
    while !scenes.iter().all(|scene| scene.full) {
        ensure!(!stop::requested(), "stopped; no plate was written");
        let frame = match threads.queue().pop(Duration::from_millis(200)) {
            Ok(frame) => frame,
            Err(PopError::Closed) => break,
            Err(PopError::Timeout) => {
                if pacing == Pacing::AsDelivered && started.elapsed().as_secs_f64() > secs + PATIENCE_SECS {
                    break;
                }
                continue;
            }
        };
        if let Some(scene) = scenes.iter_mut().find(|scene| scene.camera == frame.camera) {
            scene.add(&frame)?;
            bar.set_position(scenes.iter().map(|scene| scene.frames.len() as u64).sum());
        }
    }
    bar.finish_and_clear();
    if let Some(scene) = scenes.iter().find(|scene| scene.frames.is_empty()) {
        let stats = threads.stats().into_iter().find(|stats| stats.camera == scene.camera);
        let error = stats.and_then(|stats| stats.last_error).map(|error| format!("; the last error: {error}"));
        bail!("no image of camera {} came{}", scene.camera, error.unwrap_or_default());
    }
    Ok(scenes)
}

/// Frames of one camera.
struct Scene {
    camera: CameraId,
    secs: f64,
    size: [u32; 2],
    first_nanos: Option<i64>,
    /// RGB bytes of each frame.
    frames: Vec<Vec<u8>>,
    full: bool,
}

/// Empty scene of one camera.
struct Plate {
    image: Image,
    /// Fraction of the pixels that moved.
    moved: f64,
}

impl Scene {
    fn new(camera: CameraId, secs: f64) -> Self {
        Self { camera, secs, size: [0; 2], first_nanos: None, frames: Vec::new(), full: false }
    }

    /// Keeps the frame if it is due.
    fn add(&mut self, frame: &Frame) -> Result<()> {
        let first = *self.first_nanos.get_or_insert(frame.capture_nanos);
        let at = frame.capture_nanos.saturating_sub(first) as f64 * 1e-9;
        self.full |= at > self.secs || self.frames.len() >= FRAMES;
        if self.full || at < self.secs * self.frames.len() as f64 / FRAMES as f64 {
            return Ok(());
        }
        // Damaged frames are skipped; a camera without any frame is reported later.
        let Ok(rgb) = to_rgb8(&frame.image) else { return Ok(()) };
        let size = [frame.image.width(), frame.image.height()];
        if self.frames.is_empty() {
            self.size = size;
        }
        ensure!(
            size == self.size,
            "camera {}: images of {}x{} and of {}x{} pixels; a plate needs one size",
            self.camera,
            self.size[0],
            self.size[1],
            size[0],
            size[1]
        );
        self.frames.push(rgb);
        Ok(())
    }

    /// Computes the median over the frames for each channel of each pixel.
    fn plate(&self) -> Result<Plate> {
        let count = self.frames.len();
        let length = self.frames.first().map_or(0, Vec::len);
        let (mut median, mut values, mut moved) = (Vec::with_capacity(length), Vec::with_capacity(count), 0usize);
        let allowed = (MOVED_FRAMES * count as f64).floor() as usize;
        for pixel in 0..length / 3 {
            let mut frames_moved = 0;
            for at in 3 * pixel..3 * pixel + 3 {
                values.clear();
                values.extend(self.frames.iter().map(|frame| frame[at]));
                let (_, middle, _) = values.select_nth_unstable(count / 2);
                let middle = *middle;
                median.push(middle);
                frames_moved = frames_moved.max(values.iter().filter(|value| value.abs_diff(middle) > MOVED).count());
            }
            moved += usize::from(frames_moved > allowed);
        }
        let image = Image::new(self.size[0], self.size[1], PixelFormat::Rgb8, median)
            .with_context(|| format!("camera {}", self.camera))?;
        Ok(Plate { image, moved: moved as f64 / (length / 3).max(1) as f64 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(index: i64, side: u32, value: impl Fn(u32, u32) -> u8) -> Frame {
        let bytes: Vec<u8> = (0..side * side).flat_map(|at| [value(at % side, at / side); 3]).collect();
        Frame {
            camera: "a".into(),
            sequence: index as u64,
            capture_nanos: index * 33_000_000,
            exposure_nanos: None,
            image: Image::new(side, side, PixelFormat::Rgb8, bytes).unwrap(),
            mask: None,
        }
    }

    #[test]
    fn somebody_who_walks_through_is_not_in_the_plate_but_counts_as_motion() {
        let (mut still, mut walked) = (Scene::new("a".into(), 1.0), Scene::new("a".into(), 1.0));
        for index in 0..40 {
            let noise = (index % 3) as u8;
            still.add(&frame(index, 30, |_, _| 100 + noise)).unwrap();
            let walker = |x: u32| (i64::from(x) - index).abs() < 5;
            walked.add(&frame(index, 30, |x, _| if walker(x) { 20 } else { 100 + noise })).unwrap();
        }
        assert!(still.full && still.frames.len() >= FRAMES - 2, "{} frames", still.frames.len());
        let (still, walked) = (still.plate().unwrap(), walked.plate().unwrap());
        assert!(still.moved == 0.0 && walked.moved > MOVED_PIXELS, "{} {}", still.moved, walked.moved);
        assert!(walked.image.bytes().iter().all(|value| (100..=102).contains(value)));
    }

    #[test]
    fn images_of_two_sizes_are_refused_and_one_frame_is_a_plate() {
        let mut scene = Scene::new("a".into(), 1.0);
        scene.add(&frame(0, 8, |x, _| x as u8)).unwrap();
        let plate = scene.plate().unwrap();
        assert_eq!((plate.image.width(), plate.image.bytes()[3], plate.moved), (8, 1, 0.0));
        let error = scene.add(&frame(5, 9, |_, _| 0)).unwrap_err().to_string();
        assert!(error.contains("camera a") && error.contains("8x8") && error.contains("9x9"), "{error}");
    }
}
