//! `flyrig import`: a take from files of any layout, whose calibration the person in it corrects.
#![allow(clippy::unwrap_used)] // helpers of tests

use std::{
    fs,
    path::{Path, PathBuf},
};

use flyrig_calib::{Format, load_calibration, testing::rig_errors};
use flyrig_tests::{Dataset, Finished, run, write_dataset};
use flyrig_types::{CameraId, Rig};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

/// A walking person; one camera is turned and displaced, another one is two frames ahead, a third one darker.
const WRONG: &str = "seed = 611\nwidth = 256\nheight = 256\n[motion]\nkind = \"walk\"\n[cameras]\ncount = 4\n\
                     [calibration_error]\nrotation_deg = 1.0\ntranslation_mm = 20.0\n\
                     [[sensors]]\n[[sensors]]\nexposure = 0.67\n[[sensors]]\n[[sensors]]\n";

fn command(folder: &Path, text: &str) -> Finished {
    run(PROGRAM, &text.split(' ').collect::<Vec<_>>(), folder).unwrap()
}

fn rig(folder: &Path) -> Rig {
    load_calibration(folder, &|_| None).unwrap()
}

/// Copies the images of a data set into a folder, each camera's under a name of its own.
fn copy_images(data: &Dataset, to: &Path, rename: impl Fn(&str) -> String) {
    for camera in fs::read_dir(data.root.join("images")).unwrap().flatten() {
        let folder = to.join(rename(&camera.file_name().to_string_lossy()));
        fs::create_dir_all(&folder).unwrap();
        for image in fs::read_dir(camera.path()).unwrap().flatten() {
            fs::copy(image.path(), folder.join(image.file_name())).unwrap();
        }
    }
}

#[test]
fn what_is_wrong_in_a_take_is_measured_and_corrected() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("sim.toml"), WRONG).unwrap();
    let export = command(folder.path(), "sim export sim.toml --out raw --frames 90");
    assert_eq!(export.code, Some(0), "{}", export.stderr);
    // Masks and the calibration's own size make it easier than a stranger's files.
    fs::remove_dir_all(folder.path().join("raw/mask")).unwrap();
    let late = |frame: u32| folder.path().join(format!("raw/images/02/{frame:06}.png"));
    for frame in 0..88 {
        fs::rename(late(frame + 2), late(frame)).unwrap();
    }
    let imported = command(folder.path(), "import raw --out take");
    assert_eq!(imported.code, Some(0), "{}{}", imported.stdout, imported.stderr);
    println!("{}", imported.stdout);

    let truth = rig(&folder.path().join("raw/truth"));
    let worst =
        |rig: &Rig| rig_errors(&rig.cameras, &truth.cameras).unwrap().iter().map(|error| error.px).fold(0.0, f64::max);
    let take = folder.path().join("take");
    let (before, after) = (worst(&rig(&folder.path().join("raw"))), worst(&rig(&take)));
    assert!(before > 4.0 && after < 0.4 * before, "{before} px before, {after} px after\n{}", imported.stdout);
    let mended = rig(&take);
    let camera = |id: &str| mended.cameras[mended.slot(&CameraId::from(id)).unwrap()].clone();
    let late_ms = 1e-6 * (camera("02").time_offset_nanos - camera("00").time_offset_nanos) as f64;
    assert!((late_ms + 66.7).abs() < 8.0, "{late_ms} ms\n{}", imported.stdout);
    let grey = |id: &str| camera(id).color.apply([0.5; 3], 0.0)[1];
    let light = grey("01") / (grey("00") * grey("02") * grey("03")).cbrt() * 0.67;
    assert!((light - 1.0).abs() < 0.08, "{light}\n{}", imported.stdout);
    for words in [" ms early", "too dark", "corrected in calibration.toml: outlines that disagreed by"] {
        assert!(imported.stdout.contains(words), "{words}:\n{}", imported.stdout);
    }
    assert!(take.join("calibration.before.toml").is_file() && take.join("calibration.check.json").is_file());

    // What was measured is right now: nothing is changed again.
    let again = command(folder.path(), "import take --out again");
    assert_eq!(again.code, Some(0), "{}", again.stderr);
    assert!(worst(&rig(&folder.path().join("again"))) < 1.3 * after, "{}", again.stdout);
}

#[test]
fn calibrations_of_other_names_and_sizes_are_fitted_and_doubts_are_named() {
    let data = write_dataset().unwrap();
    let out = data.out();
    fs::create_dir_all(&out).unwrap();
    let given = rig(&data.root);
    // Twice the size, and other names.
    let mut large = given.clone();
    for camera in &mut large.cameras {
        let lens = &mut camera.intrinsics;
        (lens.width, lens.height) = (2 * lens.width, 2 * lens.height);
        lens.focal_px *= 2.0;
        lens.center_px = (lens.center_px + 0.5) * 2.0 - 0.5;
        camera.id = CameraId::from(format!("cam{}", camera.id));
    }
    let foreign: PathBuf = out.join("stranger/calib");
    fs::create_dir_all(&foreign).unwrap();
    Format::Anipose.write(&foreign, &large).unwrap();
    copy_images(&data, &out.join("stranger/images"), |name| format!("view_{name}"));
    let imported = command(&out, "import stranger --out take --trust-calibration");
    assert_eq!(imported.code, Some(0), "{}{}", imported.stdout, imported.stderr);
    assert!(imported.stdout.contains("scaled by 0.5000"), "{}", imported.stdout);
    assert!(imported.stdout.contains("view_00 is cam00"), "{}", imported.stdout);
    let taken = rig(&out.join("take"));
    assert_eq!(taken.cameras.len(), given.cameras.len());
    for (camera, known) in taken.cameras.iter().zip(&given.cameras) {
        assert!(camera.intrinsics.center_px.distance(known.intrinsics.center_px) < 1e-3, "{camera:?}");
        assert!((camera.intrinsics.focal_px - known.intrinsics.focal_px).length() < 1e-3, "{camera:?}");
    }

    for (arguments, words) in [
        ("import stranger --out take", "take is there already; name a new folder"),
        ("import nowhere --out new", "nowhere does not exist"),
        ("import stranger/calib --out new", "holds neither videos"),
        ("import stranger --out new --name view_00=left", "the calibration has no camera left; it has: cam00"),
        ("import stranger --out new --calibration nowhere.toml", "nowhere.toml does not exist"),
    ] {
        let refused = command(&out, arguments);
        assert_eq!(refused.code, Some(1), "{arguments}: {}", refused.stdout);
        assert!(refused.stderr.contains(words), "{arguments}: {}", refused.stderr);
        assert!(!out.join("new").exists(), "{arguments}: half a take is left");
    }
    fs::remove_dir_all(&foreign).unwrap();
    let bare = command(&out, "import stranger --out new");
    assert!(bare.stderr.contains("name its file or folder with --calibration"), "{}", bare.stderr);
    // Names that nothing joins are suggested in order.
    fs::remove_dir_all(out.join("stranger")).unwrap();
    let mut other = given.clone();
    for (camera, name) in other.cameras.iter_mut().zip(["a", "b", "c", "d", "e", "f", "g"]) {
        camera.id = CameraId::from(name);
    }
    copy_images(&data, &out.join("stranger/images"), |name| format!("#{name}"));
    Format::Flyrig.write(&out.join("stranger"), &other).unwrap();
    let unsure = command(&out, "import stranger --out new");
    assert!(unsure.stderr.contains("--name #00=a --name #01=b"), "{}", unsure.stderr);
}

#[test]
fn cameras_without_footage_need_no_size_in_the_calibration() {
    let data = write_dataset().unwrap();
    for camera in ["03", "04", "05", "06"] {
        fs::remove_dir_all(data.root.join("images").join(camera)).unwrap();
    }
    let file = data.root.join("intri.yml");
    let sizes = ["H_", "W_"];
    let lines = fs::read_to_string(&file).unwrap();
    let without: Vec<&str> = lines.lines().filter(|line| !sizes.iter().any(|size| line.starts_with(size))).collect();
    assert!(without.len() < lines.lines().count(), "{lines}");
    fs::write(&file, without.join("\n")).unwrap();
    let arguments = "eval data --frames 0..2 --gaussians 4000 --nodes 200 --trust-calibration";
    let seen = command(data.root.parent().unwrap(), arguments);
    assert_eq!(seen.code, Some(0), "{}", seen.stderr);
    assert!(seen.stdout.contains("Three cameras: no number for new views can be given"), "{}", seen.stdout);
}
