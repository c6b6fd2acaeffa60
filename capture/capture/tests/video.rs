//! Replay of video files that these tests write.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod film;

use std::{fs, path::Path, time::Duration};

use ac_ffmpeg::time::TimeBase;
use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind, VideoOptions, VideoReplay};
use flyrig_types::{Frame, PixelFormat};

use film::{Film, film};

/// Writes a video of `count` frames at 25 per second whose red grows by 20 per frame.
fn write(path: &Path, (container, codec): (&str, &str), count: i64) {
    let times = (0..count).map(|i| 40 * i).collect();
    let color = |i: u8| [20 * i, 100, 10];
    Film { time_base: TimeBase::new(1, 25), color, ..film(container, codec, 0, times) }.write(path);
}

fn all(source: &mut VideoReplay) -> Vec<Result<Frame, CaptureError>> {
    let mut frames = Vec::new();
    loop {
        match source.next_frame(Duration::ZERO) {
            Err(error) if error.kind == CaptureErrorKind::EndOfStream => return frames,
            result => frames.push(result),
        }
    }
}

fn open(path: &Path, options: &VideoOptions) -> VideoReplay {
    VideoReplay::open(&"a".into(), path, options).unwrap()
}

#[test]
fn every_frame_comes_with_its_number_and_time() {
    let dir = tempfile::tempdir().unwrap();
    for (name, codec) in [("v.mp4", ("mp4", "mpeg4")), ("v.avi", ("avi", "mjpeg"))] {
        let path = dir.path().join(name);
        write(&path, codec, 10);
        let mut source = open(&path, &VideoOptions::default());
        assert_eq!(source.image_size(), Some((64, 48)));
        let frames: Vec<Frame> = all(&mut source).into_iter().map(Result::unwrap).collect();
        assert_eq!(frames.len(), 10, "{name}");
        for (i, frame) in frames.iter().enumerate() {
            assert_eq!((frame.sequence, frame.capture_nanos), (i as u64, i as i64 * 40_000_000), "{name}");
            assert_eq!((frame.image.width(), frame.image.height(), frame.image.format()), (64, 48, PixelFormat::Bgr8));
            let bgr = &frame.image.bytes()[..3];
            let expected = [10, 100, 20 * i as u8];
            assert!(bgr.iter().zip(expected).all(|(a, b)| a.abs_diff(b) < 12), "{name} {i}: {bgr:?} for {expected:?}");
        }
    }
}

#[test]
fn range_rate_and_offset_are_kept() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.avi");
    write(&path, ("avi", "mjpeg"), 10);
    let options = VideoOptions { fps: Some(50.0), frames: Some(3..5), offset_nanos: -7 };
    let times: Vec<(u64, i64)> = all(&mut open(&path, &options))
        .into_iter()
        .map(Result::unwrap)
        .map(|f| (f.sequence, f.capture_nanos))
        .collect();
    assert_eq!(times, [(3, 59_999_993), (4, 79_999_993)]);
    assert!(all(&mut open(&path, &VideoOptions { frames: Some(5..5), ..VideoOptions::default() })).is_empty());
}

#[test]
fn a_dropped_frame_gives_its_buffer_to_a_later_one() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.avi");
    write(&path, ("avi", "mjpeg"), 3);
    let mut source = open(&path, &VideoOptions::default());
    let address = |frame: &Frame| frame.image.bytes().as_ptr();
    let first = source.next_frame(Duration::ZERO).unwrap();
    let before = address(&first);
    drop(first);
    assert_eq!(address(&source.next_frame(Duration::ZERO).unwrap()), before);
}

#[test]
fn cut_files_are_refused_or_end_with_a_word() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.mp4");
    write(&path, ("mp4", "mpeg4"), 10);
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let error = VideoReplay::open(&"a".into(), &path, &VideoOptions::default()).unwrap_err();
    assert_eq!(error.kind, CaptureErrorKind::Corrupt);
    assert!(error.to_string().contains("v.mp4: cannot be opened as a video; it may be cut off"), "{error}");

    let path = dir.path().join("v.avi");
    write(&path, ("avi", "mjpeg"), 10);
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() * 4 / 5]).unwrap();
    let results = all(&mut open(&path, &VideoOptions::default()));
    let (last, before) = results.split_last().unwrap();
    let error = last.as_ref().unwrap_err();
    assert_eq!(error.kind, CaptureErrorKind::Corrupt);
    assert!(error.to_string().contains("bytes are missing); the file is cut off or damaged"), "{error}");
    assert!((1..9).contains(&before.len()) && before.iter().all(Result::is_ok), "{}", before.len());

    write(&path, ("avi", "mjpeg"), 0);
    let none = VideoReplay::open(&"a".into(), &path, &VideoOptions::default());
    let error = none.map(|mut source| all(&mut source).remove(0).unwrap_err()).unwrap_or_else(|error| error);
    assert_eq!(error.kind, CaptureErrorKind::Corrupt);

    for (bytes, name) in [(&b""[..], "empty.mp4"), (b"not a video at all", "text.mp4")] {
        let path = dir.path().join(name);
        fs::write(&path, bytes).unwrap();
        let error = VideoReplay::open(&"a".into(), &path, &VideoOptions::default()).unwrap_err();
        assert_eq!(error.kind, CaptureErrorKind::Corrupt, "{name}");
    }
    let error = VideoReplay::open(&"a".into(), &dir.path().join("none.mp4"), &VideoOptions::default()).unwrap_err();
    assert_eq!(error.kind, CaptureErrorKind::NotFound);
}
