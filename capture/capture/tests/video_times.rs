//! Number and times of the frames of videos whose header promises something else.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod film;

use std::{fs, path::Path, time::Duration};

use flyrig_capture::{CameraSource, CaptureErrorKind, VideoOptions, VideoReplay};

use film::{Film, film};

/// Reads a video: times in milliseconds, luma on the left, and the texts of errors.
fn read(path: &Path) -> (Vec<f64>, Vec<u8>, Vec<String>) {
    let mut video = VideoReplay::open(&"a".into(), path, &VideoOptions::default()).unwrap();
    let (mut times, mut lumas, mut errors) = (Vec::new(), Vec::new(), Vec::new());
    loop {
        match video.next_frame(Duration::ZERO) {
            Ok(frame) => {
                assert_eq!(frame.sequence, times.len() as u64);
                times.push(frame.capture_nanos as f64 * 1e-6);
                lumas.push(frame.image.bytes()[3 * (64 * 24 + 8)]);
            }
            Err(error) if error.kind == CaptureErrorKind::EndOfStream => return (times, lumas, errors),
            Err(error) => errors.push(error.to_string()),
        }
    }
}

fn assert_times(name: &str, path: &Path, expected: &[i64]) {
    let (times, lumas, errors) = read(path);
    assert!(errors.is_empty(), "{name}: {errors:?}");
    assert_eq!(times.len(), expected.len(), "{name}");
    let first = expected[0];
    let worst = times.iter().zip(expected).map(|(time, own)| (time - (own - first) as f64).abs()).fold(0.0, f64::max);
    assert!(worst <= 1.0, "{name}: times {worst:.1} ms off: {times:?}");
    assert!(lumas.is_sorted_by(|a, b| a < b), "{name}: frames in the order in which they are shown: {lumas:?}");
}

/// Times of 40 frames: 30 per second, then 7.5.
fn variable() -> Vec<i64> {
    (0..40).map(|i| if i < 20 { i * 100 / 3 } else { 667 + (i - 20) * 400 / 3 }).collect()
}

#[test]
fn every_frame_has_its_own_time_in_every_container() {
    let dir = tempfile::tempdir().unwrap();
    let constant: Vec<i64> = (0..40).map(|i| 40 * i).collect();
    for (container, codec, reordered) in [
        ("mp4", "mpeg4", 0),
        ("mp4", "mpeg4", 2),
        ("matroska", "mpeg4", 2),
        ("mov", "mjpeg", 0),
        ("mpegts", "mpeg4", 2),
    ] {
        for (rate, times) in [("constant", constant.clone()), ("variable", variable())] {
            let name = format!("{container} {codec} {reordered} {rate}");
            let path = dir.path().join("film");
            film(container, codec, reordered, times.clone()).write(&path);
            assert_times(&name, &path, &times);
        }
    }
}

#[test]
fn a_header_that_promises_more_is_no_damage() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("film");
    // OpenCV and others multiply the length of the whole file by the frame rate.
    Film { sound: 6000, ..film("matroska", "mpeg4", 2, variable()) }.write(&path);
    assert_times("longer sound", &path, &variable());
    // A pipe: the length is unknown.
    let live = [("live", "1")];
    Film { muxing: &live, ..film("matroska", "mpeg4", 0, variable()) }.write(&path);
    assert_times("live", &path, &variable());
    let times: Vec<i64> = (0..40).map(|i| 40 * i).collect();
    film("avi", "mjpeg", 0, times.clone()).write(&path);
    let mut bytes = fs::read(&path).unwrap();
    for (chunk, offset) in [(b"avih", 8 + 16), (b"strh", 8 + 32)] {
        let at = bytes.windows(4).position(|window| window == chunk).unwrap() + offset;
        bytes[at] += 1;
    }
    fs::write(&path, bytes).unwrap();
    assert_times("one more in the header", &path, &times);
}

#[test]
fn frames_before_the_start_of_an_edit_are_not_shown() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("film");
    let times: Vec<i64> = (-8..32).map(|i| 40 * i).collect();
    // The writer keeps them in the file and skips them with an edit list.
    let muxing = [("avoid_negative_ts", "disabled")];
    Film { muxing: &muxing, ..film("mp4", "mpeg4", 2, times) }.write(&path);
    assert_times("edit list", &path, &(0..32).map(|i| 40 * i).collect::<Vec<_>>());
}

#[test]
fn a_film_of_a_turned_camera_is_upright() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("film");
    film("mp4", "mpeg4", 0, vec![0, 40]).write(&path);
    let bytes = fs::read(&path).unwrap();
    let at = bytes.windows(4).position(|window| window == b"tkhd").unwrap() + 4 + 40;
    // The bright half lies on the left of the stored image. Columns: a, b, c, d of the matrix, and where it is then.
    for (matrix, is_turned, bright) in [
        ([1, 0, 0, 1], false, (0, 24)),
        ([-1, 0, 0, -1], false, (63, 24)),
        ([-1, 0, 0, 1], false, (63, 24)),
        ([0, 1, -1, 0], true, (24, 0)),
        ([0, -1, 1, 0], true, (24, 63)),
    ] {
        let mut turned = bytes.clone();
        for (place, value) in [0, 1, 3, 4].into_iter().zip(matrix) {
            turned[at + 4 * place..at + 4 * place + 4].copy_from_slice(&(65_536i32 * value).to_be_bytes());
        }
        fs::write(&path, turned).unwrap();
        let mut video = VideoReplay::open(&"a".into(), &path, &VideoOptions::default()).unwrap();
        let size = if is_turned { (48, 64) } else { (64, 48) };
        assert_eq!(video.image_size(), Some(size), "{matrix:?}");
        let image = video.next_frame(Duration::ZERO).unwrap().image;
        assert_eq!((image.width(), image.height()), size, "{matrix:?}");
        let level = |(x, y): (u32, u32)| image.bytes()[3 * (y * size.0 + x) as usize];
        let opposite = (size.0 - 1 - bright.0, size.1 - 1 - bright.1);
        assert!(level(bright) > level(opposite), "{matrix:?}: {} {}", level(bright), level(opposite));
    }
}

#[test]
fn a_file_that_is_cut_is_reported_once_behind_its_whole_frames() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("film");
    for (container, codec, muxing) in [
        ("mp4", "mpeg4", &[("movflags", "faststart")][..]),
        ("mp4", "mpeg4", &[("movflags", "frag_keyframe+empty_moov")]),
        ("matroska", "mpeg4", &[]),
        ("avi", "mjpeg", &[]),
    ] {
        Film { muxing, ..film(container, codec, 0, variable()) }.write(&path);
        let whole = fs::read(&path).unwrap();
        fs::write(&path, &whole[..whole.len() * 4 / 5]).unwrap();
        let (times, lumas, errors) = read(&path);
        assert!((8..=40).contains(&times.len()), "{container}: {} frames", times.len());
        assert!(lumas.is_sorted_by(|a, b| a < b), "{container}: {lumas:?}");
        let [error] = &errors[..] else { panic!("{container}: {errors:?}") };
        assert!(error.contains("; the file is cut off or damaged"), "{container}: {error}");
        assert!(error.contains(&format!("ends after {} frames", times.len())), "{container}: {error}");
    }
}
