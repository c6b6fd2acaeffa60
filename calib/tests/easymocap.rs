//! Calibration files: reading, writing, and the errors of broken ones.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::{fs, path::Path};

use flyrig_calib::{load_easymocap, save_easymocap};
use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Lens, Rig};
use glam::{DVec2, DVec3};

const SIZE: fn(&CameraId) -> Option<(u32, u32)> = |_| Some((640, 480));

const INTRI: &str = r#"%YAML:1.0
---
names:
   - "00"
   - "b"
K_00: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 510., 240., 0., 0., 1. ]
dist_00: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.1, 0.02, 0.001, -0.002, 0.003 ]
K_b: !!opencv-matrix
   rows: 3
   cols: 3
   dt: f
   data: [ 400., 0., 300., 0., 400., 200., 0., 0., 1. ]
dist_b: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0.25, 0., 0., 0. ]
"#;

const EXTRI: &str = r#"%YAML:1.0
---
names:
   - "00"
   - "b"
Rot_00: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1., 0., 0., 0., 0., -1., 0., 1., 0. ]
T_00: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 0., 1., 3. ]
R_b: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 1.5707963267948966, 0., 0. ]
T_b: !!opencv-matrix
   rows: 1
   cols: 3
   dt: d
   data: [ 0.1, 1., 4. ]
"#;

fn folder(intri: &str, extri: &str) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("intri.yml"), intri).unwrap();
    fs::write(dir.path().join("extri.yml"), extri).unwrap();
    dir
}

/// Returns the error text as a user sees it, without the random name of the folder.
fn refusal(intri: &str, extri: &str) -> String {
    let dir = folder(intri, extri);
    let text = load_easymocap(dir.path(), &SIZE).unwrap_err().to_string();
    text.replace(&format!("{}/", dir.path().display()), "")
}

#[test]
fn a_hand_made_rig_projects_where_it_should() {
    let dir = folder(INTRI, EXTRI);
    let rig = load_easymocap(dir.path(), &SIZE).unwrap();
    assert_eq!(rig.cameras.iter().map(|c| c.id.as_str()).collect::<Vec<_>>(), ["00", "b"]);
    assert_eq!((rig.cameras[0].intrinsics.width, rig.cameras[0].intrinsics.height), (640, 480));
    // Row-major: the world's z is the camera's -y, the world's y its z.
    assert_eq!(rig.world_up, DVec3::Z);
    let lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.003], tangential: [0.001, -0.002] };
    assert_eq!(rig.cameras[0].intrinsics.lens, lens);
    // World (0.3, 1, 1.6) is camera (0.3, -0.6, 4): ideal (0.075, -0.15), r² = 0.028125.
    let pixel = rig.cameras[0].project(DVec3::new(0.3, 1.0, 1.6)).unwrap();
    let (x, y, r2) = (0.075, -0.15, 0.028_125);
    let radial = 1.0 - 0.1 * r2 + 0.02 * r2 * r2 + 0.003 * r2 * r2 * r2;
    let u = 500.0 * (x * radial + 2.0 * 0.001 * x * y - 0.002 * (r2 + 2.0 * x * x)) + 320.0;
    let v = 510.0 * (y * radial + 0.001 * (r2 + 2.0 * y * y) - 2.0 * 0.002 * x * y) + 240.0;
    assert!((pixel - DVec2::new(u, v)).length() < 1e-9, "{pixel}");
    // The Rodrigues vector of b turns as the matrix of 00 does.
    let (a, b) = (rig.cameras[0].camera_from_world.rotation, rig.cameras[1].camera_from_world.rotation);
    assert!(a.angle_between(b) < 1e-7);
    assert_eq!(rig.cameras[1].camera_from_world.translation, DVec3::new(0.1, 1.0, 4.0));
}

#[test]
fn cameras_are_found_without_names_and_with_unquoted_ones() {
    for names in ["", "names: [ 00, b ]\n"] {
        let list = "names:\n   - \"00\"\n   - \"b\"\n";
        let dir = folder(&INTRI.replace(list, names), &EXTRI.replace(list, names));
        let rig = load_easymocap(dir.path(), &SIZE).unwrap();
        assert_eq!(rig.cameras.iter().map(|c| c.id.as_str()).collect::<Vec<_>>(), ["00", "b"]);
    }
}

#[test]
fn a_rig_comes_back_as_it_was_written() {
    let camera = |id: &str, eye: DVec3| Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: id.into(),
        intrinsics: Intrinsics {
            width: 1088,
            height: 1920,
            focal_px: DVec2::new(1000.0 / 3.0, 1_234.567_890_123),
            center_px: DVec2::new(0.1 + 0.2, 958.5),
            lens: Lens::RadialTangential { radial: [-0.1 / 3.0, 1e-9, 0.7], tangential: [-1e-5, 2e-7] },
        },
        camera_from_world: Isometry::look_at(eye, DVec3::new(0.0, 0.1, 1.0), DVec3::Z),
    };
    let cameras = vec![camera("07", DVec3::new(3.0, 0.1, 1.7)), camera("left-2", DVec3::new(-2.0, 2.2, 1.1))];
    let rig = Rig { cameras, world_up: DVec3::Z };
    let dir = tempfile::tempdir().unwrap();
    save_easymocap(dir.path(), &rig).unwrap();
    let back = load_easymocap(dir.path(), &|_| None).unwrap();
    assert_eq!(back.world_up, DVec3::Z);
    for (before, after) in rig.cameras.iter().zip(&back.cameras) {
        assert_eq!(before.id, after.id);
        assert_eq!(
            (before.intrinsics.width, before.intrinsics.height),
            (after.intrinsics.width, after.intrinsics.height)
        );
        // The text holds 16 or 17 digits.
        assert!((before.intrinsics.focal_px - after.intrinsics.focal_px).length() < 1e-12);
        assert!((before.intrinsics.center_px - after.intrinsics.center_px).length() < 1e-12);
        for world in [DVec3::new(0.2, -0.1, 0.3), DVec3::new(-0.3, 0.4, 1.9)] {
            let (a, b) = (before.project(world).unwrap(), after.project(world).unwrap());
            assert!((a - b).length() < 1e-9, "{a} {b}");
        }
    }
}

#[test]
fn what_the_format_cannot_hold_is_not_written() {
    let dir = folder(INTRI, EXTRI);
    let mut rig = load_easymocap(dir.path(), &SIZE).unwrap();
    rig.cameras[1].intrinsics.lens = Lens::Fisheye { coefficients: [0.0; 4] };
    let text = save_easymocap(dir.path(), &rig).unwrap_err().to_string();
    assert_eq!(text, "camera b: EasyMocap's format has no fisheye lens; write calibration.toml, or another format");
    rig.cameras[1].intrinsics.lens = Lens::PINHOLE;
    let text = save_easymocap(Path::new("/no/such/folder"), &rig).unwrap_err().to_string();
    assert!(text.contains("/no/such/folder/intri.yml: cannot be written"), "{text}");
    rig.cameras[1].camera_from_world.translation.x = f64::NAN;
    let text = save_easymocap(dir.path(), &rig).unwrap_err().to_string();
    assert!(text.contains("camera b: the translation T is not a finite number"), "{text}");
}

#[test]
fn the_image_size_comes_from_the_file_or_the_images_and_they_agree() {
    let dir = folder(INTRI, EXTRI);
    let text = load_easymocap(dir.path(), &|_| None).unwrap_err().to_string();
    assert!(text.ends_with("camera 00: the image size is unknown; add H_00 and W_00, or give images"), "{text}");
    let sized = format!("{INTRI}H_00: 480\nW_00: 640\nH_b: 480.\nW_b: 640.\n");
    let dir = folder(&sized, EXTRI);
    assert_eq!(load_easymocap(dir.path(), &|_| None).unwrap().cameras[1].intrinsics.width, 640);
    let text = load_easymocap(dir.path(), &|_| Some((320, 240))).unwrap_err().to_string();
    assert!(text.contains("camera 00: calibrated for images of 640x480, but they are 320x240"), "{text}");
    let absurd = refusal(&format!("{INTRI}H_00: -480\nW_00: 640\n"), EXTRI);
    assert!(absurd.contains("camera 00: H_00 is -480, expected 1 to 16384 pixels"), "{absurd}");
}

#[test]
fn broken_files_are_refused_with_file_camera_and_mend() {
    let k = "500., 0., 320., 0., 510., 240., 0., 0., 1.";
    let rot = "1., 0., 0., 0., 0., -1., 0., 1., 0.";
    let intri = |from: &str, to: &str| refusal(&INTRI.replacen(from, to, 1), EXTRI);
    let extri = |from: &str, to: &str| refusal(INTRI, &EXTRI.replacen(from, to, 1));
    let cases = [
        (
            intri("   - \"b\"\n", ""),
            "intri.yml: camera b is missing, but extri.yml has it; calibrate it or take it out",
        ),
        (extri("   - \"00\"\n", ""), "extri.yml: camera 00 is missing, but intri.yml has it"),
        (intri("K_00", "K_99"), "intri.yml: camera 00: K_00 is missing; calibrate this camera"),
        (intri("dist_00", "dost_00"), "intri.yml: camera 00: dist_00 is missing; write five zeros"),
        (extri("T_b", "S_b"), "extri.yml: camera b: T_b is missing"),
        (extri("R_b", "S_b"), "extri.yml: camera b: Rot_b is missing; or give a Rodrigues vector R"),
        (
            intri("rows: 3\n   cols: 3", "rows: 1\n   cols: 9"),
            "camera 00: K_00 is 1x9, expected 3x3; export the calibration",
        ),
        (intri("rows: 1\n   cols: 5", "rows: 5\n   cols: 5"), "camera 00: dist_00 cannot be read as a matrix"),
        (extri("rows: 3\n   cols: 1", "rows: 1\n   cols: 1"), "camera 00: T_00 cannot be read as a matrix"),
        (intri(k, "500., 0., .Nan, 0., 510., 240., 0., 0., 1."), "camera 00: K_00 holds NaN, not a finite number"),
        (extri("[ 0., 1., 3. ]", "[ 0., .Inf, 3. ]"), "extri.yml: camera 00: T_00 holds inf, not a finite number"),
        (intri(k, "500., 3., 320., 0., 510., 240., 0., 0., 1."), "camera 00: K_00 has skew 3"),
        (intri(k, "500., 0., 320., 0., 510., 240., 0., 0., 2."), "camera 00: K_00 has skew 0 or an unusual shape"),
        (
            intri(k, "-500., 0., 320., 0., 510., 240., 0., 0., 1."),
            "camera 00: focal length fx is -500, expected a positive",
        ),
        (extri(rot, "1., 0., 0., 0., 0., 1., 0., 1., 0."), "camera 00: Rot_00 is no rotation (determinant -1.0000"),
        (extri(rot, "2., 0., 0., 0., 0., -1., 0., 1., 0."), "camera 00: Rot_00 is no rotation"),
        (extri(rot, "1e200, 0., 0., 0., 0., -1e200, 0., 1e200, 0."), "camera 00: Rot_00 is no rotation"),
        (extri("[ 1.5707963267948966, 0., 0. ]", "[ 1., 2. ]"), "extri.yml: camera b: R_b cannot be read as a matrix"),
        (intri("K_b: !!opencv-matrix", "K_b: 7\nZ: !!opencv-matrix"), "camera b: K_b is not a matrix; export or redo"),
        (refusal("", EXTRI), "intri.yml: is not a YAML file of OpenCV's FileStorage (no keys in it)"),
        (refusal("%YAML:1.0\n---\n", EXTRI), "intri.yml: "),
        (
            refusal("%YAML:1.0\n---\nfoo: 1\n", EXTRI),
            "intri.yml: names no camera; expected a list `names` or matrices K_",
        ),
        (
            refusal("%YAML:1.0\n---\nK_00: !!opencv-matrix\n  rows: [\n", EXTRI),
            "intri.yml: is not a YAML file of OpenCV's",
        ),
        (refusal(INTRI, "\u{0}\u{1}"), "extri.yml: cannot be read: it is not text in UTF-8"),
    ];
    for (found, expected) in cases {
        assert!(found.contains(expected), "expected: {expected}\nfound:    {found}");
        assert!(!found.contains("OpenCV("), "{found}");
    }
    let text = load_easymocap(Path::new("/no/such/folder"), &SIZE).unwrap_err().to_string();
    assert!(text.starts_with("/no/such/folder/intri.yml: cannot be read: "), "{text}");
}

#[test]
fn distortion_that_we_cannot_model_is_refused_but_zeros_are_fine() {
    let with = |cols: usize, data: &str| {
        INTRI.replace(
            "cols: 5\n   dt: d\n   data: [ -0.1, 0.02, 0.001, -0.002, 0.003 ]",
            &format!("cols: {cols}\n   dt: d\n   data: [ {data} ]"),
        )
    };
    let dir = folder(&with(8, "0.1, 0., 0., 0., 0.2, 0., 0., 0."), EXTRI);
    let rig = load_easymocap(dir.path(), &SIZE).unwrap();
    let lens = Lens::RadialTangential { radial: [0.1, 0.0, 0.2], tangential: [0.0; 2] };
    assert_eq!(rig.cameras[0].intrinsics.lens, lens);
    let dir = folder(&with(8, "0.1, 0., 0., 0., 0.3, 0., 0.5, 0.7"), EXTRI);
    let rig = load_easymocap(dir.path(), &SIZE).unwrap();
    let lens = Lens::Rational { radial: [0.1, 0.0, 0.3, 0.0, 0.5, 0.7], tangential: [0.0; 2] };
    assert_eq!(rig.cameras[0].intrinsics.lens, lens);
    let text = refusal(&with(12, "0.1, 0., 0., 0., 0., 0., 0., 0., 0., 0.5, 0., 0."), EXTRI);
    assert!(
        text.contains(
            "camera 00: dist_00 has distortion coefficient 10 = 0.5 of the prism or tilt model; calibrate without it"
        ),
        "{text}"
    );
    let text = refusal(&with(3, "0.1, 0., 0."), EXTRI);
    assert!(text.contains("camera 00: dist_00 is 1x3, expected a row of 4, 5, 8, 12 or 14 numbers"), "{text}");
}

/// Damages files at random: they are rejected with an error or read as valid cameras.
#[test]
fn cut_and_flipped_files_never_panic() {
    let mut state = 1u64;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize
    };
    for round in 0..400 {
        let mut intri = INTRI.as_bytes().to_vec();
        let mut extri = EXTRI.as_bytes().to_vec();
        let file = if round % 2 == 0 { &mut intri } else { &mut extri };
        if round % 5 == 0 {
            file.truncate(random() % file.len());
        } else {
            for _ in 0..1 + random() % 3 {
                let at = random() % file.len();
                file[at] = b"0123456789-.:,[]!\n eN\xff"[random() % 22];
            }
        }
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("intri.yml"), intri).unwrap();
        fs::write(dir.path().join("extri.yml"), extri).unwrap();
        match load_easymocap(dir.path(), &SIZE) {
            Ok(rig) => rig.validate().unwrap(),
            Err(error) => assert!(error.to_string().contains(".yml") || error.to_string().contains("camera")),
        }
    }
}
