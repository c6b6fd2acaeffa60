//! Cameras of another computer: `flyrig capture` on one side, the rig on the other side.
#![allow(clippy::unwrap_used)] // a test may fail by panicking, in its helpers too

use std::process::{Command, Stdio};

use flyrig_tests::{Running, free_port, run};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

#[test]
fn cameras_of_another_process_are_recorded_in_whole_sets() {
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let write = |name: &str, text: String| std::fs::write(folder.path().join(name), text).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    write("sim.toml", "width = 64\nheight = 64\ntexture_px = 64\nfps = 10.0\ncameras.count = 2\n".to_owned());
    write(
        "cameras.toml",
        format!(
            "[rig]\nname = \"stage\"\n[source]\nkind = \"sim\"\npath = \"sim.toml\"\ncameras = [\"00\", \"01\"]\n\
             [transport]\nlisten = [\"tcp/127.0.0.1:{port}\"]\n"
        ),
    );
    let exported = command(&["sim", "export", "sim.toml", "--out", "calibration", "--frames", "1", "--no-truth"]);
    assert_eq!(exported.code, Some(0), "{exported:?}");
    let rig = |name: &str| {
        format!(
            "[rig]\nname = \"{name}\"\n[source]\nkind = \"network\"\npath = \"calibration\"\n\
             cameras = [\"00\", \"01\"]\n[perception]\npose = \"estimated\"\nmasks = \"estimated\"\n\
             [transport]\nconnect = [\"tcp/127.0.0.1:{port}\"]\n"
        )
    };
    write("rig.toml", rig("stage"));
    write("wrong.toml", rig("stagee"));
    let mut cameras = Command::new(PROGRAM);
    cameras.args(["capture", "cameras.toml"]).current_dir(folder.path()).stderr(Stdio::null());
    let _cameras = Running(cameras.spawn().unwrap());
    let record =
        |config: &str, out: &str, seconds: &str| command(&["record", config, "--out", out, "--seconds", seconds]);

    // The other side needs time to start; retry until a recording has whole sets. One without any frame is not kept.
    let mut replayed = String::new();
    let has_sets = (0..20).any(|take| {
        let file = format!("take{take}.mcap");
        let recorded = record("rig.toml", &file, "4");
        let is_empty = recorded.stderr.contains("no frame was recorded");
        assert_eq!(recorded.code, Some(i32::from(is_empty)), "{recorded:?}");
        replayed = command(&["replay", &file]).stdout;
        let sets = replayed.lines().find_map(|line| line.strip_prefix("sets: ")?.split(' ').next()?.parse().ok());
        replayed.contains("frames of Mjpeg 64x64") && sets.is_some_and(|complete: usize| complete > 3)
    });
    assert!(has_sets, "{replayed}");

    // The name of the other rig may come later than that.
    let mut lost = String::new();
    let is_named = (0..20).any(|_| {
        lost = record("wrong.toml", "none.mcap", "2").stderr;
        lost.contains("no computer of rig 'stagee' is present, but of 'stage'")
    });
    assert!(is_named, "{lost}");
    let twice = command(&["capture", "rig.toml"]);
    assert_eq!(twice.code, Some(1));
    assert!(twice.stderr.contains("these cameras are on the network already"), "{}", twice.stderr);
}
