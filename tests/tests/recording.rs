//! Recordings: recorded frames are replayed bit for bit and exported.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_tests::run;

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
    assert!(again.stderr.contains("take.mcap cannot be recorded to"), "{}", again.stderr);

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
