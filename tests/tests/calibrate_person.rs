//! Recalibration from a walking person: a pose error of one degree and colour differences between cameras are corrected.
#![allow(clippy::unwrap_used)] // helpers of tests

use flyrig_calib::{load_calibration, testing::rig_errors};
use flyrig_tests::run;

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

const SIM: &str = "seed = 511\nwidth = 256\nheight = 256\n[motion]\nkind = \"walk\"\n[cameras]\ncount = 4\n\
                   [calibration_error]\nrotation_deg = 1.0\ntranslation_mm = 20.0\n\
                   [[sensors]]\n[[sensors]]\nexposure = 0.8\nwhite_balance = [1.2, 1.0, 0.85]\n\
                   [[sensors]]\n[[sensors]]\n";

#[test]
#[ignore = "minutes: run by make test-long"]
fn a_walking_person_corrects_the_calibration() {
    let folder = tempfile::tempdir().unwrap();
    let command = |text: &str| run(PROGRAM, &text.split(' ').collect::<Vec<_>>(), folder.path()).unwrap();
    std::fs::write(folder.path().join("sim.toml"), SIM).unwrap();
    let export = command("sim export sim.toml --out take --frames 90");
    assert_eq!(export.code, Some(0), "{}", export.stderr);
    let person = command("calibrate person take --out better");
    assert_eq!(person.code, Some(0), "{}{}", person.stdout, person.stderr);

    let load = |name: &str| load_calibration(&folder.path().join(name), &|_| None).unwrap();
    let truth = load("take/truth");
    let worst = |name: &str| {
        let errors = rig_errors(&load(name).cameras, &truth.cameras).unwrap();
        println!("{name}: {errors:?}");
        errors.iter().map(|error| error.px).fold(0.0, f64::max)
    };
    let (before, after) = (worst("take"), worst("better"));
    assert!(before > 4.0 && after < 0.3 * before, "{before} px before, {after} px after\n{}", person.stdout);
    assert!(person.stdout.contains("was off: the person lies"), "{}", person.stdout);

    // The colours of the second camera are matched to those of the others.
    let color = command("calibrate color take --calibration better --secs 2 --out matched");
    assert_eq!(color.code, Some(0), "{}{}", color.stdout, color.stderr);
    let matched = load("matched");
    for (k, light) in [0.8 * 1.2, 0.8, 0.8 * 0.85].into_iter().enumerate() {
        let grey = |slot: usize| matched.cameras[slot].color.apply([0.5; 3], 0.0)[k];
        let others = (grey(0) * grey(2) * grey(3)).cbrt();
        let off = grey(1) / others * light - 1.0;
        assert!(off.abs() < 0.06, "channel {k}: {:.1} % off\n{}", 100.0 * off, color.stdout);
    }

    // Each error is one line, and nothing is written.
    let again = command("calibrate person take --out better");
    assert_eq!(again.code, Some(1));
    assert!(again.stderr.contains("calibration.toml is there already; --force replaces it"), "{}", again.stderr);
    std::fs::create_dir_all(folder.path().join("bare")).unwrap();
    std::fs::rename(folder.path().join("take/images"), folder.path().join("bare/images")).unwrap();
    let bare = command("calibrate person bare --out none");
    assert_eq!(bare.code, Some(1));
    assert!(bare.stderr.contains("no calibration: name its folder with --calibration"), "{}", bare.stderr);
    assert!(!folder.path().join("none").exists());
}
