//! `flyrig record` and `flyrig replay`: cameras into a file and out of it.

use std::{
    fs,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use flyrig_calib::{calibration_toml, parse_calibration, save_export};
use flyrig_capture::{
    CameraSource, CaptureThreads, Compression, McapReplay, Note, Pacing, PopError, Recorded, Recorder, RecorderConfig,
    SourceOpener, ThreadsConfig, recorded_notes, to_rgb8,
};
use flyrig_gpu::GpuContext;
use flyrig_monitor::{Arrivals, Monitor, ended_by_itself};
use flyrig_report::{png, stop, write_whole};
use flyrig_sync::{SyncSettings, Synchronizer};
use flyrig_transport::{decode_calibration, decode_transforms, encode_calibration, encode_transforms};
use flyrig_types::{Camera, CameraId, Frame, FrameSet, PixelFormat, Rig};
use foxglove::{
    Decode as _, Encode,
    messages::{CameraCalibration, FrameTransforms, Log},
};

use crate::{
    arguments::{LagArgs, StopArgs},
    config::{Config, RecordSection, SourceKind},
    live, pose_recording,
    source::{self, Source},
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

/// Topics of the calibration in a recording, as on the network.
const CALIBRATION: &str = "calibration/";
const TRANSFORMS: &str = "transforms";
/// Topic of the cameras' names, one in a line, as the text of a foxglove `Log`.
const CAMERAS: &str = "cameras";
/// Topic of the whole calibration, time offsets included, as the text of a foxglove `Log`.
const CALIBRATION_FILE: &str = "calibration.toml";
/// How often a line with counts is printed.
const PRINT_EVERY: Duration = Duration::from_secs(5);

/// Name, encoding and content of a message's schema.
pub fn schema<M: Encode>() -> (String, String, Vec<u8>) {
    M::get_schema().map(|schema| (schema.name, schema.encoding, schema.data.into_owned())).unwrap_or_default()
}

/// Encodes a text as foxglove `Log`.
pub fn log(name: &str, message: String) -> Result<Vec<u8>> {
    let mut payload = Vec::new();
    Log { name: name.to_owned(), message, ..Log::default() }.encode(&mut payload)?;
    Ok(payload)
}

/// Opens a recording file and writes the names of the cameras into it, and the rig where it is known. Sources that are read without
/// loss are recorded without loss.
pub fn recorder(
    path: &Path,
    cameras: &[CameraId],
    rig: Option<&Rig>,
    settings: &RecordSection,
    pacing: Pacing,
) -> Result<Recorder> {
    fn note<M: Encode>(topic: String, payload: Vec<u8>) -> Note {
        Note { topic, schema: schema::<M>(), payload }
    }
    let keep_all = pacing == Pacing::Lossless;
    let quality = settings.jpeg_quality;
    let compression = (quality > 0).then_some(Compression { quality, keep_all });
    let text =
        |topic: &str, message: String| -> Result<Note> { Ok(note::<Log>(topic.to_owned(), log(topic, message)?)) };
    let names: Vec<&str> = cameras.iter().map(CameraId::as_str).collect();
    let mut notes = vec![text(CAMERAS, names.join("\n"))?];
    if let Some(rig) = rig {
        notes.push(text(CALIBRATION_FILE, calibration_toml(rig, &[])?)?);
        notes.push(note::<FrameTransforms>(TRANSFORMS.to_owned(), encode_transforms(rig)?));
        for camera in &rig.cameras {
            notes.push(note::<CameraCalibration>(format!("{CALIBRATION}{}", camera.id), encode_calibration(camera)?));
        }
    }
    let settings = RecorderConfig { compression, rotation: settings.rotate, ..RecorderConfig::default() };
    Ok(Recorder::create_with(path, &notes, &settings)?)
}

/// Returns the same cameras, recorded as they are read, whenever they are opened.
pub fn tap(recorder: &Recorder, cameras: Vec<SourceOpener>) -> Result<Vec<SourceOpener>> {
    cameras.into_iter().map(|camera| Ok(camera.recorded(recorder.source_tap())?)).collect()
}

/// Cameras of a recording, and the rig where it was calibrated when the recording was made.
pub fn recorded_cameras(path: &Path) -> Result<(Vec<CameraId>, Option<Rig>)> {
    let notes = recorded_notes(path)?;
    let text = |wanted: &str| -> Result<Option<String>> {
        let Some((_, bytes)) = notes.iter().find(|(topic, _)| topic == wanted) else { return Ok(None) };
        let log = Log::decode(bytes.as_slice()).with_context(|| format!("{}: {wanted} is damaged", path.display()))?;
        Ok(Some(log.message))
    };
    let rig = match text(CALIBRATION_FILE)? {
        Some(text) => Some(parse_calibration(path, &text)?),
        None => rig_of_messages(path, &notes)?,
    };
    let cameras = match (&rig, text(CAMERAS)?) {
        (Some(rig), _) => rig.cameras.iter().map(|camera| camera.id.clone()).collect(),
        (None, Some(names)) => names.lines().map(CameraId::from).collect(),
        (None, None) => bail!("{}: names no cameras; it is no recording of flyrig's", path.display()),
    };
    Ok((cameras, rig))
}

/// The rig that a recording was made with.
pub fn recorded_rig(path: &Path) -> Result<Rig> {
    recorded_cameras(path)?.1.with_context(|| {
        format!(
            "{}: was recorded without a calibration; make one with flyrig calibrate, and name its folder as source.calibration, or with \
             --calibration",
            path.display()
        )
    })
}

/// The rig of a take that is a recording; None for a folder.
pub fn rig_of_take(path: &Path) -> Result<Option<Rig>> {
    let ends_so = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("mcap"));
    (ends_so && !path.is_dir()).then(|| recorded_rig(path)).transpose()
}

/// The rig of recordings of earlier versions.
fn rig_of_messages(path: &Path, notes: &[(String, Vec<u8>)]) -> Result<Option<Rig>> {
    let named = |text: &str| format!("{}: {text}", path.display());
    let Some((_, bytes)) = notes.iter().find(|(topic, _)| topic == TRANSFORMS) else { return Ok(None) };
    let transforms = decode_transforms(bytes)?;
    let mut cameras = Vec::new();
    for (_, bytes) in notes.iter().filter(|(topic, _)| topic.starts_with(CALIBRATION)) {
        let (id, intrinsics) = decode_calibration(bytes)?;
        let place = transforms.camera_from_world.iter().find(|(camera, _)| *camera == id);
        let (_, camera_from_world) = place.with_context(|| named(&format!("camera {id} has no place")))?;
        cameras.push(Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id,
            intrinsics,
            camera_from_world: *camera_from_world,
        });
    }
    let rig = Rig { cameras, world_up: transforms.world_up };
    rig.validate()?;
    Ok(Some(rig))
}

/// Opens one source for each camera.
pub fn replay_sources(path: &Path, cameras: &[CameraId]) -> Result<Vec<Box<dyn CameraSource>>> {
    cameras.iter().map(|id| Ok(Box::new(McapReplay::open(id, path)?) as Box<dyn CameraSource>)).collect()
}

/// Summarises a finished recording in one line.
///
/// # Errors
/// When it broke off.
pub fn summary(recorded: &Recorded, path: &Path) -> Result<String> {
    let mut text = format!("{} frames, {:.1} MB in {}", recorded.frames, recorded.bytes as f64 / 1e6, path.display());
    // Messages are a little longer than their images.
    if recorded.bytes_sent > recorded.bytes {
        text += &format!(", as JPEG; {:.1} MB as the cameras sent them", recorded.bytes_sent as f64 / 1e6);
    }
    if recorded.dropped > 0 {
        text += &format!("; {} more were dropped because compressing them took too long", recorded.dropped);
    }
    match &recorded.problem {
        Some(problem) => bail!("the recording broke off after {text}: {problem}"),
        None => Ok(text),
    }
}

/// Runs `flyrig record`.
pub fn record(config: &Config, args: &RecordArgs, gpu: Option<&GpuContext>) -> Result<()> {
    let stop = stop::flag();
    let mut monitor = Monitor::start(&config.health.listen, false)?;
    // A take to calibrate from comes before the calibration.
    let (cameras, rig) = if config.source.kind == SourceKind::Cameras && !config.source.has_calibration() {
        eprintln!("record: no calibration; the recording is for flyrig calibrate, or gets one as source.calibration");
        (live::openers(&config.source)?, None)
    } else {
        config.check_scene()?;
        let Source { rig, cameras, .. } = source::open(config, gpu)?;
        (cameras, Some(rig))
    };
    let pacing = if config.source.kind.is_live() { Pacing::AsDelivered } else { Pacing::Lossless };
    let ids: Vec<CameraId> = cameras.iter().map(|camera| camera.camera().clone()).collect();
    let recorder = recorder(&args.out, &ids, rig.as_ref(), &config.record, pacing)?;
    let tapped = tap(&recorder, cameras)?;
    let mut arrivals = Arrivals::new(&ids);
    let threads = CaptureThreads::start_opening(tapped, ThreadsConfig { pacing, ..ThreadsConfig::default() })?;
    eprintln!("record: {} cameras to {} (Ctrl-C ends)", ids.len(), args.out.display());
    Monitor::ready();
    let (started, mut printed, mut has_ended) = (Instant::now(), Instant::now(), false);
    let is_over = || args.stop.seconds.is_some_and(|seconds| started.elapsed().as_secs_f64() >= seconds);
    while !stop.load(std::sync::atomic::Ordering::Relaxed) && !is_over() && recorder.state().problem.is_none() {
        // The frames are recorded on their way; here they are only taken out.
        match threads.queue().pop(Duration::from_millis(100)) {
            Ok(frame) => {
                arrivals.add(&frame.camera);
                monitor.stepped();
            }
            Err(PopError::Timeout) => {}
            Err(PopError::Closed) => {
                has_ended = true;
                break;
            }
        }
        monitor.report(|| (arrivals.health(&threads), Some(recorder.state())));
        if printed.elapsed() >= PRINT_EVERY {
            let state = recorder.state();
            eprintln!("record: {} frames, {:.1} MB", state.frames, state.bytes as f64 / 1e6);
            printed = Instant::now();
        }
    }
    let stats = threads.stats();
    drop(threads);
    for camera in &stats {
        let lost = camera.health.lost_by_driver;
        let error = camera.last_error.as_ref().map_or_else(String::new, |error| format!("; last error: {error}"));
        eprintln!("record: camera {}: {} frames, {lost} lost before us{error}", camera.camera, camera.frames);
    }
    let recorded = recorder.finish();
    if recorded.frames == 0 && recorded.problem.is_none() {
        // Else the next attempt would be refused for its file.
        fs::remove_file(&recorded.file).with_context(|| format!("cannot remove {}", recorded.file.display()))?;
        let last = stats.iter().find_map(|camera| camera.last_error.as_ref());
        let why = last.map_or_else(|| "no camera delivered anything".to_owned(), ToString::to_string);
        bail!("no frame was recorded, so {} was not kept: {why}", recorded.file.display());
    }
    println!("record: {}", summary(&recorded, &args.out)?);
    ensure!(!has_ended || !config.source.kind.is_live(), ended_by_itself(&stats));
    Ok(())
}

/// Runs `flyrig replay`: plays a recording through, summarises its contents, and exports it where asked to.
pub fn replay(args: &ReplayArgs) -> Result<()> {
    let stop = stop::flag();
    let (ids, rig) = recorded_cameras(&args.recording)?;
    for camera in args.lags.cameras() {
        let known: Vec<&str> = ids.iter().map(CameraId::as_str).collect();
        let is_known = known.contains(&camera.as_str());
        ensure!(is_known, "camera {camera} is not in the recording, but in --lag; it has: {}", known.join(", "));
    }
    let threads_config = ThreadsConfig { queue_capacity: 4 * ids.len().max(1), pacing: Pacing::Lossless };
    let threads = CaptureThreads::start(replay_sources(&args.recording, &ids)?, threads_config)?;
    let settings = SyncSettings { lags_nanos: args.lags.nanos(), ..SyncSettings::default() };
    let settings = settings.with_offsets_of(rig.as_ref().map_or(&[], |rig| rig.cameras.as_slice()));
    let mut sync = Synchronizer::new(&ids, &settings);
    if let Some(folder) = &args.export {
        ensure!(!folder.exists(), "{} is there already; name a new folder", folder.display());
        for id in &ids {
            fs::create_dir_all(folder.join("images").join(id.as_str()))?;
        }
        match &rig {
            Some(rig) => save_export(folder, rig)?,
            None => println!("the recording has no calibration, so neither has {}", folder.display()),
        }
    }
    let mut tallies = vec![Tally::default(); ids.len()];
    let mut digest = Digest::default();
    let export = |sets: Vec<FrameSet>| -> Result<()> {
        let Some(folder) = &args.export else { return Ok(()) };
        sets.iter().try_for_each(|set| write_set(folder, set))
    };
    loop {
        ensure!(!stop.load(std::sync::atomic::Ordering::Relaxed), "stopped before the end");
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

/// JPEG images as they are, every other as PNG.
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

#[derive(Debug, Clone, Default)]
struct Tally {
    frames: u64,
    missing: u64,
    first_nanos: i64,
    last: Option<(i64, u64)>,
    look: String,
}

impl Tally {
    fn add(&mut self, frame: &Frame) {
        match self.last {
            Some((_, sequence)) => self.missing += frame.sequence.saturating_sub(sequence).saturating_sub(1),
            None => {
                self.first_nanos = frame.capture_nanos;
                let image = &frame.image;
                self.look = format!("{:?} {}x{}", image.format(), image.width(), image.height());
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
            "{} frames of {} in {seconds:.2} s ({rate:.2} a second), {} missing",
            self.frames, self.look, self.missing
        )
    }
}

/// FNV-1a over everything about the frames: two replays of one recording must agree.
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

#[cfg(test)]
mod tests {
    use flyrig_types::{ColorMatch, Intrinsics, Isometry, Lens};
    use glam::{DVec2, DVec3};

    use super::*;

    #[test]
    fn a_recording_keeps_the_whole_calibration_or_says_that_it_has_none() {
        let folder = tempfile::tempdir().unwrap();
        let ids = ["left".into(), "right".into()];
        let make = |name: &str, rig: Option<&Rig>| {
            let path = folder.path().join(name);
            let made = recorder(&path, &ids, rig, &RecordSection::default(), Pacing::Lossless).unwrap();
            assert!(made.finish().problem.is_none());
            path
        };
        let bare = make("bare.mcap", None);
        let (cameras, rig) = recorded_cameras(&bare).unwrap();
        assert_eq!((cameras.as_slice(), rig), (ids.as_slice(), None));
        let text = recorded_rig(&bare).unwrap_err().to_string();
        assert!(
            text.contains("bare.mcap: was recorded without a calibration; make one with flyrig calibrate"),
            "{text}"
        );

        let lens = Lens::Rational { radial: [0.5, 0.12, 0.01, 0.8, 0.25, 0.02], tangential: [0.002, -0.001] };
        let camera = |id: &CameraId, lens| Camera {
            id: id.clone(),
            intrinsics: Intrinsics {
                width: 640,
                height: 480,
                focal_px: DVec2::splat(500.0),
                center_px: DVec2::new(320.0, 240.0),
                lens,
            },
            camera_from_world: Isometry::IDENTITY,
            time_offset_nanos: -45_712_345,
            color: ColorMatch { gain: [1.1, 1.0, 0.9], exponent: 1.05, falloff: [0.2, 0.1] },
        };
        let cameras =
            vec![camera(&ids[0], lens), camera(&ids[1], Lens::Fisheye { coefficients: [0.1, 0.0, 0.0, 0.0] })];
        let rig = Rig { cameras, world_up: DVec3::new(0.0, 0.6, 0.8) };
        let (_, found) = recorded_cameras(&make("whole.mcap", Some(&rig))).unwrap();
        assert_eq!(found, Some(rig));
    }
}
