//! Perception: people are found, measured and tracked in raw images.
#![allow(clippy::unwrap_used)] // a test may fail by panicking, in its helpers too

use std::{
    io::{BufRead as _, BufReader},
    process::{Command, Stdio},
};

use flyrig_tests::run;

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

const SIM: &str = "width = 256\nheight = 256\ntexture_px = 128\nfps = 10.0\nframes = 22\ncameras.count = 3\n";
const RIG: &str = "[source]\nkind = \"sim\"\npath = \"sim.toml\"\nreal_time = false\ncameras = []\n\
    [body]\ngaussians = 2000\nnodes = 50\n[output]\nwidth = 96\nheight = 96\n\
    [transport]\nlisten = [\"tcp/127.0.0.1:0\"]\n";

#[test]
fn a_rig_measures_a_new_person_and_then_tracks_them() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("sim.toml"), SIM).unwrap();
    // One place for a person stays free.
    std::fs::write(folder.path().join("rig.toml"), format!("{RIG}[perception]\npeople = 2\n")).unwrap();
    let ran = run(PROGRAM, &["run", "rig.toml"], folder.path()).unwrap();
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.stderr.contains("person 0 is 1."), "{}", ran.stderr);
    assert!(!ran.stderr.contains("person 1 is"), "only one person is in view: {}", ran.stderr);
    assert!(ran.stderr.contains("run: 22 frame sets"), "{}", ran.stderr);

    std::fs::write(folder.path().join("rig.toml"), format!("{RIG}[perception]\npeople = 5\n")).unwrap();
    let refused = run(PROGRAM, &["run", "rig.toml"], folder.path()).unwrap();
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("perception.people is 5, it must lie between 1 and 4"), "{}", refused.stderr);
}

#[test]
fn a_signal_starts_a_new_measurement() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), RIG).unwrap();
    std::fs::write(folder.path().join("sim.toml"), SIM.replace("frames = 22", "frames = 70")).unwrap();
    let mut rig = Command::new(PROGRAM)
        .args(["run", "rig.toml"])
        .current_dir(folder.path())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let id = rig.id().to_string();
    let mut said = Vec::new();
    // Signal until the rig ends after its last frame.
    for line in BufReader::new(rig.stderr.take().unwrap()).lines() {
        let line = line.unwrap();
        if line.contains("person 0 is 1.") {
            assert!(Command::new("kill").args(["-USR1", &id]).status().unwrap().success());
        }
        said.push(line);
    }
    let said = said.join("\n");
    assert!(rig.wait().unwrap().success(), "{said}");
    assert_eq!(said.matches("SIGUSR1, all people are measured again").count(), 1, "{said}");
    assert_eq!(said.matches("person 0 was measured again: 1.").count(), 1, "{said}");
}

#[test]
fn one_camera_measures_people_by_the_floor_or_takes_a_known_or_average_height() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("sim.toml"), SIM).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let exported = command(&["sim", "export", "sim.toml", "--out", "take", "--frames", "3", "--no-truth"]);
    assert_eq!(exported.code, Some(0), "{exported:?}");
    let eval = |more: &[&str]| {
        let mut args = vec!["eval", "take", "--inputs", "00", "--holdout", "01", "--fps", "10", "--out", "eval"];
        args.extend(["--pose", "estimated", "--masks", "estimated", "--gaussians", "2000", "--nodes", "50"]);
        args.extend(more);
        command(&args)
    };
    let given = eval(&["--height", "1.82"]);
    assert_eq!(given.code, Some(0), "{}", given.stderr);
    assert!(given.stderr.contains("1.82 m tall (as configured)"), "{}", given.stderr);
    let standing = eval(&["--trace", "trace.json"]);
    assert_eq!(standing.code, Some(0), "{}", standing.stderr);
    assert!(standing.stderr.contains("by where the feet stand on a floor at height 0;"), "{}", standing.stderr);
    let trace: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("trace.json")).unwrap()).unwrap();
    let times = |stage: &str| {
        let events = trace["traceEvents"].as_array().unwrap().iter();
        events.filter(|event| event["name"] == stage && event["dur"].as_f64() > Some(0.0)).count()
    };
    // Three frame sets; the report renders additional views.
    for stage in ["pose from images", "network", "deformation"] {
        assert_eq!(times(stage), 3, "{stage}");
    }
    assert!(times("render a view") >= 3);
    // The floor is above the camera.
    let average = eval(&["--floor", "5"]);
    assert_eq!(average.code, Some(0), "{}", average.stderr);
    assert!(average.stderr.contains("an average height"), "{}", average.stderr);
    let tiny = eval(&["--height", "0.1"]);
    assert_eq!(tiny.code, Some(1));
    assert!(tiny.stderr.contains("perception.height_m is 0.1"), "{}", tiny.stderr);
    let deep = eval(&["--floor", "-20"]);
    assert_eq!(deep.code, Some(1));
    assert!(deep.stderr.contains("perception.floor_m is -20"), "{}", deep.stderr);
}

#[test]
fn hands_and_face_are_found_in_images_alone() {
    let folder = tempfile::tempdir().unwrap();
    let sim = SIM.replace("width = 256\nheight = 256", "width = 640\nheight = 640\nperson.fingers = true");
    std::fs::write(folder.path().join("sim.toml"), sim).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let exported = command(&["sim", "export", "sim.toml", "--out", "take", "--frames", "4", "--no-truth"]);
    assert_eq!(exported.code, Some(0), "{exported:?}");
    let eval = |pose: &str| {
        let mut args = vec!["eval", "take", "--inputs", "00,01", "--holdout", "02", "--fps", "10", "--out", "eval"];
        args.extend(["--pose", pose, "--masks", "estimated", "--hands", "estimated"]);
        args.extend(["--gaussians", "2000", "--nodes", "50"]);
        command(&args)
    };
    let ran = eval("estimated");
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let counted = |what: &str| -> u64 {
        let line = ran.stdout.lines().find_map(|line| line.trim().strip_prefix(what));
        line.and_then(|rest| rest.trim().parse().ok()).unwrap_or(0)
    };
    // Four frame sets of two hands and a head.
    assert!(counted("hands fitted") >= 4, "{}", ran.stdout);
    assert_eq!(counted("hands fitted") + counted("hands relaxed"), 8, "{}", ran.stdout);
    assert!(counted("heads turned by the face") >= 2, "{}", ran.stdout);
    let refused = eval("given");
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("a given pose brings its own fingers"), "{}", refused.stderr);
}

#[test]
#[ignore = "minutes: run by make test-long"]
fn shoes_and_a_skirt_are_found_and_drawn_and_trousers_are_no_skirt() {
    let folder = tempfile::tempdir().unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let take = |seed: u32| {
        let sim = format!("seed = {seed}\n{}", SIM.replace("cameras.count = 3", "cameras.count = 4"));
        std::fs::write(folder.path().join("sim.toml"), sim).unwrap();
        let exported = command(&["sim", "export", "sim.toml", "--out", &format!("take{seed}"), "--frames", "8"]);
        assert_eq!(exported.code, Some(0), "{exported:?}");
    };
    let eval = |seed: u32, given_or_estimated: &str| {
        let take = format!("take{seed}");
        let mut args = vec!["eval", take.as_str(), "--inputs", "00,01,03", "--holdout", "02", "--fps", "10"];
        args.extend(["--pose", given_or_estimated, "--masks", given_or_estimated]);
        args.extend(["--gaussians", "4000", "--nodes", "200", "--out", "eval"]);
        let ran = command(&args);
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        let metrics = std::fs::read(folder.path().join("eval/metrics.json")).unwrap();
        let metrics: serde_json::Value = serde_json::from_slice(&metrics).unwrap();
        (ran.stderr, metrics["mean"]["iou"].as_f64().unwrap())
    };
    // A wide skirt, then trousers.
    for (seed, worn) in [(306, true), (303, false)] {
        take(seed);
        let (estimated, _) = eval(seed, "estimated");
        assert_eq!(estimated.contains("tall, in a skirt or long coat"), worn, "{estimated}");
        let (given, iou) = eval(seed, "given");
        assert_eq!(given.contains("person 0 wears a skirt or long coat"), worn, "{given}");
        // Every person in this test wears shoes.
        assert!(estimated.contains("shoes") && given.contains("shoes"), "{estimated}\n{given}");
        assert!(iou > 0.85, "seed {seed}: {iou}");
    }
}
