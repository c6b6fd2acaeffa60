//! Recorded frames come back, however the recording ends.

use std::{
    fs,
    io::{self, Cursor, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    time::Duration,
};

use flyrig_types::{CameraId, Frame, Image, PixelFormat};

use super::{Compression, McapReplay, Note, Recorder, RecorderConfig, disk::Disk, recorded_notes};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::rgb::to_rgb8;
use crate::source::CameraSource;

pub(super) struct Script(pub CameraId, pub u64, pub u64);

fn jpeg() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image::RgbImage::from_pixel(16, 8, image::Rgb([9, 80, 200]))
        .write_to(&mut bytes, image::ImageFormat::Jpeg)
        .unwrap();
    bytes.into_inner()
}

/// Returns frame `n` of a camera: raw images for camera "a", JPEG images for every other.
pub(super) fn frame(camera: &CameraId, n: u64) -> Frame {
    let image = if camera.as_str() == "a" {
        Image::new(4, 2, PixelFormat::Yuyv, vec![n as u8; 16])
    } else {
        Image::new(16, 8, PixelFormat::Mjpeg, jpeg())
    };
    let exposure_nanos = (camera.as_str() == "a").then_some(8_000_000);
    let (camera, sequence) = (camera.clone(), n * 2);
    Frame { camera, sequence, capture_nanos: n as i64 * 33_000_000, exposure_nanos, image: image.unwrap(), mask: None }
}

impl CameraSource for Script {
    fn camera(&self) -> &CameraId {
        &self.0
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        if self.1 == self.2 {
            return Err(CaptureError::new(&self.0, CaptureErrorKind::EndOfStream, "over"));
        }
        self.1 += 1;
        Ok(frame(&self.0, self.1 - 1))
    }
}

pub(super) fn note() -> Note {
    let schema = ("flyrig.Test".to_owned(), "protobuf".to_owned(), vec![1]);
    Note { topic: "calibration/a".to_owned(), schema, payload: vec![1, 2, 3] }
}

pub(super) fn pass(source: &mut impl CameraSource) -> u64 {
    (0..).take_while(|_| source.next_frame(Duration::ZERO).is_ok()).count() as u64
}

fn record(path: &Path, frames: u64) {
    let recorder = Recorder::create(path, &[note()], None).unwrap();
    let mut taps = ["a", "b"].map(|name| recorder.tap(Script(name.into(), 0, frames)).unwrap());
    for tap in &mut taps {
        assert_eq!(pass(tap), frames);
    }
    drop(taps);
    let state = recorder.finish();
    assert_eq!((state.frames, state.problem), (2 * frames, None));
}

pub(super) fn replayed(path: &Path, camera: &str) -> Vec<Frame> {
    let mut replay = McapReplay::open(&camera.into(), path).unwrap();
    std::iter::from_fn(|| replay.next_frame(Duration::ZERO).ok()).collect()
}

pub(super) fn same(found: &Frame, wanted: &Frame) {
    let all = |f: &Frame| (f.camera.clone(), f.sequence, f.capture_nanos, f.exposure_nanos, f.image.format());
    assert_eq!(all(found), all(wanted));
    assert_eq!((found.image.width(), found.image.height()), (wanted.image.width(), wanted.image.height()));
    assert_eq!(found.image.bytes(), wanted.image.bytes());
}

#[test]
fn a_replay_gives_the_very_frames() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    record(&path, 30);
    for camera in ["a", "b"] {
        let frames = replayed(&path, camera);
        assert_eq!(frames.len(), 30);
        for (found, n) in frames.iter().zip(0..) {
            same(found, &frame(&camera.into(), n));
        }
    }
    assert_eq!(recorded_notes(&path).unwrap(), [("calibration/a".to_owned(), vec![1, 2, 3])]);
    assert!(replayed(&path, "nobody").is_empty());
}

#[test]
fn a_recorder_that_is_dropped_beside_a_running_camera_leaves_a_whole_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = Recorder::create(&path, &[note()], None).unwrap();
    let mut tap = recorder.tap(Script("a".into(), 0, 8)).unwrap();
    assert_eq!((0..5).filter(|_| tap.next_frame(Duration::ZERO).is_ok()).count(), 5);
    drop(recorder);
    assert_eq!(pass(&mut tap), 3, "the camera goes on");
    assert_eq!(replayed(&path, "a").len(), 5);
    let bytes = fs::read(&path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().expect("an index");
    assert_eq!(summary.stats.unwrap().message_count, 6, "five frames and the note");
}

#[test]
fn the_file_has_an_index_that_other_readers_use() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    record(&path, 30);
    let bytes = fs::read(&path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let statistics = summary.stats.unwrap();
    assert_eq!((statistics.message_count, statistics.channel_count), (61, 3));
    assert!(!summary.chunk_indexes.is_empty());
    let schemas: Vec<&str> = summary.schemas.values().map(|schema| schema.name.as_str()).collect();
    for name in ["foxglove.CompressedImage", "foxglove.RawImage"] {
        assert!(schemas.contains(&name), "{schemas:?}");
    }
}

#[test]
fn a_file_is_never_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    fs::write(&path, "precious").unwrap();
    let error = Recorder::create(&path, &[], None).unwrap_err();
    assert!(error.message.contains("take.mcap cannot be recorded to"), "{error}");
    assert_eq!(fs::read(&path).unwrap(), b"precious");
}

/// Truncates anywhere, as a killed process does: a prefix of the frames comes back, at most a chunk is lost.
#[test]
fn every_cut_of_a_recording_gives_the_frames_before_it() {
    let folder = tempfile::tempdir().unwrap();
    let (path, cut) = (folder.path().join("take.mcap"), folder.path().join("cut.mcap"));
    let recorder = Recorder::create(&path, &[note()], None).unwrap();
    let mut sizes = Vec::new();
    for round in 0..4u64 {
        let mut tap = recorder.tap(Script("a".into(), round * 10, round * 10 + 10)).unwrap();
        assert_eq!(pass(&mut tap), 10);
        drop(tap);
        // Until the chunk is on the disk: half a second after its first frame.
        let before = sizes.last().copied().unwrap_or(0);
        while recorder.state().frames < (round + 1) * 10 || fs::metadata(&path).unwrap().len() <= before + 1000 {
            std::thread::sleep(Duration::from_millis(10));
        }
        sizes.push(fs::metadata(&path).unwrap().len());
    }
    // Killed here: the file on the disk has no end.
    let on_disk = fs::read(&path).unwrap();
    for length in (0..=on_disk.len()).step_by(97).chain(sizes.iter().map(|size| *size as usize)) {
        fs::write(&cut, &on_disk[..length]).unwrap();
        let frames = replayed(&cut, "a");
        for (found, n) in frames.iter().zip(0..) {
            same(found, &frame(&"a".into(), n));
        }
        let whole_chunks = sizes.iter().filter(|size| **size as usize <= length).count();
        assert!(frames.len() >= whole_chunks * 10, "{length}: {} frames of {whole_chunks} chunks", frames.len());
    }
    assert_eq!(recorder.finish().frames, 40);
}

/// Disk with this much room, and a file on it.
struct SmallDisk(usize);
struct Small(Cursor<Vec<u8>>, usize);

impl Disk for SmallDisk {
    type File = Small;

    fn path(&self, _part: u32) -> PathBuf {
        "take.mcap".into()
    }

    fn create(&mut self, _part: u32) -> io::Result<Small> {
        Ok(Small(Cursor::new(Vec::new()), self.0))
    }

    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }

    fn free_bytes(&self) -> Option<u64> {
        None
    }
}

impl Write for Small {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.0.get_ref().len() + bytes.len() > self.1 {
            return Err(io::Error::from(io::ErrorKind::StorageFull));
        }
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for Small {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.0.seek(to)
    }
}

#[test]
fn a_full_disk_stops_the_recording_and_not_the_cameras() {
    let recorder = Recorder::start(SmallDisk(3000), &[], &RecorderConfig::default()).unwrap();
    let mut tap = recorder.tap(Script("a".into(), 0, 100_000)).unwrap();
    let mut passed = 0;
    while recorder.state().problem.is_none() {
        assert!(tap.next_frame(Duration::ZERO).is_ok(), "the camera was held up after {passed} frames");
        passed += 1;
        std::thread::yield_now();
        if passed == 100_000 {
            break;
        }
    }
    let mut more = recorder.tap(Script("b".into(), 0, 50)).unwrap();
    assert_eq!(pass(&mut more), 50, "cameras go on");
    drop((tap, more));
    let state = recorder.finish();
    assert!(state.bytes <= 3000, "what is not in the file does not count: {state:?}");
    let problem = state.problem.unwrap();
    let full = io::Error::from(io::ErrorKind::StorageFull).to_string();
    let told = problem.contains(&full) && problem.contains("free space on the disk");
    assert!(told || problem.contains("slower than the cameras"), "{problem}");
}

/// Corrupts a length of eight bytes to more than the available memory, which aborted the process once.
#[test]
fn a_damaged_length_ends_the_recording_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let (path, broken) = (folder.path().join("take.mcap"), folder.path().join("broken.mcap"));
    record(&path, 3);
    let whole = fs::read(&path).unwrap();
    for at in (8..whole.len().min(1500)).step_by(3) {
        let mut bytes = whole.clone();
        let end = (at + 8).min(bytes.len());
        bytes[at..end].copy_from_slice(&(i64::MAX - 5).to_le_bytes()[..end - at]);
        fs::write(&broken, &bytes).unwrap();
        assert!(replayed(&broken, "a").len() <= 3);
    }
}

#[test]
fn what_is_no_recording_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    assert_eq!(McapReplay::open(&"a".into(), &path).unwrap_err().kind, CaptureErrorKind::NotFound);
    fs::write(&path, b"not an mcap file at all").unwrap();
    assert_eq!(recorded_notes(&path).unwrap_err().kind, CaptureErrorKind::Corrupt);
    assert!(replayed(&path, "a").is_empty());
}

/// Source of prepared images.
struct Pictures(CameraId, std::vec::IntoIter<Image>, u64);

impl Pictures {
    fn new(name: &str, pictures: Vec<Image>) -> Self {
        Self(name.into(), pictures.into_iter(), 0)
    }
}

impl CameraSource for Pictures {
    fn camera(&self) -> &CameraId {
        &self.0
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        let over = || CaptureError::new(&self.0, CaptureErrorKind::EndOfStream, "over");
        let image = self.1.next().ok_or_else(over)?;
        let (camera, sequence, exposure_nanos) = (self.0.clone(), self.2, Some(4));
        self.2 += 1;
        Ok(Frame { camera, sequence, capture_nanos: sequence as i64 * 33, exposure_nanos, image, mask: None })
    }
}

/// Returns an image with ramps in brightness and colour.
fn yuyv(width: u32, height: u32, n: u32) -> Image {
    let pixel = |x: u32, y: u32| [(16 + (x * 3 + n) % 200) as u8, (64 + (y + x % 2 * 64) % 128) as u8];
    let bytes = (0..height).flat_map(|y| (0..width).flat_map(move |x| pixel(x, y))).collect::<Vec<u8>>();
    Image::new(width, height, PixelFormat::Yuyv, bytes).unwrap()
}

fn compressed(quality: u8, keep_all: bool) -> Option<Compression> {
    Some(Compression { quality, keep_all })
}

#[test]
fn uncompressed_images_are_recorded_as_jpeg_and_go_on_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let recorder = Recorder::create(&path, &[], compressed(95, true)).unwrap();
    let mut tap = recorder.tap(Pictures::new("a", (0..40).map(|n| yuyv(64, 48, n)).collect())).unwrap();
    for n in 0..40 {
        let passed = tap.next_frame(Duration::ZERO).unwrap();
        assert_eq!(passed.image.bytes(), yuyv(64, 48, n).bytes());
    }
    let mut as_sent = recorder.tap(Script("b".into(), 0, 5)).unwrap();
    assert_eq!(pass(&mut as_sent), 5);
    // An odd width has no whole pairs of pixels.
    let odd = Image::new(3, 2, PixelFormat::Yuyv, vec![7; 12]).unwrap();
    assert_eq!(pass(&mut recorder.tap(Pictures::new("odd", vec![odd])).unwrap()), 1);
    drop((tap, as_sent));
    let state = recorder.finish();
    assert_eq!((state.frames, state.dropped, state.problem), (46, 0, None));
    assert_eq!(state.bytes_sent, 40 * 64 * 48 * 2 + 5 * jpeg().len() as u64 + 12);
    let frames = replayed(&path, "a");
    for (found, n) in frames.iter().zip(0..) {
        assert_eq!(
            (found.sequence, found.capture_nanos, found.exposure_nanos),
            (u64::from(n), i64::from(n) * 33, Some(4))
        );
        assert_eq!(found.image.format(), PixelFormat::Mjpeg);
        let (found, sent) = (to_rgb8(&found.image).unwrap(), to_rgb8(&yuyv(64, 48, n)).unwrap());
        let square = found.iter().zip(&sent).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum::<f64>();
        let psnr = 10.0 * (255.0 * 255.0 / (square / sent.len() as f64)).log10();
        assert!(psnr > 35.0, "{psnr}");
    }
    assert_eq!(frames.len(), 40);
    for (found, n) in replayed(&path, "b").iter().zip(0..) {
        same(found, &frame(&"b".into(), n));
    }
    assert_eq!(replayed(&path, "odd")[0].image.format(), PixelFormat::Yuyv);
}

#[test]
fn a_machine_too_slow_for_compressing_drops_frames_and_counts_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let recorder = Recorder::create(&path, &[], compressed(90, false)).unwrap();
    // Compressing takes some hundred times as long as passing.
    let grey = |_| Image::new(2048, 2048, PixelFormat::Gray8, vec![90; 2048 * 2048]).unwrap();
    let mut tap = recorder.tap(Pictures::new("a", (0..30).map(grey).collect())).unwrap();
    assert_eq!(pass(&mut tap), 30);
    drop(tap);
    let state = recorder.finish();
    assert!(state.dropped > 0 && state.problem.is_none(), "{state:?}");
    assert_eq!(state.frames + state.dropped, 30);
    let frames = replayed(&path, "a");
    assert_eq!((frames.len() as u64, frames.last().unwrap().sequence), (state.frames, 29), "the oldest go first");
}
