//! Calibrations of other programs: conventions, round trips, and damaged files.
#![allow(clippy::unwrap_used)] // helpers of tests

use std::{fs, path::Path};

use flyrig_calib::{Deviation, Format, load_calibration, load_lenses, save_calibration, save_export, save_lenses};
use flyrig_types::{Camera, ColorMatch, Intrinsics, Isometry, Lens, Rig};
use glam::{DVec2, DVec3};

const NO_SIZE: fn(&flyrig_types::CameraId) -> Option<(u32, u32)> = |_| None;

fn camera(name: &str, eye: DVec3, lens: Lens) -> Camera {
    Camera {
        id: name.into(),
        intrinsics: Intrinsics {
            width: 1280,
            height: 720,
            focal_px: DVec2::new(903.25 / 3.0, 907.5 / 3.0),
            center_px: DVec2::new(618.309, 394.213),
            lens,
        },
        camera_from_world: Isometry::look_at(eye, DVec3::new(0.0, 0.1, 0.9), DVec3::Z),
        time_offset_nanos: 0,
        color: Default::default(),
    }
}

/// Returns three cameras with different pitches and these lenses in turn.
fn rig(lenses: &[Lens]) -> Rig {
    let eyes = [DVec3::new(3.0, 0.5, 1.2), DVec3::new(-1.0, 2.8, 2.0), DVec3::new(-1.5, -2.5, 1.6)];
    let named = ["left", "00", "side.b"].into_iter().zip(eyes).enumerate();
    let cameras = named.map(|(i, (name, eye))| camera(name, eye, lenses[i % lenses.len()])).collect();
    Rig { cameras, world_up: DVec3::Z }
}

const PLAIN: Lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.0], tangential: [0.001, -0.002] };
const CUBIC: Lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.003], tangential: [0.001, -0.002] };
const RATIONAL: Lens = Lens::Rational { radial: [0.5, 0.12, 0.01, 0.8, 0.25, 0.02], tangential: [0.002, -0.001] };
const FISHEYE: Lens = Lens::Fisheye { coefficients: [0.05, -0.01, 0.002, -0.0005] };

/// Returns the lenses that a format can represent.
fn lenses_of(format: Format) -> Vec<Lens> {
    match format {
        Format::Flyrig | Format::OpenCv | Format::Colmap | Format::Anipose => vec![CUBIC, RATIONAL, FISHEYE],
        Format::EasyMocap | Format::Mrcal => vec![CUBIC, RATIONAL],
        Format::Kalibr => vec![PLAIN, FISHEYE],
        Format::Nerfstudio | Format::Qualisys => vec![CUBIC, PLAIN],
    }
}

/// Returns the largest distance of pixels at which two rigs see the same points, in the axes of their first cameras.
fn difference_px(a: &Rig, b: &Rig) -> f64 {
    let mut worst = 0.0f64;
    let first = b.cameras.iter().find(|camera| camera.id == a.cameras[0].id).unwrap();
    for x in [-0.4, 0.0, 0.5] {
        for y in [-0.5, 0.2] {
            for z in [0.1, 0.8, 1.7] {
                let world = DVec3::new(x, y, z);
                let other = (first.camera_from_world.inverse() * a.cameras[0].camera_from_world).transform_point(world);
                for camera in &a.cameras {
                    let same = b.cameras.iter().find(|known| known.id == camera.id).unwrap();
                    assert_eq!(camera.size(), same.size());
                    worst = worst.max(camera.project(world).unwrap().distance(same.project(other).unwrap()));
                }
            }
        }
    }
    worst
}

#[test]
fn every_format_gives_back_what_was_written() {
    for format in Format::ALL {
        let mut rig = rig(&lenses_of(format));
        let keeps_offsets = matches!(format, Format::Flyrig | Format::Kalibr);
        if keeps_offsets {
            rig.cameras[1].time_offset_nanos = -45_712_345;
        }
        let dir = tempfile::tempdir().unwrap();
        let files = format.write(dir.path(), &rig).unwrap();
        assert_eq!(files.len(), fs::read_dir(dir.path()).unwrap().count(), "{format:?}");
        assert_eq!(Format::detect(dir.path()), Some(format), "{files:?}");
        if !matches!(format, Format::OpenCv | Format::Mrcal) {
            assert_eq!(Format::detect(&dir.path().join(&files[0])), Some(format), "{files:?}");
        }
        let imported = format.read(dir.path(), &NO_SIZE, 1.0).unwrap();
        let back = imported.rig(dir.path()).unwrap().unwrap();
        assert!(difference_px(&rig, &back) < 1e-6, "{format:?}: {}", difference_px(&rig, &back));
        if keeps_offsets {
            let found = back.cameras.iter().find(|camera| camera.id.as_str() == "00").unwrap();
            assert_eq!(found.time_offset_nanos, -45_712_345, "{format:?}");
        }
        // The cameras are level: up is found even where the format does not say it, in the axes of the file's world.
        let find = |rig: &Rig| rig.cameras.iter().find(|camera| camera.id.as_str() == "left").unwrap().clone();
        let up = |rig: &Rig| find(rig).camera_from_world.rotation * rig.world_up;
        assert!(up(&back).angle_between(up(&rig)) < 1e-6, "{format:?}: {}", back.world_up);
        // Lengths are scaled.
        let scaled = format.read(dir.path(), &NO_SIZE, 0.001).unwrap().rig(dir.path()).unwrap().unwrap();
        let apart = |rig: &Rig| rig.cameras[0].position().distance(rig.cameras[1].position());
        assert!((apart(&scaled) - 0.001 * apart(&back)).abs() < 1e-9, "{format:?}");
    }
}

#[test]
fn lenses_that_a_format_cannot_hold_are_refused_and_nothing_is_written() {
    for (format, lens, expected) in [
        (Format::EasyMocap, FISHEYE, "camera left: EasyMocap's format has no fisheye lens"),
        (Format::Kalibr, CUBIC, "camera left: Kalibr has no k3"),
        (Format::Nerfstudio, RATIONAL, "camera left: nerfstudio has no rational lens"),
        (Format::Qualisys, FISHEYE, "camera left: Qualisys has no fisheye"),
        (Format::Mrcal, FISHEYE, "camera left: mrcal has no such fisheye"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let text = format.write(dir.path(), &rig(&[lens])).unwrap_err().to_string();
        assert!(text.contains(expected), "{text}");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "{format:?}");
    }
    let dir = tempfile::tempdir().unwrap();
    let text = Format::Nerfstudio.write(dir.path(), &rig(&[CUBIC, FISHEYE])).unwrap_err().to_string();
    assert!(text.contains("only some are fisheyes"), "{text}");
    let mut named = rig(&[CUBIC]);
    named.cameras[0].id = "../evil".into();
    let text = Format::Mrcal.write(dir.path(), &named).unwrap_err().to_string();
    assert!(text.contains("the camera name '../evil' has a path separator; rename it"), "{text}");
}

/// Reads one file and returns the rig.
fn read(format: Format, files: &[(&str, &str)]) -> Rig {
    let dir = tempfile::tempdir().unwrap();
    for (name, text) in files {
        fs::write(dir.path().join(name), text).unwrap();
    }
    assert_eq!(Format::detect(dir.path()), Some(format));
    format.read(dir.path(), &NO_SIZE, 1.0).unwrap().rig(dir.path()).unwrap().unwrap()
}

#[test]
fn axes_and_pixel_origins_are_those_of_the_other_program() {
    // A camera 4 m before the origin on the axis -y that looks along +y; a point 1 m right of the origin and 0.5 m up lies right of
    // the middle and above it.
    let expected = |rig: &Rig, center: DVec2| {
        let pixel = rig.cameras[0].project(DVec3::new(1.0, 0.0, 0.5)).unwrap();
        assert!(pixel.distance(center + DVec2::new(250.0, -125.0)) < 1e-6, "{pixel}");
    };
    let colmap = read(
        Format::Colmap,
        &[
            ("cameras.txt", "# comment\n7 SIMPLE_PINHOLE 640 480 1000 320 240\n"),
            ("images.txt", "1 0.7071067811865476 0.7071067811865476 0 0 0 0 4 7 rig/front/0001.png\n\n"),
        ],
    );
    // Half a turn less: x right, y down, z forward from z up is a quarter turn about x.
    expected(&colmap, DVec2::new(319.5, 239.5));
    assert_eq!(colmap.cameras[0].id.as_str(), "front");

    let nerf = r#"{ "fl_x": 1000, "fl_y": 1000, "cx": 320, "cy": 240, "w": 640, "h": 480, "camera_model": "OPENCV",
        "frames": [{ "file_path": "./images/front.jpg",
        "transform_matrix": [[1,0,0,0],[0,0,-1,-4],[0,1,0,0],[0,0,0,1]] }] }"#;
    let nerf = read(Format::Nerfstudio, &[("transforms.json", nerf)]);
    expected(&nerf, DVec2::new(319.5, 239.5));
    assert_eq!(nerf.cameras[0].id.as_str(), "front");

    let qualisys = r#"<?xml version="1.0"?><calibration type="regular"><results std-dev="0.5"/><cameras>
        <camera active="1" serial="26580" model="Miqus Video" viewrotation="0">
        <transform x="0" y="-4000" z="0" r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0"/>
        <intrinsic focallength="9.2" sensorMinU="0.000000" sensorMaxU="40959.0" sensorMinV="0" sensorMaxV="30719.000000"
        focalLengthU="64000" focalLengthV="64000" centerPointU="20480" centerPointV="15360" skew="0" radialDistortion1="0"
        radialDistortion2="0" radialDistortion3="0" tangentalDistortion1="0" tangentalDistortion2="0"/></camera></cameras></calibration>"#;
    let qualisys = read(Format::Qualisys, &[("take.qca.txt", qualisys)]);
    expected(&qualisys, DVec2::new(319.5, 239.5));
    assert_eq!((qualisys.cameras[0].size(), qualisys.world_up), ([640, 480], DVec3::Z));

    let anipose = "[cam_0]\nname = \"front\"\nsize = [640, 480]\nmatrix = [[1000.0, 0.0, 320.0], [0.0, 1000, 240.0], [0.0, 0.0, 1.0]]\n\
        distortions = [0.0, 0.0, 0.0, 0.0, 0.0]\nrotation = [1.5707963267948966, 0.0, 0.0]\ntranslation = [0.0, 0.0, 4]\n[metadata]\n\
        adjusted = false\n";
    expected(&read(Format::Anipose, &[("anipose.toml", anipose)]), DVec2::new(320.0, 240.0));
    let caliscope = "[cameras.0]\ncam_id = 0\nrotation_count = 0\nsize = [640, 480]\nmatrix = [[1000.0, 0.0, 320.0], [0.0, 1000.0, \
        240.0], [0.0, 0.0, 1.0]]\ndistortions = [0.0, 0.0, 0.0, 0.0, 0.0]\ntranslation = [0.0, 0.0, 4.0]\nrotation = [[1.0, 0.0, 0.0], \
        [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]\n";
    expected(&read(Format::Anipose, &[("camera_array.toml", caliscope)]), DVec2::new(320.0, 240.0));

    let mrcal = "# generated with a tool\n{ 'lensmodel': 'LENSMODEL_OPENCV4',\n  # fx,fy,cx,cy\n  'intrinsics': [ 1000., 1e3, 320.,\n 240,\
        0.,0,.0,0,],\n 'extrinsics': ( 1.5707963267948966, 0, 0, 0, 0., 4, ),\n 'imagersize': [ 640, 480 ],\n 'optimization_inputs': \
        b'P\\x04\"{}',\n 'icam_intrinsics': None }\n";
    expected(&read(Format::Mrcal, &[("front.cameramodel", mrcal)]), DVec2::new(320.0, 240.0));

    let opencv = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   \
        data: [ 1000., 0., 320., 0., 1000., 240., 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   \
        data: [ 0., 0., 0., 0., 0. ]\nrvec: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 1.5707963267948966, 0., 0. ]\ntvec: \
        !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 0., 0., 4. ]\n";
    expected(&read(Format::OpenCv, &[("front.yml", opencv)]), DVec2::new(320.0, 240.0));
}

#[test]
fn kalibr_chains_cameras_and_shifts_time() {
    let text = "cam0:\n  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: [-0.28, 0.07,\n    0.0002, 1.8e-05]\n  \
        distortion_model: radtan\n  intrinsics: [458.6, 457.3, 367.2, 248.4]\n  resolution: [752, 480]\n  rostopic: /front/image_raw\n  \
        timeshift_cam_imu: 0.010\ncam1:\n  T_cn_cnm1:\n  - [1.0, 0.0, 0.0,\n    -0.11]\n  - [0.0, 1.0, 0.0, 0.002]\n  - [0.0, 0.0, 1.0, 0.0]\n  \
        - [0.0, 0.0, 0.0, 1.0]\n  camera_model: pinhole\n  distortion_coeffs: [0.01, 0.0, 0.0, 0.0]\n  distortion_model: equidistant\n  \
        intrinsics: [457.0, 456.0, 379.9, 255.2]\n  resolution: [752, 480]\n  rostopic: /cam1/image_raw\n  timeshift_cam_imu: 0.025\n";
    let rig = read(Format::Kalibr, &[("camchain.yaml", text)]);
    assert_eq!(rig.cameras.iter().map(|camera| camera.id.as_str()).collect::<Vec<_>>(), ["front", "cam1"]);
    assert!(rig.cameras[1].position().distance(DVec3::new(0.11, -0.002, 0.0)) < 1e-12);
    assert_eq!(rig.cameras[1].time_offset_nanos, -15_000_000, "its stamps are earlier than those of cam0");
    assert!(matches!(rig.cameras[1].intrinsics.lens, Lens::Fisheye { .. }));
    let Lens::RadialTangential { radial, tangential } = rig.cameras[0].intrinsics.lens else { panic!() };
    assert_eq!((radial, tangential), ([-0.28, 0.07, 0.0], [0.0002, 1.8e-5]));
}

#[test]
fn damaged_files_are_named_with_the_fix() {
    let check = |format: Format, files: &[(&str, &str)], expected: &str| {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in files {
            fs::write(dir.path().join(name), text).unwrap();
        }
        let text = match format.read(dir.path(), &NO_SIZE, 1.0) {
            Ok(imported) => imported.rig(dir.path()).unwrap_err().to_string(),
            Err(error) => error.to_string(),
        };
        assert!(text.contains(expected), "{format:?}: {text}");
    };
    let lens = "1 OPENCV 640 480 500 500 320 240 0 0 0 0\n";
    check(
        Format::Colmap,
        &[("cameras.txt", "1 THIN_PRISM_FISHEYE 640 480 1 2\n"), ("images.txt", "")],
        "line 1: camera model THIN_PRISM",
    );
    check(
        Format::Colmap,
        &[("cameras.txt", lens), ("images.txt", "1 1 0 0 0 0 0 0 9 a.png\n\n")],
        "line 1: camera 9 is not in",
    );
    check(
        Format::Colmap,
        &[("cameras.txt", lens), ("images.txt", "1 2 0 0 0 0 0 0 1 a.png\n\n")],
        "the quaternion has length 2",
    );
    check(
        Format::Colmap,
        &[("cameras.txt", lens), ("images.txt", "1 1 0 0 0 0 0 0 1 a/0.png\n\n2 1 0 0 0 0 0 1 1 a/1.png\n\n")],
        "camera a has two poses",
    );
    check(Format::Colmap, &[("cameras.bin", "")], "model_converter");
    check(Format::Colmap, &[("cameras.txt", lens)], "images.txt: cannot be read");
    check(Format::Nerfstudio, &[("transforms.json", "{")], "is no JSON");
    check(
        Format::Nerfstudio,
        &[("transforms.json", "{\"frames\": [{\"file_path\": \"a\"}]}")],
        "frame 0: w or h is missing",
    );
    check(
        Format::Kalibr,
        &[("camchain.yaml", "cam0:\n  camera_model: omni\n")],
        "cam0: camera_model \"omni\" is not supported",
    );
    check(Format::Kalibr, &[("camchain.yaml", "cam0: [1, 2\n")], "is no YAML of a camera chain (line ");
    check(
        Format::Mrcal,
        &[("a.cameramodel", "{ 'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': [1,2,3,4] }")],
        "mrcal-convert-lensmodel",
    );
    check(Format::Mrcal, &[("a.cameramodel", "import os")], "is not a Python dictionary");
    check(Format::Qualisys, &[("a.qca.txt", "<a>")], "is no XML");
    check(Format::Qualisys, &[("a.qca.txt", "<a/>")], "names no camera");
    check(Format::Anipose, &[("anipose.toml", "[a]\nmatrix = 3\n")], "camera a: matrix is missing or not");
    check(Format::OpenCv, &[("a.yml", "%YAML:1.0\n---\nk: 1\n")], "camera_matrix is missing");
    check(Format::Flyrig, &[("calibration.toml", "version = 9\n")], "calibration.toml: version 9 is not known");
    let good = "version = 1\nup = [0, 0, 1]\n[[cameras]]\nname = \"a\"\nsize = [640, 480]\nfocal_px = [500, 500]\ncenter_px = [320, 240]\n\
        lens = { model = \"fisheye\", coefficients = [0, 0, 0, 0] }\nrotation = [[1,0,0],[0,1,0],[0,0,1]]\ntranslation_m = [0, 0, 0]\n";
    for (from, to, expected) in [
        ("up = [0, 0, 1]", "up = [0, 0, 0]", "up is not a direction"),
        ("size = [640, 480]", "size = [640]", "line 5: "),
        ("[500, 500]", "[-500, 500]", "camera a: focal length fx is -500"),
        ("[500, 500]", "[nan, 500]", "camera a: the camera matrix K is not a finite number"),
        ("fisheye", "omni", "unknown variant `omni`"),
        ("name", "nome", "unknown field `nome`"),
        ("[[1,0,0]", "[[2,0,0]", "camera a: rotation is no rotation"),
        ("translation_m = [0, 0, 0]\n", "", "rotation is given without translation_m"),
        (
            "translation_m = [0, 0, 0]\n",
            "translation_m = [0, 0, 0]\ntime_offset_ms = 1e9\n",
            "camera a: time offset is",
        ),
        (
            "translation_m = [0, 0, 0]\n",
            "translation_m = [0, 0, 0]\ntime_offset_ms = nan\n",
            "time_offset_ms is not a finite",
        ),
        ("size = [640, 480]", "size = [640, 99999]", "image height is 99999"),
    ] {
        assert!(good.contains(from));
        check(Format::Flyrig, &[("calibration.toml", &good.replace(from, to))], expected);
    }
    let twice = format!("{good}{}", &good[good.find("[[cameras]]").unwrap()..]);
    check(Format::Flyrig, &[("calibration.toml", &twice)], "camera a is in it twice");
}

#[test]
fn a_calibration_folder_is_read_whatever_it_holds() {
    let mut rig = rig(&[CUBIC, RATIONAL, FISHEYE]);
    rig.world_up = DVec3::new(0.1, -0.2, 0.9).normalize();
    rig.cameras[2].time_offset_nanos = 1_234_567;
    rig.cameras[1].color = ColorMatch { gain: [1.25, 1.0, 0.8], exponent: 1.1, falloff: [0.125, -0.5] };
    let dir = tempfile::tempdir().unwrap();
    let deviation = Deviation { rotation_deg: 0.01234, position_mm: 1.5, time_offset_ms: Some(0.25) };
    save_calibration(dir.path(), &rig, &[None, Some(deviation)]).unwrap();
    let text = fs::read_to_string(dir.path().join("calibration.toml")).unwrap();
    assert!(
        text.contains("deviation = { rotation_deg = 0.0123, position_mm = 1.50, time_offset_ms = 0.25 }"),
        "{text}"
    );
    let back = load_calibration(dir.path(), &NO_SIZE).unwrap();
    assert!(back.world_up.distance(rig.world_up) < 1e-12 && difference_px(&rig, &back) < 1e-9);
    assert_eq!(back.cameras[2].time_offset_nanos, 1_234_567);
    assert_eq!((back.cameras[0].color, back.cameras[1].color), (ColorMatch::NONE, rig.cameras[1].color));
    let other = load_calibration(dir.path(), &|_| Some((640, 480))).unwrap_err().to_string();
    assert!(other.contains("camera left: calibrated for images of 1280x720, but they are 640x480"), "{other}");

    // Lenses alone are no rig.
    let lenses: Vec<_> = rig.cameras.iter().map(|camera| (camera.id.clone(), camera.intrinsics)).collect();
    save_lenses(dir.path(), &lenses).unwrap();
    assert_eq!(load_lenses(dir.path(), &NO_SIZE).unwrap(), lenses);
    let text = load_calibration(dir.path(), &NO_SIZE).unwrap_err().to_string();
    assert!(text.contains("holds lenses only, no poses; run flyrig calibrate rig"), "{text}");

    // EasyMocap's files count where there is no calibration.toml; nothing at all names both.
    let text = load_calibration(Path::new("/no/such/folder"), &NO_SIZE).unwrap_err().to_string();
    assert!(text.contains("holds calibration.toml, or intri.yml and extri.yml"), "{text}");
    for (lenses, file) in [([CUBIC, RATIONAL], "intri.yml"), ([CUBIC, FISHEYE], "calibration.toml")] {
        let exported = tempfile::tempdir().unwrap();
        let rig = self::rig(&lenses);
        save_export(exported.path(), &rig).unwrap();
        assert!(exported.path().join(file).exists());
        assert!(difference_px(&rig, &load_calibration(exported.path(), &NO_SIZE).unwrap()) < 1e-9);
    }
}

#[test]
fn cut_and_changed_files_never_panic() {
    let mut random = 1u64;
    let mut next = |most: usize| {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((random >> 33) as usize) % most.max(1)
    };
    for format in Format::ALL {
        let dir = tempfile::tempdir().unwrap();
        let files = format.write(dir.path(), &rig(&lenses_of(format))).unwrap();
        for _ in 0..150 {
            let path = dir.path().join(&files[next(files.len())]);
            let good = fs::read(&path).unwrap();
            let mut bad = good.clone();
            for _ in 0..=next(4) {
                let at = next(bad.len());
                match next(4) {
                    0 => bad.truncate(at),
                    1 => drop(bad.drain(at..(at + next(40)).min(bad.len()))),
                    2 => bad.insert(at.min(bad.len()), b"[]{}'\"\\#-0e9\n\xff"[next(14)]),
                    _ => {
                        if let Some(byte) = bad.get_mut(at) {
                            *byte = next(256) as u8;
                        }
                    }
                }
                if bad.is_empty() {
                    break;
                }
            }
            fs::write(&path, &bad).unwrap();
            if let Ok(imported) = format.read(dir.path(), &NO_SIZE, 1.0)
                && let Ok(Some(rig)) = imported.rig(dir.path())
            {
                assert!(rig.cameras.iter().all(|camera| camera.validate().is_ok()));
            }
            fs::write(&path, &good).unwrap();
        }
    }
}
