//! Recordings of other programs, written here as those programs write them.

use std::{collections::BTreeMap, fs, io::Cursor, path::Path, time::Duration};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use flyrig_types::{Frame, Lens, PixelFormat};
use foxglove::{
    Encode as _,
    messages::{CameraCalibration, RawImage, Timestamp},
};
use mcap::{Compression, WriteOptions, Writer, records::MessageHeader};

use super::*;
use crate::{recording::McapReplay, source::CameraSource as _};

/// Second of the first image.
const START: u32 = 1_700_000_000;

/// Message to be written: topic, schema, its encoding, the message's encoding, log time, payload.
struct Entry(String, &'static str, &'static str, i64, Vec<u8>);

fn write(path: &Path, compression: Option<Compression>, entries: &[Entry]) {
    let options = WriteOptions::new().compression(compression).chunk_size(Some(20_000));
    let mut writer = Writer::with_options(fs::File::create(path).unwrap(), options).unwrap();
    for Entry(topic, schema, encoding, nanos, payload) in entries {
        let kind = if *encoding == "protobuf" { "protobuf" } else { "ros2msg" };
        let schema = writer.add_schema(schema, kind, b"text").unwrap();
        let channel_id = writer.add_channel(schema, topic, encoding, &BTreeMap::new()).unwrap();
        let log_time = *nanos as u64;
        let header = MessageHeader { channel_id, sequence: 0, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, payload).unwrap();
    }
    writer.finish().unwrap();
}

/// Writer of ROS messages.
struct Ros {
    bytes: Vec<u8>,
    is_big_endian: bool,
    is_ros1: bool,
}

impl Ros {
    fn new(is_big_endian: bool) -> Self {
        Self { bytes: vec![0, u8::from(!is_big_endian), 0, 0], is_big_endian, is_ros1: false }
    }

    fn put(mut self, little: &[u8]) -> Self {
        while !self.is_ros1 && !(self.bytes.len() - 4).is_multiple_of(little.len()) {
            self.bytes.push(0);
        }
        let mut bytes = little.to_vec();
        if self.is_big_endian {
            bytes.reverse();
        }
        self.bytes.extend(bytes);
        self
    }

    fn u32(self, value: u32) -> Self {
        self.put(&value.to_le_bytes())
    }

    fn f64s(self, values: &[f64]) -> Self {
        values.iter().fold(self, |to, value| to.put(&value.to_le_bytes()))
    }

    fn data(self, bytes: &[u8]) -> Self {
        let mut to = self.u32(bytes.len() as u32);
        to.bytes.extend(bytes);
        to
    }

    fn text(self, text: &str) -> Self {
        let bytes = if self.is_ros1 { text.to_owned() } else { format!("{text}\0") };
        self.data(bytes.as_bytes())
    }

    fn header(self, nanos: i64, frame_id: &str) -> Self {
        let to = if self.is_ros1 { self.u32(0) } else { self };
        to.u32((nanos / 1_000_000_000) as u32).u32((nanos % 1_000_000_000) as u32).text(frame_id)
    }
}

fn jpeg() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image::RgbImage::from_pixel(16, 8, image::Rgb([9, 80, 200]))
        .write_to(&mut bytes, image::ImageFormat::Jpeg)
        .unwrap();
    bytes.into_inner()
}

fn png() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image::RgbImage::from_pixel(16, 8, image::Rgb([9, 80, 200])).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

fn nanos(n: u32) -> i64 {
    i64::from(START) * 1_000_000_000 + i64::from(n) * 33_000_000
}

const K: [f64; 9] = [500.0, 0.0, 8.0, 0.0, 510.0, 4.0, 0.0, 0.0, 1.0];

fn camera_info(ros: Ros, frame_id: &str, model: &str, d: &[f64]) -> Vec<u8> {
    let ros = ros.header(nanos(0), frame_id).u32(8).u32(16).text(model).u32(d.len() as u32).f64s(d);
    let ros = ros.f64s(&K).f64s(&[0.0; 9]).f64s(&[0.0; 12]).u32(0).u32(0).u32(0).u32(0).u32(0).u32(0);
    ros.put(&[0]).bytes
}

fn transform(parent: &str, child: &str, [x, y, z]: [f64; 3]) -> Vec<u8> {
    // Looks along x of a parent with z up.
    let ros = Ros::new(false).u32(1).header(nanos(0), parent).text(child);
    ros.f64s(&[x, y, z, -0.5, 0.5, -0.5, 0.5]).bytes
}

/// A rig of two cameras as ROS 2 records it; the recorder's clock is 5 ms late.
fn ros2(is_big_endian: bool) -> Vec<Entry> {
    let mut entries = Vec::new();
    for (camera, place) in [("cam_a", [0.0, 0.0, 1.0]), ("cam_b", [0.0, -2.0, 1.0])] {
        let payload = transform("base_link", &format!("{camera}_optical"), place);
        entries.push(Entry("/tf_static".to_owned(), "tf2_msgs/msg/TFMessage", "cdr", nanos(0), payload));
    }
    for n in 0..5 {
        for (camera, model, d) in
            [("cam_a", "plumb_bob", &[0.1, 0.2, 0.3, 0.4, 0.5][..]), ("cam_b", "equidistant", &[0.1; 4])]
        {
            let (ros, frame) = (|| Ros::new(is_big_endian), format!("{camera}_optical"));
            let image = ros().header(nanos(n), &frame).text("jpeg").data(&jpeg()).bytes;
            let topic = format!("/{camera}/image_raw/compressed");
            let late = nanos(n) + 5_000_000;
            entries.push(Entry(topic, "sensor_msgs/msg/CompressedImage", "cdr", late, image));
            let info = camera_info(ros(), &frame, model, d);
            entries.push(Entry(format!("/{camera}/camera_info"), "sensor_msgs/msg/CameraInfo", "cdr", late, info));
        }
    }
    entries
}

fn frames(path: &Path, camera: &ForeignCamera) -> Vec<Frame> {
    let mut replay = McapReplay::open_camera(&camera.images, path).unwrap();
    std::iter::from_fn(|| replay.next_frame(Duration::ZERO).ok()).collect()
}

fn with_file<T>(entries: &[Entry], look: impl FnOnce(&Path) -> T) -> T {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    write(&path, None, entries);
    look(&path)
}

#[test]
fn a_ros2_recording_is_read_in_any_compression_and_byte_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    for (compression, is_big_endian) in
        [(None, true), (Some(Compression::Zstd), false), (Some(Compression::Lz4), false), (None, false)]
    {
        write(&path, compression, &ros2(is_big_endian));
        let found = foreign_cameras(&path).unwrap();
        assert_eq!((found.lacks, found.notes, found.up), (None, Vec::new(), Some(DVec3::Z)));
        let names: Vec<&str> = found.cameras.iter().map(|camera| camera.images.id.as_str()).collect();
        assert_eq!(names, ["cam_a", "cam_b"]);
        let lenses: Vec<Lens> = found.cameras.iter().map(|camera| camera.intrinsics.unwrap().lens).collect();
        let radial = Lens::RadialTangential { radial: [0.1, 0.2, 0.5], tangential: [0.3, 0.4] };
        assert_eq!(lenses, [radial, Lens::Fisheye { coefficients: [0.1; 4] }]);
        let pose = found.cameras[1].camera_from_world.unwrap();
        assert!(pose.inverse().translation.distance(DVec3::new(0.0, -2.0, 1.0)) < 1e-12);
        assert!((pose.rotation.inverse() * DVec3::Z).distance(DVec3::X) < 1e-12);
        let frames = frames(&path, &found.cameras[1]);
        assert_eq!(frames.len(), 5);
        for (n, frame) in (0..).zip(&frames) {
            let stamp = (frame.sequence, frame.capture_nanos);
            assert_eq!(stamp, (u64::from(n), nanos(n)), "the camera's time, not the recorder's");
            assert_eq!((frame.image.format(), frame.image.bytes()), (PixelFormat::Mjpeg, jpeg().as_slice()));
        }
        let spans = crate::recorded_spans(&path, &[found.cameras[0].images.clone()]).unwrap();
        assert_eq!((spans[0].frames, spans[0].nanos), (5, [nanos(0), nanos(4)]));
    }
}

/// Foxglove's schemas in protobuf, with `timestamp` of each image or none.
fn foxglove(has_stamps: bool) -> Vec<Entry> {
    let mut entries = Vec::new();
    for n in 0..3 {
        let timestamp = has_stamps.then(|| Timestamp::new(START, n * 33_000_000));
        for camera in ["front", "side"] {
            let frame_id = camera.to_owned();
            let mut payload = Vec::new();
            // Rows with two bytes of padding.
            let data = [vec![7u8; 48], vec![0; 2]].concat().repeat(8).into();
            let image = RawImage { timestamp, frame_id, width: 16, height: 8, encoding: "rgb8".into(), step: 50, data };
            image.encode(&mut payload).unwrap();
            entries.push(Entry(format!("/{camera}/image"), "foxglove.RawImage", "protobuf", nanos(n) + 7, payload));
        }
    }
    for camera in ["front", "side"] {
        let (distortion_model, d) = ("rational_polynomial".to_owned(), vec![0.1; 8]);
        let (frame_id, width, height) = (camera.to_owned(), 16, 8);
        let lens =
            CameraCalibration { frame_id, width, height, distortion_model, d, k: K.to_vec(), ..Default::default() };
        let mut payload = Vec::new();
        lens.encode(&mut payload).unwrap();
        let topic = format!("/{camera}/calibration");
        entries.push(Entry(topic, "foxglove.CameraCalibration", "protobuf", nanos(0), payload));
    }
    entries
}

#[test]
fn foxgloves_images_and_lenses_are_read_and_missing_poses_are_named() {
    with_file(&foxglove(true), |path| {
        let found = foreign_cameras(path).unwrap();
        let lacks = found.lacks.unwrap();
        assert_eq!(lacks, "the cameras have no poses: it has no transforms (topic /tf_static)");
        let lens = Lens::Rational { radial: [0.1; 6], tangential: [0.1; 2] };
        assert!(found.cameras.iter().all(|camera| camera.intrinsics.unwrap().lens == lens));
        let frames = frames(path, &found.cameras[0]);
        assert_eq!((frames.len(), frames[2].capture_nanos), (3, nanos(2)));
        assert_eq!((frames[0].image.format(), frames[0].image.bytes()), (PixelFormat::Rgb8, &[7; 384][..]));
    });
    // Without timestamps the recorder's times are all there is, and this is said.
    with_file(&foxglove(false), |path| {
        let found = foreign_cameras(path).unwrap();
        assert!(found.notes[0].contains("times at which they were recorded"), "{:?}", found.notes);
        assert_eq!(frames(path, &found.cameras[1])[2].capture_nanos, nanos(2) + 7);
    });
}

#[test]
fn json_and_ros1_are_read_as_well() {
    let stamp = |n: u32| format!("{{\"sec\": {START}, \"nsec\": {}}}", n * 33_000_000);
    let mut entries = Vec::new();
    for n in 0..3 {
        for camera in ["a", "b"] {
            let (data, time) = (STANDARD.encode(png()), stamp(n));
            let json = format!(r#"{{"timestamp": {time}, "frame_id": "{camera}", "data": "{data}", "format": "png"}}"#);
            entries.push(Entry(format!("/{camera}/image"), "foxglove.CompressedImage", "json", nanos(n), json.into()));
        }
    }
    let lens = format!(
        r#"{{"timestamp": {}, "frame_id": "a", "width": 16, "height": 8, "distortion_model": "plumb_bob",
            "D": [0.1, 0, 0, 0, 0], "K": [500, 0, 8, 0, 510, 4, 0, 0, 1], "R": [], "P": []}}"#,
        stamp(0)
    );
    entries.push(Entry("/a/calibration".to_owned(), "foxglove.CameraCalibration", "json", nanos(0), lens.into()));
    with_file(&entries, |path| {
        let found = foreign_cameras(path).unwrap();
        assert!(found.cameras[0].intrinsics.is_some());
        assert!(found.lacks.unwrap().starts_with("camera b has no lens: the file has no calibration"));
        let frames = frames(path, &found.cameras[1]);
        assert_eq!((frames.len(), frames[1].capture_nanos), (3, nanos(1)));
        assert_eq!((frames[0].image.format(), &frames[0].image.bytes()[..3]), (PixelFormat::Rgb8, &[9, 80, 200][..]));
    });
    let ros = || Ros { bytes: Vec::new(), is_big_endian: false, is_ros1: true };
    let image = |n: u32| ros().header(nanos(n), "a").text("jpeg").data(&jpeg()).bytes;
    let entry = |n| Entry("/cam/compressed".to_owned(), "sensor_msgs/CompressedImage", "ros1", nanos(n), image(n));
    with_file(&[entry(0), entry(1)], |path| {
        let found = foreign_cameras(path).unwrap();
        assert_eq!(frames(path, &found.cameras[0])[1].capture_nanos, nanos(1));
    });
}

#[test]
fn what_cannot_be_read_is_named_and_what_is_double_is_left_out() {
    let raw = |camera: &str, n, encoding: &str, bytes: usize| {
        let ros =
            Ros::new(false).header(nanos(n), camera).u32(8).u32(16).text(encoding).put(&[0]).u32(bytes as u32 / 8);
        ros.data(&vec![1; bytes]).bytes
    };
    let image = "sensor_msgs/msg/Image";
    let mut entries = ros2(false);
    for n in 0..3 {
        let mut add = |topic: &str, schema, encoding, payload| {
            entries.push(Entry(topic.to_owned(), schema, encoding, nanos(n), payload));
        };
        add("/cam_a/image_raw", image, "cdr", raw("cam_a_optical", n, "bgr8", 384));
        add("/cam_a/image_rect", image, "cdr", raw("cam_a_optical", n, "mono8", 128));
        add("/cam_a/depth", image, "cdr", raw("cam_a_optical", n, "16UC1", 256));
        add("/cam_b/video", "foxglove.CompressedVideo", "protobuf", Vec::new());
        add("/cam_b/flat", "foxglove.RawImage", "flatbuffer", Vec::new());
    }
    with_file(&entries, |path| {
        let found = foreign_cameras(path).unwrap();
        let topics: Vec<&str> = found.cameras.iter().map(|camera| camera.images.topic.as_str()).collect();
        assert_eq!(topics, ["/cam_a/image_raw", "/cam_b/image_raw/compressed"]);
        assert_eq!(frames(path, &found.cameras[0])[0].image.format(), PixelFormat::Bgr8);
        let notes = found.notes.join("\n");
        for text in [
            "'/cam_a/depth' is left out: encoding \"16UC1\" cannot be read",
            "'/cam_a/image_raw/compressed' is left out: '/cam_a/image_raw' has the same camera's images",
            "'/cam_a/image_rect' is left out",
            "'/cam_b/video' is left out: foxglove.CompressedVideo is a video",
            "'/cam_b/flat' is left out: foxglove.RawImage is encoded as 'flatbuffer'",
        ] {
            assert!(notes.contains(text), "{text}: {notes}");
        }
    });
    let only = [Entry("/imu".to_owned(), "sensor_msgs/msg/Imu", "cdr", 1, vec![0; 9])];
    let error = with_file(&only, |path| foreign_cameras(path).unwrap_err().to_string());
    assert!(error.contains("take.mcap: names no cameras") && error.ends_with("it has the topics '/imu'"), "{error}");
    let video = [Entry("/v".to_owned(), "foxglove.CompressedVideo", "protobuf", 1, vec![0; 9])];
    let error = with_file(&video, |path| foreign_cameras(path).unwrap_err().to_string());
    assert!(error.contains("topic '/v': foxglove.CompressedVideo is a video"), "{error}");
}

#[test]
fn names_that_no_camera_may_have_are_refused_with_the_topic() {
    for (topic, name) in [("/../image", "'..'"), ("/a\u{1b}[2J/image", "'a\\u{1b}[2J'"), ("/a\\b/image", "'a\\b'")] {
        let payload = Ros::new(false).header(nanos(0), "a").text("jpeg").data(&jpeg()).bytes;
        let entry = [Entry(topic.to_owned(), "sensor_msgs/msg/CompressedImage", "cdr", 1, payload)];
        let error = with_file(&entry, |path| foreign_cameras(path).unwrap_err().to_string());
        assert!(error.contains("take.mcap: topic '/") && error.contains(name), "{error}");
        assert!(!error.contains('\u{1b}'), "{error}");
    }
}

#[test]
fn timestamps_that_do_not_increase_or_belong_to_other_clocks_are_not_used() {
    let file = |stamps: &dyn Fn(&str, u32) -> i64| {
        let mut entries = Vec::new();
        for n in 0..4 {
            for camera in ["a", "b"] {
                let image = Ros::new(false).header(stamps(camera, n), camera).text("jpeg").data(&jpeg()).bytes;
                let topic = format!("/{camera}/compressed");
                entries.push(Entry(topic, "sensor_msgs/msg/CompressedImage", "cdr", nanos(n), image));
            }
        }
        with_file(&entries, |path| {
            let found = foreign_cameras(path).unwrap();
            let times: Vec<i64> = frames(path, &found.cameras[1]).iter().map(|frame| frame.capture_nanos).collect();
            (found.notes.join("; "), times)
        })
    };
    let logged: Vec<i64> = (0..4).map(nanos).collect();
    let (notes, times) = file(&|camera, n| if camera == "a" { nanos(n) } else { nanos(3 - n) });
    assert!(notes.contains("timestamps of camera b do not increase") && times == logged, "{notes} {times:?}");
    let (notes, times) = file(&|camera, n| if camera == "a" { nanos(n) } else { i64::from(n + 1) * 33_000_000 });
    assert!(notes.contains("different clocks") && times == logged, "{notes} {times:?}");
    let (notes, times) = file(&|_, n| nanos(n) + 1);
    assert!(notes.is_empty() && times[3] == nanos(3) + 1, "{notes} {times:?}");
}

#[test]
fn every_cut_and_many_damages_of_a_foreign_recording_end_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let (path, broken) = (folder.path().join("take.mcap"), folder.path().join("broken.mcap"));
    for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
        write(&path, compression, &ros2(false));
        let whole = fs::read(&path).unwrap();
        let look = |bytes: &[u8]| {
            fs::write(&broken, bytes).unwrap();
            match foreign_cameras(&broken) {
                Ok(found) => found.cameras.iter().for_each(|camera| assert!(frames(&broken, camera).len() <= 5)),
                Err(error) => assert!(error.to_string().contains("broken.mcap"), "{error}"),
            }
        };
        for at in (0..whole.len()).step_by(23) {
            look(&whole[..at]);
            let mut bytes = whole.clone();
            bytes[at] ^= 0x81;
            look(&bytes);
            let end = (at + 8).min(bytes.len());
            bytes[at..end].copy_from_slice(&(i64::MAX - 5).to_le_bytes()[..end - at]);
            look(&bytes);
        }
    }
}

#[test]
fn a_chunk_that_expands_beyond_measure_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bomb.mcap");
    let zeros = vec![0; 80 << 20];
    let entry = |payload| Entry("/imu".to_owned(), "sensor_msgs/msg/Imu", "cdr", 1, payload);
    let options = WriteOptions::new().compression(Some(Compression::Zstd)).chunk_size(None);
    let mut writer = Writer::with_options(fs::File::create(&path).unwrap(), options).unwrap();
    let Entry(topic, schema, encoding, _, payload) = entry(zeros);
    let schema = writer.add_schema(schema, "ros2msg", b"").unwrap();
    let channel_id = writer.add_channel(schema, &topic, encoding, &BTreeMap::new()).unwrap();
    for part in payload.chunks(1 << 20) {
        let header = MessageHeader { channel_id, sequence: 0, log_time: 1, publish_time: 1 };
        writer.write_to_known_channel(&header, part).unwrap();
    }
    writer.finish().unwrap();
    assert!(fs::metadata(&path).unwrap().len() < 15_000);
    let error = foreign_cameras(&path).unwrap_err().to_string();
    assert!(error.contains("bomb.mcap is no recording") && error.contains("more than 1000 times"), "{error}");
}

#[test]
fn files_of_another_kind_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    for (bytes, text) in [
        (&b"\x28\xb5\x2f\xfd0123456789"[..], "unpack it with `zstd -d`"),
        (b"#ROSBAG V2.0\n0123", "convert it with `mcap convert`"),
        (b"SQLite format 3\0", "convert it with `mcap convert`"),
        (b"a text that is no recording", "x.mcap is no recording"),
        (b"", "x.mcap is no recording"),
    ] {
        fs::write(&path, bytes).unwrap();
        let error = foreign_cameras(&path).unwrap_err().to_string();
        assert!(error.contains(text), "{error}");
    }
}
