//! `flyrig replay`: plays a recording through, summarises its contents, and exports it.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::atomic::Ordering,
    time::Duration,
};

use anyhow::{Result, ensure};
use clap::Args;
use flyrig_calib::{save_export, save_lenses};
use flyrig_capture::{CaptureThreads, FolderOptions, Pacing, PopError, ThreadsConfig, to_rgb8};
use flyrig_report::{png, stop, write_whole};
use flyrig_sync::{SyncSettings, Synchronizer};
use flyrig_takes::{
    Footage,
    recorded::{RecordedCameras, recorded_cameras},
};
use flyrig_types::{CameraId, Frame, FrameSet, Intrinsics, PixelFormat, Rig};

use crate::{arguments::LagArgs, opening::require_recording, pose_recording};

/// Arguments of `flyrig replay`.
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// The MCAP file.
    pub recording: PathBuf,
    /// Write the synchronized images and the calibration into this new folder (EasyMocap layout).
    #[arg(long)]
    pub export: Option<PathBuf>,
    #[command(flatten)]
    pub lags: LagArgs,
}

/// Runs the command.
pub fn replay(args: &ReplayArgs) -> Result<()> {
    stop::flag();
    let folder = args.recording.display();
    require_recording(
        &args.recording,
        "flyrig replay reads a recording (*.mcap)",
        &format!(
            "Score a folder with `flyrig eval {folder}`, or run the rig on it: source.kind = \"folder\" and `flyrig run`"
        ),
    )?;
    let recorded = recorded_cameras(&args.recording)?;
    recorded.log_notes(&args.recording);
    let RecordedCameras { ids, rig, lenses, .. } = recorded;
    for camera in args.lags.cameras() {
        let known: Vec<&str> = ids.iter().map(CameraId::as_str).collect();
        let is_known = known.contains(&camera.as_str());
        ensure!(is_known, "camera {camera} is not in the recording, but in --lag; it has: {}", known.join(", "));
    }
    let settings = SyncSettings { lags_nanos: args.lags.nanos(), ..SyncSettings::default() };
    let settings = settings.with_offsets_of(rig.as_ref().map_or(&[], |rig| rig.cameras.as_slice()));
    let mut sync = Synchronizer::new(&ids, &settings);
    let threads_config = ThreadsConfig { queue_capacity: 4 * ids.len().max(1), pacing: Pacing::Lossless };
    let footage = Footage::Recording(args.recording.clone());
    let threads = CaptureThreads::start(footage.open(Some(&ids), &FolderOptions::default())?.sources, threads_config)?;
    if let Some(folder) = &args.export {
        start_export(folder, &ids, rig.as_ref(), &lenses)?;
    }
    let (tallies, digest) = play(&threads, &ids, &mut sync, args.export.as_deref())?;
    for (id, tally) in ids.iter().zip(&tallies) {
        println!("camera {id}: {}", tally.line());
    }
    if let Some(poses) = pose_recording::summarize(&args.recording)? {
        println!("poses: {poses}");
    }
    let counts = sync.counts();
    println!("sets: {} complete, {} partial", counts.complete, counts.partial);
    println!("digest of all frames in their order: {:016x}", digest.0);
    if let Some(folder) = &args.export {
        println!("exported to {}", folder.display());
    }
    Ok(())
}

/// Reads all frames, and exports the frame sets to a folder, if any.
fn play(
    threads: &CaptureThreads,
    ids: &[CameraId],
    sync: &mut Synchronizer,
    folder: Option<&Path>,
) -> Result<(Vec<Tally>, Digest)> {
    let stop = stop::flag();
    let mut tallies = vec![Tally::default(); ids.len()];
    let mut digest = Digest::default();
    let export = |sets: Vec<FrameSet>| -> Result<()> {
        let Some(folder) = folder else { return Ok(()) };
        sets.iter().try_for_each(|set| write_set(folder, set))
    };
    loop {
        ensure!(!stop.load(Ordering::Relaxed), "stopped before the end");
        match threads.queue().pop(Duration::from_millis(200)) {
            Ok(frame) => {
                if let Some(slot) = ids.iter().position(|id| *id == frame.camera) {
                    tallies[slot].add(&frame);
                }
                digest.add(&frame);
                export(sync.push(frame))?;
            }
            Err(PopError::Timeout) => {}
            Err(PopError::Closed) => break,
        }
    }
    export(sync.flush())?;
    Ok((tallies, digest))
}

/// Makes the folders of an export and writes its calibration.
fn start_export(folder: &Path, ids: &[CameraId], rig: Option<&Rig>, lenses: &[(CameraId, Intrinsics)]) -> Result<()> {
    ensure!(!folder.exists(), "{} is there already; name a new folder", folder.display());
    for id in ids {
        fs::create_dir_all(folder.join("images").join(id.as_str()))?;
    }
    match rig {
        Some(rig) => save_export(folder, rig)?,
        None if !lenses.is_empty() => {
            let lens_folder = folder.join("lenses");
            fs::create_dir_all(&lens_folder)?;
            save_lenses(&lens_folder, lenses)?;
            println!("the recording has lenses only; they are in {}", lens_folder.display());
        }
        None => println!("the recording has no calibration, so neither has {}", folder.display()),
    }
    Ok(())
}

/// Writes the images of a frame set: JPEG images unchanged, all others as PNG.
fn write_set(folder: &Path, set: &FrameSet) -> Result<()> {
    for (_, frame) in set.present() {
        let (image, stem) = (&frame.image, format!("{:06}", set.index));
        let path = folder.join("images").join(frame.camera.as_str());
        match image.format() {
            PixelFormat::Mjpeg => write_whole(&path.join(stem + ".jpg"), image.bytes())?,
            _ => {
                let encoded = png::encode_rgb(&to_rgb8(image)?, image.width(), image.height())?;
                write_whole(&path.join(stem + ".png"), &encoded)?;
            }
        }
    }
    Ok(())
}

/// Frames of one camera.
#[derive(Debug, Clone, Default)]
struct Tally {
    frames: u64,
    /// Gaps in the frame numbers.
    missing: u64,
    first_nanos: i64,
    /// Timestamp (nanoseconds) and number of the last frame.
    last: Option<(i64, u64)>,
    /// Format and size of the first image.
    format: String,
}

impl Tally {
    fn add(&mut self, frame: &Frame) {
        match self.last {
            Some((_, sequence)) => self.missing += frame.sequence.saturating_sub(sequence).saturating_sub(1),
            None => {
                self.first_nanos = frame.capture_nanos;
                let image = &frame.image;
                self.format = format!("{:?} {}x{}", image.format(), image.width(), image.height());
            }
        }
        self.frames += 1;
        self.last = Some((frame.capture_nanos, frame.sequence));
    }

    fn line(&self) -> String {
        let Some((last, _)) = self.last else { return "no frame".to_owned() };
        let seconds = last.saturating_sub(self.first_nanos) as f64 * 1e-9;
        let rate = if seconds > 0.0 { (self.frames - 1) as f64 / seconds } else { 0.0 };
        format!(
            "{} frames of {} in {seconds:.2} s ({rate:.2} per second), {} missing",
            self.frames, self.format, self.missing
        )
    }
}

/// FNV-1a hash of all frames with their timestamps and numbers, equal for all replays of a recording.
struct Digest(u64);

impl Default for Digest {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Digest {
    fn add(&mut self, frame: &Frame) {
        let numbers = [frame.sequence.to_le_bytes(), frame.capture_nanos.to_le_bytes()];
        let name = frame.camera.as_str().as_bytes();
        for byte in name.iter().chain(numbers.iter().flatten()).chain(frame.image.bytes()) {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
}
