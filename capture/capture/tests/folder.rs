//! Replay of folders: frames, and the errors of broken folders.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::{fs, path::Path, time::Duration};

use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind, FolderOptions, FolderReplay, folder_image_size};
use flyrig_types::{CameraId, Frame, PixelFormat};
use image::{ImageBuffer, Luma, Rgb, RgbImage};

fn paint(path: &Path, width: u32, height: u32, value: u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    RgbImage::from_pixel(width, height, Rgb([value, 100, 200])).save(path).unwrap();
}

fn paint_mask(path: &Path, width: u32, height: u32, value: u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    ImageBuffer::from_fn(width, height, |x, _| Luma([if x == 0 { 0 } else { value }])).save(path).unwrap();
}

/// Creates a folder of cameras 00 and 01 with frames 0 to 4 and masks; the red value is the frame's number.
fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for camera in ["00", "01"] {
        for frame in 0..5 {
            let image = format!("images/{camera}/{frame:06}.{}", if frame % 2 == 0 { "png" } else { "PNG" });
            paint(&dir.path().join(image), 8, 6, frame);
            paint_mask(&dir.path().join(format!("mask/{camera}/{frame:06}.png")), 8, 6, 255);
        }
    }
    dir
}

fn all(source: &mut FolderReplay) -> Vec<Result<Frame, CaptureError>> {
    let mut frames = Vec::new();
    loop {
        match source.next_frame(Duration::ZERO) {
            Err(error) if error.kind == CaptureErrorKind::EndOfStream => return frames,
            result => frames.push(result),
        }
    }
}

fn open(root: &Path, options: &FolderOptions) -> Vec<FolderReplay> {
    FolderReplay::open(root, None, options).unwrap()
}

const MASKED: FolderOptions = FolderOptions { fps: 30.0, frames: None, with_masks: true };

#[test]
fn frames_come_in_order_with_number_time_and_mask() {
    let dir = folder();
    let mut sources = open(dir.path(), &FolderOptions { fps: 25.0, frames: Some(1..4), with_masks: true });
    assert_eq!(sources.iter().map(|s| s.camera().as_str()).collect::<Vec<_>>(), ["00", "01"]);
    assert_eq!(sources[0].remaining(), 3);
    let frames: Vec<Frame> = all(&mut sources[0]).into_iter().map(Result::unwrap).collect();
    let summary: Vec<_> = frames.iter().map(|f| (f.sequence, f.capture_nanos, f.image.bytes()[0])).collect();
    assert_eq!(summary, [(1, 40_000_000, 1), (2, 80_000_000, 2), (3, 120_000_000, 3)]);
    assert_eq!((frames[0].image.width(), frames[0].image.height()), (8, 6));
    assert_eq!(frames[0].image.format(), PixelFormat::Rgb8);
    assert_eq!(frames[0].mask.as_ref().unwrap().area_px(), 7 * 6);
    let without = open(dir.path(), &FolderOptions::default())[0].next_frame(Duration::ZERO).unwrap();
    assert_eq!(without.mask, None);
}

#[test]
fn cameras_come_in_the_order_asked_for() {
    let dir = folder();
    let asked: [CameraId; 2] = ["01".into(), "00".into()];
    let sources = FolderReplay::open(dir.path(), Some(&asked), &MASKED).unwrap();
    assert_eq!(sources[0].camera().as_str(), "01");
}

#[test]
fn numbers_sort_as_numbers_and_names_as_names() {
    let dir = tempfile::tempdir().unwrap();
    for (camera, stems) in [("n", ["9", "10", "100"]), ("s", ["a10", "a9", "b"])] {
        for (value, stem) in stems.iter().enumerate() {
            paint(&dir.path().join(format!("images/{camera}/{stem}.png")), 4, 4, value as u8);
        }
    }
    let order = |camera: &str| -> Vec<(u64, u8)> {
        let mut sources = FolderReplay::open(dir.path(), Some(&[camera.into()]), &FolderOptions::default()).unwrap();
        all(&mut sources[0]).into_iter().map(Result::unwrap).map(|f| (f.sequence, f.image.bytes()[0])).collect()
    };
    assert_eq!(order("n"), [(9, 0), (10, 1), (100, 2)]);
    assert_eq!(order("s"), [(0, 0), (1, 1), (2, 2)]);
}

#[test]
fn grey_deep_and_transparent_images_become_rgb8() {
    let dir = tempfile::tempdir().unwrap();
    let images = dir.path().join("images/a");
    fs::create_dir_all(&images).unwrap();
    ImageBuffer::from_pixel(3, 2, Luma([0x8000u16])).save(images.join("0.png")).unwrap();
    ImageBuffer::from_pixel(3, 2, Luma([77u8])).save(images.join("1.jpg")).unwrap();
    ImageBuffer::from_pixel(3, 2, Rgb([0u16, 0x4000, 0xffff])).save(images.join("2.png")).unwrap();
    ImageBuffer::from_pixel(3, 2, image::Rgba([1u8, 2, 3, 0])).save(images.join("3.png")).unwrap();
    let frames = all(&mut open(dir.path(), &FolderOptions::default())[0]);
    let first: Vec<[u8; 3]> =
        frames.iter().map(|f| f.as_ref().unwrap().image.bytes()[..3].try_into().unwrap()).collect();
    assert_eq!(first, [[128; 3], [77; 3], [0, 64, 255], [1, 2, 3]]);
}

#[test]
fn broken_frames_are_named_and_the_next_one_follows() {
    let dir = folder();
    let at = |name: &str| dir.path().join(name);
    fs::remove_file(at("images/00/000000.png")).unwrap();
    let whole = fs::read(at("images/00/000001.PNG")).unwrap();
    fs::write(at("images/00/000001.PNG"), &whole[..whole.len() / 2]).unwrap();
    paint_mask(&at("mask/00/000002.png"), 4, 4, 255);
    fs::remove_file(at("mask/00/000003.png")).unwrap();
    let results = all(&mut open(dir.path(), &MASKED)[0]);
    assert_eq!(results.len(), 5);
    let expected = [
        "camera 00: frame 0 has no image, though others have; restore the file",
        "000001.PNG is a damaged or cut off image (",
        "000002.png is 4x4, its image 8x6; make the mask again at the image's size",
        "camera 00: frame 3 has no mask, though others have; restore the file",
    ];
    for (result, expected) in results.iter().zip(expected) {
        let error = result.as_ref().unwrap_err();
        assert_eq!((error.kind, error.camera.as_ref().unwrap().as_str()), (CaptureErrorKind::Corrupt, "00"));
        assert!(error.to_string().contains(expected), "{error}");
    }
    assert_eq!(results[4].as_ref().unwrap().sequence, 4);
}

#[test]
fn a_cut_jpeg_is_corrupt() {
    let dir = tempfile::tempdir().unwrap();
    paint(&dir.path().join("images/a/0.jpg"), 64, 64, 9);
    paint(&dir.path().join("images/a/1.jpeg"), 64, 64, 9);
    let whole = fs::read(dir.path().join("images/a/0.jpg")).unwrap();
    fs::write(dir.path().join("images/a/0.jpg"), &whole[..whole.len() - 30]).unwrap();
    let results = all(&mut open(dir.path(), &FolderOptions::default())[0]);
    let text = results[0].as_ref().unwrap_err().to_string();
    assert!(text.ends_with("0.jpg is a JPEG image that is cut off"), "{text}");
    assert!(results[1].is_ok());
}

#[test]
fn an_image_of_another_size_midway_is_corrupt() {
    let dir = folder();
    paint(&dir.path().join("images/00/000002.png"), 16, 12, 2);
    let results = all(&mut open(dir.path(), &FolderOptions::default())[0]);
    let text = results[2].as_ref().unwrap_err().to_string();
    assert!(text.contains("camera 00: frame 2 is 16x12, the frames before it 8x6"), "{text}");
    assert_eq!(results.iter().filter(|result| result.is_ok()).count(), 4);
}

#[test]
fn masks_may_be_empty_and_may_hold_labels() {
    let dir = folder();
    paint_mask(&dir.path().join("mask/00/000000.png"), 8, 6, 0);
    paint_mask(&dir.path().join("mask/00/000001.png"), 8, 6, 13);
    let frames = all(&mut open(dir.path(), &MASKED)[0]);
    let area = |i: usize| frames[i].as_ref().unwrap().mask.as_ref().unwrap().area_px();
    assert_eq!([area(0), area(1)], [0, 42]);
}

#[test]
fn what_is_not_there_is_said_with_what_is() {
    let dir = folder();
    let refuse = |cameras: Option<&[CameraId]>, options: &FolderOptions| {
        let error = FolderReplay::open(dir.path(), cameras, options).unwrap_err();
        (error.kind, error.to_string().replace(&format!("{}/", dir.path().display()), ""))
    };
    for bad in ["07", "../images/00", ""] {
        let (kind, text) = refuse(Some(&[bad.into()]), &MASKED);
        assert_eq!(kind, CaptureErrorKind::NotFound);
        assert_eq!(text, format!("camera {bad}: is not in images; there are: 00, 01"));
    }
    let (kind, text) = refuse(None, &FolderOptions { frames: Some(70..80), ..MASKED });
    assert_eq!((kind, text.as_str()), (CaptureErrorKind::NotFound, "no frame is in 70..80; there are frames 0 to 4"));
    for fps in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert_eq!(refuse(None, &FolderOptions { fps, ..MASKED }).0, CaptureErrorKind::Unsupported);
    }
    fs::remove_dir_all(dir.path().join("mask/01")).unwrap();
    let (kind, text) = refuse(None, &MASKED);
    assert_eq!(kind, CaptureErrorKind::NotFound);
    assert!(text.starts_with("camera 01: mask/01 cannot be listed: "), "{text}");
    fs::copy(dir.path().join("images/00/000000.png"), dir.path().join("images/00/0.jpg")).unwrap();
    let (kind, text) = refuse(None, &FolderOptions::default());
    assert_eq!(kind, CaptureErrorKind::Unsupported);
    assert!(text.contains("are the same frame; take one away"), "{text}");
    fs::create_dir(dir.path().join("images/02")).unwrap();
    let (kind, text) = refuse(Some(&["02".into()]), &FolderOptions::default());
    assert_eq!(
        (kind, text.as_str()),
        (CaptureErrorKind::NotFound, "camera 02: images/02 has no png, jpg or jpeg files")
    );

    let nowhere = FolderReplay::open(Path::new("/no/such/place"), None, &MASKED).unwrap_err();
    assert_eq!(nowhere.kind, CaptureErrorKind::NotFound);
    assert!(nowhere.to_string().starts_with("/no/such/place/images does not exist; expected a folder with"));
}

#[test]
fn the_image_size_is_read_from_a_header() {
    let dir = folder();
    fs::write(dir.path().join("images/00/000000.png"), b"rubbish").unwrap();
    assert_eq!(folder_image_size(dir.path(), &"00".into()).unwrap(), (8, 6));
    assert_eq!(folder_image_size(dir.path(), &"x".into()).unwrap_err().kind, CaptureErrorKind::NotFound);
}
