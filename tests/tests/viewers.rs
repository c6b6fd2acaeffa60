//! Viewers: they may start before the rig, run twice, be stopped or killed; the rig goes on.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use std::time::Duration;

use support::{Process, pictures, small_rig, wait_until};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
#[test]
fn the_rig_outlives_every_kind_of_viewer() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = small_rig("viewers", folder.path(), "");
    let watch = |out: &str| -> Process {
        let args = ["watch", "--rig", "viewers", "--connect", &endpoint, "--out", out];
        Process::start(PROGRAM, &args, folder.path(), out)
    };
    let seen = |out: &str| pictures(&folder.path().join(out));

    // One viewer starts before the publisher.
    let early = watch("early");
    std::thread::sleep(Duration::from_millis(500));
    let mut rig = Process::start(PROGRAM, &["run", "rig.toml"], folder.path(), "run");
    wait_until("the early viewer's images", || seen("early") > 3);

    // Two viewers at the same time, one with its own viewpoint.
    let second = Process::start(
        PROGRAM,
        &[
            "watch",
            "--rig",
            "viewers",
            "--connect",
            &endpoint,
            "--out",
            "second",
            "--eye",
            "2,1,1.5",
            "--size",
            "64x48",
        ],
        folder.path(),
        "second",
    );
    wait_until("the second viewer's images", || seen("second") > 3);
    // Beside the images lies the one that is being written.
    let mut images = std::fs::read_dir(folder.path().join("second")).unwrap().map(|entry| entry.unwrap().path());
    let own = images.find(|path| path.extension().is_some_and(|ending| ending == "png")).unwrap();
    let size = image::image_dimensions(own).unwrap();
    assert_eq!(size, (64, 48));

    // A stopped viewer delays neither the other one nor the rig.
    early.signal("STOP");
    let (before, while_stopped) = (seen("second"), seen("early"));
    wait_until("images while one viewer is stopped", || seen("second") > before + 20);
    assert!(seen("early") <= while_stopped + 1, "the viewer was not stopped");
    early.signal("CONT");
    wait_until("the stopped viewer to catch up", || seen("early") > while_stopped + 5);

    // A killed viewer does not end the rig.
    early.signal("KILL");
    let before = seen("second");
    wait_until("images after one viewer was killed", || seen("second") > before + 20);
    drop(second);
    assert!(rig.0.try_wait().unwrap().is_none(), "the rig must keep running");

    // The rig exits with 0 on request.
    rig.signal("INT");
    wait_until("the rig to end", || rig.0.try_wait().unwrap().is_some());
    assert!(rig.0.wait().unwrap().success());
}
