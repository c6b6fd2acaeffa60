//! Time offsets: `flyrig sync-check` finds the offset of a camera, and every command subtracts a given one.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_tests::run;

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

const RIG: &str = "[source]\nkind = \"sim\"\npath = \"sim.toml\"\nreal_time = false\ncameras = []\n\
    [perception]\npose = \"given\"\nmasks = \"given\"\n";
const SIM: &str =
    "width = 112\nheight = 112\ntexture_px = 64\nframes = 75\ncameras.count = 3\nmotion.kind = \"jump\"\n";
const FAULT: &str = "[[faults.fault]]\nkind = \"offset\"\ncamera = \"02\"\nms = 45.0\n";

/// Returns the time offsets of a report in milliseconds, by camera.
fn lags(report: &str) -> Vec<(String, f64)> {
    let line = |line: &str| {
        let mut words = line.split_whitespace();
        let (camera, _frames, lag) = (words.next()?, words.next()?.parse::<u32>().ok()?, words.next()?);
        Some((camera.to_owned(), lag.parse().unwrap_or(f64::NAN)))
    };
    report.lines().filter_map(line).collect()
}

#[test]
fn a_time_offset_is_found_and_subtracted() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("sim.toml"), format!("{SIM}{FAULT}")).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let check = |tail: &str, truth: [f64; 3]| {
        std::fs::write(folder.path().join("rig.toml"), format!("{RIG}{tail}")).unwrap();
        let checked = command(&["sync-check", "rig.toml", "--most-ms", "150"]);
        assert_eq!(checked.code, Some(0), "{checked:?}");
        assert!(checked.stdout.contains("by silhouettes"), "{}", checked.stdout);
        let found = lags(&checked.stdout);
        assert_eq!(found.len(), 3, "{}", checked.stdout);
        for ((camera, lag), truth) in found.iter().zip(truth) {
            assert!((lag - truth).abs() <= 2.0, "{camera}: {lag} ms instead of {truth}\n{}", checked.stdout);
        }
    };
    check("", [0.0, 0.0, 45.0]);
    check("[sync]\nlags_ms = { \"02\" = 45.0 }\n", [0.0; 3]);

    std::fs::write(folder.path().join("rig.toml"), format!("{RIG}[sync]\nlags_ms = {{ side = 45.0 }}\n")).unwrap();
    let unknown = command(&["sync-check", "rig.toml"]);
    assert_eq!(unknown.code, Some(1), "{unknown:?}");
    assert!(unknown.stderr.contains("camera side is not in the rig, but in sync.lags_ms"), "{}", unknown.stderr);
}

#[test]
fn the_calibrations_time_offset_is_applied_and_can_be_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    std::fs::write(folder.path().join("rig.toml"), RIG).unwrap();
    std::fs::write(folder.path().join("sim.toml"), format!("{SIM}{FAULT}")).unwrap();
    let exported = command(&["record", "rig.toml", "--out", "take.mcap", "--seconds", "600"]);
    assert_eq!(exported.code, Some(0), "{exported:?}");
    std::fs::write(folder.path().join("sim.toml"), SIM).unwrap();
    let frames = command(&["sim", "export", "sim.toml", "--out", "room", "--frames", "1"]);
    assert_eq!(frames.code, Some(0), "{frames:?}");
    let converted = command(&["calibrate", "convert", "room", "--out", "late"]);
    assert_eq!(converted.code, Some(0), "{converted:?}");
    let file = folder.path().join("late/calibration.toml");
    let text = std::fs::read_to_string(&file).unwrap();
    assert!(text.trim_end().contains("name = \"02\""), "{text}");
    std::fs::write(&file, format!("{text}time_offset_ms = 45.0\n")).unwrap();
    for (calibration, truth) in [("room", 45.0), ("late", 0.0)] {
        let checked = command(&["sync-check", "take.mcap", "--calibration", calibration, "--most-ms", "150"]);
        assert_eq!(checked.code, Some(0), "{checked:?}");
        let found = lags(&checked.stdout);
        assert!((found[2].1 - truth).abs() <= 4.0, "{calibration}: {found:?}\n{}", checked.stdout);
    }
}

#[test]
fn what_cannot_be_checked_is_refused_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let refused = |args: &[&str], text: &str| {
        let refused = command(args);
        assert_ne!(refused.code, Some(0), "{refused:?}");
        assert!(refused.stderr.contains(text), "{args:?}: {}", refused.stderr);
    };
    refused(&["sync-check", "nowhere"], "nowhere does not exist; name a configuration");
    refused(&["sync-check", "nowhere.mcap"], "nowhere.mcap");
    std::fs::create_dir_all(folder.path().join("one/images/00")).unwrap();
    refused(&["sync-check", "one"], "00");
    refused(&["replay", "take.mcap", "--lag", "02"], "is not CAM=MS");
    refused(&["eval", "one", "--inputs", "0", "--holdout", "1", "--out", "o", "--lag", "02=nan"], "is not CAM=MS");
}
