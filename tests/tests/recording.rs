//! Recordings: recorded frames are replayed bit for bit and exported.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::time::Duration;

use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind, Note, Recorder};
use flyrig_tests::run;
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

const RIG: &str = "[source]\nkind = \"sim\"\npath = \"sim.toml\"\nreal_time = false\ncameras = [\"00\", \"01\"]\n\
    [perception]\npose = \"given\"\nmasks = \"given\"\n\
    [record]\njpeg_quality = 0\n";
const SIM: &str = "width = 64\nheight = 64\ntexture_px = 64\nframes = 6\ncameras.count = 2\n";

#[test]
fn a_recording_is_replayed_to_the_bit_and_exported() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), RIG).unwrap();
    std::fs::write(folder.path().join("sim.toml"), SIM).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let recorded = command(&["record", "rig.toml", "--out", "take.mcap"]);
    assert_eq!(recorded.code, Some(0), "{recorded:?}");
    assert!(recorded.stdout.starts_with("record: 12 frames"), "{}", recorded.stdout);
    let again = command(&["record", "rig.toml", "--out", "take.mcap"]);
    assert_eq!(again.code, Some(1), "a recording must not be overwritten");
    assert!(again.stderr.contains("take.mcap is there already; name a new file"), "{}", again.stderr);

    let replayed = command(&["replay", "take.mcap", "--export", "take"]);
    assert_eq!(replayed.code, Some(0), "{replayed:?}");
    assert!(replayed.stdout.contains("camera 01: 6 frames of Rgb8 64x64"), "{}", replayed.stdout);
    assert!(replayed.stdout.contains("sets: 6 complete, 0 partial"), "{}", replayed.stdout);
    for file in ["intri.yml", "extri.yml", "images/00/000000.png", "images/01/000005.png"] {
        assert!(folder.path().join("take").join(file).exists(), "{file}");
    }
    let digest = |text: &str| text.lines().find(|line| line.starts_with("digest")).unwrap().to_owned();
    assert_eq!(digest(&command(&["replay", "take.mcap"]).stdout), digest(&replayed.stdout));

    // A killed recorder leaves a truncated file.
    let bytes = std::fs::read(folder.path().join("take.mcap")).unwrap();
    std::fs::write(folder.path().join("cut.mcap"), &bytes[..bytes.len() * 9 / 10]).unwrap();
    let cut = command(&["replay", "cut.mcap"]);
    assert_eq!(cut.code, Some(0), "{cut:?}");
    assert!(cut.stderr.contains("cut.mcap breaks off"), "{}", cut.stderr);

    let nothing = command(&["replay", "rig.toml"]);
    assert_eq!(nothing.code, Some(1));
    assert!(nothing.stderr.contains("rig.toml is no recording"), "{}", nothing.stderr);
}

/// Writes a recording of one frame whose camera has this name.
fn record_one(path: &std::path::Path, name: &str) {
    // foxglove `Log`: field 3 is the message.
    let length = u8::try_from(name.len().min(127)).unwrap();
    let payload = [&[3 << 3 | 2, length], &name.as_bytes()[..usize::from(length)]].concat();
    let schema = ("foxglove.Log".to_owned(), "protobuf".to_owned(), Vec::new());
    let note = Note { topic: "cameras".to_owned(), schema, payload };
    let recorder = Recorder::create(path, &[note], None).unwrap();
    let mut tap = recorder.tap(OneFrame(name.into(), false)).unwrap();
    assert!(tap.next_frame(Duration::ZERO).is_ok());
    drop(tap);
    assert_eq!(recorder.finish().frames, 1);
}

struct OneFrame(CameraId, bool);

impl CameraSource for OneFrame {
    fn camera(&self) -> &CameraId {
        &self.0
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        if std::mem::replace(&mut self.1, true) {
            return Err(CaptureError::new(&self.0, CaptureErrorKind::EndOfStream, "over"));
        }
        let image = Image::new(4, 2, PixelFormat::Rgb8, vec![9; 24]).unwrap();
        let camera = self.0.clone();
        Ok(Frame { camera, sequence: 0, capture_nanos: 1_000_000_000, exposure_nanos: None, image, mask: None })
    }
}

#[test]
fn a_recording_whose_cameras_leave_their_folder_is_refused_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let inside = folder.path().join("deep/er");
    std::fs::create_dir_all(&inside).unwrap();
    let absolute = folder.path().join("absolute").display().to_string();
    let names = ["../../x", &absolute, "..", ".", "a\u{1b}[2J", "", &"x".repeat(100), "a\\b"];
    for name in names {
        record_one(&inside.join("evil.mcap"), name);
        let of = |args: &[&str]| run(PROGRAM, args, &inside).unwrap();
        let export = of(&["replay", "evil.mcap", "--export", "out"]);
        // What is opened, and the error.
        assert_eq!(export.stderr.lines().count(), 2, "{export:?}");
        let eval = "eval evil.mcap --inputs a --holdout b --pose estimated --masks estimated --out out";
        for finished in [export, of(&eval.split(' ').collect::<Vec<_>>())] {
            assert_eq!(finished.code, Some(1), "{name:?}: {finished:?}");
            assert!(finished.stderr.contains("evil.mcap: the camera name '"), "{finished:?}");
            assert!(!finished.stderr.contains('\u{1b}') && finished.stderr.len() < 500, "{finished:?}");
        }
        std::fs::remove_file(inside.join("evil.mcap")).unwrap();
        assert_eq!(std::fs::read_dir(&inside).unwrap().count(), 0, "{name:?}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "{name:?}");
    }
    record_one(&inside.join("good.mcap"), "front left");
    let good = run(PROGRAM, &["replay", "good.mcap", "--export", "out"], &inside).unwrap();
    assert_eq!(good.code, Some(0), "{good:?}");
    assert!(inside.join("out/images/front left/000000.png").exists());
}

#[test]
fn calibrations_data_sets_and_configurations_with_such_names_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let toml = |name: &str| {
        let name = toml::Value::String(name.to_owned());
        format!(
            "version = 1\nup = [0.0, 0.0, 1.0]\n[[cameras]]\nname = {name}\nsize = [64, 48]\nfocal_px = [60.0, 60.0]\n\
             center_px = [31.5, 23.5]\nlens = {{ model = \"fisheye\", coefficients = [0.0, 0.0, 0.0, 0.0] }}\n\
             rotation = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]\ntranslation_m = [0.0, 1.2, 3.0]\n"
        )
    };
    let of = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    for name in ["../../x", "/tmp/x", "..", "a\u{1b}[2J", "", &"x".repeat(300)] {
        std::fs::write(at("calibration.toml"), toml(name)).unwrap();
        let convert = of(&["calibrate", "convert", "calibration.toml", "--to", "easymocap", "--out", "out"]);
        let cameras = toml::Value::Array(vec![toml::Value::String(name.to_owned())]);
        std::fs::write(at("rig.toml"), format!("[source]\nkind = \"mcap\"\npath = \"x\"\ncameras = {cameras}\n"))
            .unwrap();
        let check = of(&["config", "check", "rig.toml"]);
        for (finished, file) in [(convert, "calibration.toml"), (check, "rig.toml")] {
            assert_eq!(finished.code, Some(1), "{name:?}: {finished:?}");
            assert!(finished.stderr.contains("the camera name '") && finished.stderr.contains(file), "{finished:?}");
            assert!(!finished.stderr.contains('\u{1b}') && finished.stderr.len() < 600, "{finished:?}");
        }
        assert!(!at("out").exists());
    }
    std::fs::create_dir_all(at("take/images/a\u{1b}[2J")).unwrap();
    let sync = of(&["sync-check", "take"]);
    assert_eq!(sync.code, Some(1), "{sync:?}");
    assert!(sync.stderr.contains("take/images: the camera name 'a\\u{1b}[2J'"), "{}", sync.stderr);
    let long = "y".repeat(3000);
    std::fs::write(at("rig.toml"), format!("[sync]\nwindow_ms = \"{long}\"\n")).unwrap();
    let check = of(&["config", "check", "rig.toml"]);
    assert!(check.stderr.contains("rig.toml") && !check.stderr.contains(&long[..101]), "{}", check.stderr);
}

#[test]
fn images_are_recorded_as_jpeg_by_default_with_poses() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("sim.toml"), SIM).unwrap();
    let rig = RIG.replace("jpeg_quality = 0", "jpeg_quality = 95");
    std::fs::write(
        folder.path().join("rig.toml"),
        format!("{rig}[body]\ngaussians = 2000\nnodes = 50\n[transport]\nlisten = [\"tcp/127.0.0.1:0\"]\n"),
    )
    .unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let recorded = command(&["run", "rig.toml", "--record", "take.mcap"]);
    assert_eq!(recorded.code, Some(0), "{recorded:?}");
    assert!(recorded.stderr.contains("run: recorded 12 frames"), "{}", recorded.stderr);
    assert!(recorded.stderr.contains("MB as the cameras sent them"), "{}", recorded.stderr);
    let replayed = command(&["replay", "take.mcap", "--export", "take"]);
    assert_eq!(replayed.code, Some(0), "{replayed:?}");
    assert!(replayed.stdout.contains("camera 01: 6 frames of Mjpeg 64x64"), "{}", replayed.stdout);
    assert!(replayed.stdout.contains("poses: 6 of 31 joints in 0.17 s"), "{}", replayed.stdout);
    assert!(folder.path().join("take/images/01/000005.jpg").exists());
}

#[test]
fn doctor_says_what_is_there_and_what_to_mend() {
    let folder = tempfile::tempdir().unwrap();
    let doctor = run(PROGRAM, &["doctor"], folder.path()).unwrap();
    assert_eq!(doctor.code, Some(0), "{doctor:?}");
    for heading in ["cameras\n", "graphics adapters\n", "problems\n"] {
        assert!(doctor.stdout.contains(heading), "{}", doctor.stdout);
    }
    let text = "[source]\nkind = \"v4l2\"\npath = \"x\"\n[[source.cameras]]\nname = \"left\"\nserial = \"none such\"\n\
                size = [640, 360]\n[perception]\npose = \"estimated\"\n";
    std::fs::write(folder.path().join("rig.toml"), text).unwrap();
    let doctor = run(PROGRAM, &["doctor", "rig.toml"], folder.path()).unwrap();
    assert!(doctor.stdout.contains("camera left of the configuration is not plugged in"), "{}", doctor.stdout);
}
