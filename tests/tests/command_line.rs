//! Command line: help, printed configurations, and errors for unsupported input.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_tests::run;

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

#[test]
fn the_printed_configuration_is_accepted_and_a_wrong_key_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let printed = run(PROGRAM, &["config", "print"], folder.path()).unwrap();
    assert_eq!(printed.code, Some(0));
    std::fs::write(folder.path().join("rig.toml"), &printed.stdout).unwrap();
    // Another rig may run at the default address.
    let checked = run(PROGRAM, &["config", "check", "--offline", "rig.toml"], folder.path()).unwrap();
    assert_eq!((checked.code, checked.stdout.as_str()), (Some(0), "rig.toml is right\n"));

    std::fs::write(folder.path().join("rig.toml"), printed.stdout.replace("max_wait_ms", "max_wait_msec")).unwrap();
    let refused = run(PROGRAM, &["config", "check", "rig.toml"], folder.path()).unwrap();
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("unknown field `max_wait_msec`"), "{}", refused.stderr);
    assert!(refused.stderr.contains("did you mean `max_wait_ms`?"), "{}", refused.stderr);
    let missing = run(PROGRAM, &["run", "nowhere.toml"], folder.path()).unwrap();
    assert_eq!(missing.code, Some(1));
    assert!(missing.stderr.contains("cannot read the configuration nowhere.toml"), "{}", missing.stderr);
}

#[test]
fn the_simulators_file_is_printed_and_checked() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    let check = || run(PROGRAM, &["config", "check", "--offline", "rig.toml"], folder.path()).unwrap();
    let printed = run(PROGRAM, &["sim", "print"], folder.path()).unwrap();
    assert_eq!(printed.code, Some(0));
    write("sim.toml", &printed.stdout);
    write("rig.toml", "[source]\npath = \"sim.toml\"\n");
    assert_eq!(check().code, Some(0));
    write("sim.toml", &printed.stdout.replace("texture_px", "texture_pixels"));
    let refused = check();
    assert_eq!(refused.code, Some(1));
    assert!(
        refused.stderr.contains("sim.toml") && refused.stderr.contains("did you mean `texture_px`?"),
        "{}",
        refused.stderr
    );
    write("sim.toml", "seed = 2\n");
    write("rig.toml", "[source]\nkind = \"sim\"\npath = \"sim.toml\"\n[sim]\nseed = 3\n");
    let refused = check();
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("[sim] and source.path both describe the simulated rig"), "{}", refused.stderr);
}

#[test]
fn help_teaches() {
    let folder = tempfile::tempdir().unwrap();
    let help = run(PROGRAM, &["--help"], folder.path()).unwrap();
    assert_eq!(help.code, Some(0));
    for word in ["demo", "run", "watch", "eval", "config", "flyrig config print > rig.toml"] {
        assert!(help.stdout.contains(word), "{word}");
    }
    let unknown = run(PROGRAM, &["--adapter", "no such card", "demo"], folder.path()).unwrap();
    assert_eq!(unknown.code, Some(1));
    assert!(unknown.stderr.contains("no graphics adapter has 'no such card'"), "{}", unknown.stderr);
}

#[test]
fn an_unknown_motion_is_answered_with_the_known_ones() {
    let folder = tempfile::tempdir().unwrap();
    let refused = run(PROGRAM, &["demo", "--out", "no", "--motion", "fly"], folder.path()).unwrap();
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("`fly`") && refused.stderr.contains("`cross-arms`"), "{}", refused.stderr);
}

#[test]
fn a_simulated_capture_is_exported_once() {
    let folder = tempfile::tempdir().unwrap();
    let small = "width = 64\nheight = 64\ntexture_px = 64\ncameras.count = 3\n";
    std::fs::write(folder.path().join("sim.toml"), small).unwrap();
    let args = ["sim", "export", "sim.toml", "--out", "take", "--frames", "2"];
    let exported = run(PROGRAM, &args, folder.path()).unwrap();
    assert_eq!(exported.code, Some(0), "{exported:?}");
    assert!(exported.stdout.contains("take: 2 frames of 3 cameras, 6 images"), "{}", exported.stdout);
    assert!(exported.stdout.contains("score it with: flyrig eval take\n"), "{}", exported.stdout);
    for file in ["intri.yml", "images/02/000001.png", "truth/02/000001.exr", "truth/frames.csv", "subject.glb"] {
        assert!(folder.path().join("take").join(file).exists(), "{file}");
    }
    let again = run(PROGRAM, &args, folder.path()).unwrap();
    assert_eq!(again.code, Some(1));
    assert!(again.stderr.contains("take is there already"), "{}", again.stderr);
}

#[test]
fn a_demo_goes_through_every_fault_of_a_rig() {
    let folder = tempfile::tempdir().unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../sim/assets/faults.toml");
    let args = ["demo", "--out", "out", "--frames", "56", "--gaussians", "3000", "--faults", script];
    let finished = run(PROGRAM, &args, folder.path()).unwrap();
    assert_eq!(finished.code, Some(0), "{finished:?}");
    let metrics: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("out/metrics.json")).unwrap()).unwrap();
    let drops = metrics["drops"].as_array().unwrap();
    let count = |place: &str| -> u64 {
        drops
            .iter()
            .filter(|drop| drop[0].as_str().unwrap().contains(place))
            .map(|drop| drop[1].as_u64().unwrap())
            .sum()
    };
    // Camera 05 stalls for 3 frames, which is no error yet, and is disconnected for 8; some frames of 00 cannot be decoded.
    assert!(count("errors of 05") == 8 && count("errors of 00") >= 1, "{drops:?}");
    assert!(count("sets without a camera") >= 11, "{drops:?}");
    let wrong = std::fs::write(folder.path().join("bad.toml"), "[[fault]]\nkind = \"drop\"\nmm = 3\n");
    wrong.unwrap();
    let refused = run(PROGRAM, &["demo", "--out", "no", "--faults", "bad.toml"], folder.path()).unwrap();
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("bad.toml") && refused.stderr.contains("fault.mm is 3"), "{}", refused.stderr);
}

/// Returns a command of the program that finds no desktop.
fn without_desktop(command: &str, folder: &std::path::Path) -> std::process::Command {
    let mut program = std::process::Command::new(PROGRAM);
    program.arg(command).current_dir(folder);
    for variable in ["DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET", "XDG_RUNTIME_DIR"] {
        program.env_remove(variable);
    }
    program
}

#[test]
fn a_window_without_a_desktop_is_refused_in_six_words() {
    let folder = tempfile::tempdir().unwrap();
    let output = without_desktop("view", folder.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert_eq!(String::from_utf8_lossy(&output.stderr), "error: no desktop here: use flyrig watch\n");
    let refused = run(PROGRAM, &["view", "--wait", "5"], folder.path()).unwrap();
    assert!(refused.stderr.contains("--screenshot"), "{}", refused.stderr);
}

#[test]
fn a_desktop_that_does_not_answer_is_named_without_words_of_libraries() {
    let folder = tempfile::tempdir().unwrap();
    let output = without_desktop("view", folder.path()).env("DISPLAY", ":987").output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 2, "{text}");
    assert!(lines[0].starts_with("view: rig 'flyrig' at"), "{text}");
    let expected = "error: cannot open a window: the desktop that DISPLAY or WAYLAND_DISPLAY names does not answer";
    assert!(lines[1].starts_with(expected), "{text}");
}

#[test]
fn libraries_write_nothing_to_the_terminal() {
    let folder = tempfile::tempdir().unwrap();
    // Opens the graphics adapter.
    let output = without_desktop("doctor", folder.path()).output().unwrap();
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
}
