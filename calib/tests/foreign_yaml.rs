//! Kalibr, OpenCV's FileStorage and EasyMocap as other programs save them: every notation, every key of a lens; text of any editor.
#![allow(clippy::unwrap_used, clippy::panic)] // helpers of tests

mod support;

use std::fs;

use flyrig_calib::{Format, load_easymocap};
use flyrig_types::{Lens, Rig};
use glam::DVec3;
use support::{FISHEYE, NO_SIZE, RADIAL, folder, names, read, refused, rig};

// Kalibr

/// Returns a chain in flow style; `motions` holds lines of each camera.
fn chain(topics: &[&str], motions: &[&str]) -> String {
    let camera = |(number, (topic, motion)): (usize, (&&str, &&str))| {
        format!(
            "cam{number}:\n{motion}  camera_model: pinhole\n  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]\n  distortion_model: radtan\n  \
             intrinsics: [500.0, 510.0, 320.0, 240.0]\n  resolution: [640, 480]\n  rostopic: {topic}\n"
        )
    };
    topics.iter().zip(motions).enumerate().map(camera).collect()
}

const STEP: &str = "  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, -0.5]\n  - [0.0, 1.0, 0.0, 0.1]\n  - [0.0, 0.0, 1.0, 0.2]\n  - [0.0, 0.0, 0.0, 1.0]\n";

#[test]
fn kalibr_cameras_are_named_by_the_part_of_their_topics_that_differs() {
    for (topics, expected) in [
        (
            ["/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw", "/camera/color/image_raw"],
            ["infra1", "infra2", "color"],
        ),
        (["/left/image_raw", "/right/image_raw", "/up/image_raw"], ["left", "right", "up"]),
        (["/rig/a/left/image", "/rig/a/right/image", "/rig/b/left/image"], ["a_left", "a_right", "b_left"]),
        (["/x/image", "/x/image", "/x/image"], ["cam0", "cam1", "cam2"]),
        (["\"\"", "/x/image", "\"\""], ["cam0", "cam1", "cam2"]),
    ] {
        let text = chain(&topics, &["", STEP, STEP]);
        let rig = rig(Format::Kalibr, &[("camchain.yaml", text.as_bytes())]);
        assert_eq!(names(&rig), expected, "{topics:?}");
        assert!(rig.cameras[2].position().distance(DVec3::new(1.0, -0.2, -0.4)) < 1e-12);
    }
}

#[test]
fn a_chain_reads_alike_in_every_notation_of_yaml() {
    let flow = chain(&["/a/image", "/b/image"], &["", STEP]);
    let expected = rig(Format::Kalibr, &[("camchain.yaml", flow.as_bytes())]);
    let block = "cam0: &first\n  camera_model: pinhole\n  distortion_coeffs: &lens\n  - -0.1\n  - 0.02\n  - 1.0e-3\n  - -2.0e-3\n  distortion_model: radtan\n  \
        intrinsics:\n  - 500.0\n  - 510.0\n  - 320.0\n  - 240.0\n  resolution:\n    - 640\n    - 480\n  rostopic: /a/image\ncam1:\n  T_cn_cnm1:\n  - - 1.0\n    \
        - 0.0\n    - 0.0\n    - -0.5\n  - - 0.0\n    - 1.0\n    - 0.0\n    - 0.1\n  - - 0.0\n    - 0.0\n    - 1.0\n    - 0.2\n  - [0.0, 0.0, 0.0, 1.0]\n  \
        distortion_coeffs: *lens\n  <<: *first\n  rostopic: >-\n    /b/image\n";
    let header = format!(
        "%YAML:1.0 # need to specify the file type at the top!\n\n{}",
        flow.replace("[640, 480]", "[640,\n    480]")
    );
    let json = r#"{"cam0": {"camera_model": "pinhole", "distortion_coeffs": [-0.1, 0.02, 0.001, -0.002], "distortion_model": "radtan", "intrinsics":
        [500, 510, 320, 240], "resolution": [640, 480], "rostopic": "/a/image"}, "cam1": {"T_cn_cnm1": [[1, 0, 0, -0.5], [0, 1, 0, 0.1],
        [0, 0, 1, 0.2], [0, 0, 0, 1]], "camera_model": "pinhole", "distortion_coeffs": [-0.1, 0.02, 0.001, -0.002], "distortion_model": "radtan",
        "intrinsics": [500, 510, 320, 240], "resolution": [640, 480], "rostopic": "/b/image"}}"#;
    let quoted = flow
        .replace("pinhole", "'pinhole'  # the lens")
        .replace("cam0:", "---\n\"cam0\": !!map")
        .replace("resolution: [", "resolution: !!python/tuple [");
    for (name, text) in [
        ("camchain.yaml", block),
        ("take-camchain.yaml", &header),
        ("kalibr_imucam_chain.yaml", &quoted),
        ("camchain.yaml", json),
    ] {
        assert_eq!(rig(Format::Kalibr, &[(name, text.as_bytes())]), expected, "{text}");
    }
}

#[test]
fn poses_of_a_chain_come_from_the_imu_where_nothing_else_is_there() {
    let motion = |key: &str, rows: &str| format!("  {key}:\n  {rows}\n  - [0.0, 0.0, 0.0, 1.0]\n");
    let turned = "- [0.0, -1.0, 0.0, 0.1]\n  - [1.0, 0.0, 0.0, 0.2]\n  - [0.0, 0.0, 1.0, 0.3]";
    let inverse = "- [0.0, 1.0, 0.0, -0.2]\n  - [-1.0, 0.0, 0.0, 0.1]\n  - [0.0, 0.0, 1.0, -0.3]";
    let straight = "- [1.0, 0.0, 0.0, 0.0]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.5]";
    for (first, second) in [
        (motion("T_cam_imu", straight), motion("T_cam_imu", turned)),
        (motion("T_cam_imu", straight), motion("T_imu_cam", inverse)),
    ] {
        let text = chain(&["/a/i", "/b/i"], &[&first, &second]);
        let rig = rig(Format::Kalibr, &[("camchain.yaml", text.as_bytes())]);
        // A point of the first camera is 0.5 further back for the IMU, turned a quarter about z, and moved.
        let found = rig.cameras[1].camera_from_world.transform_point(DVec3::new(1.0, 2.0, 4.0));
        assert!(found.distance(DVec3::new(-1.9, 1.2, 3.8)) < 1e-9, "{found}");
    }
    let alone = chain(&["/a/i", "/b/i"], &["", &motion("T_cam_imu", turned)]);
    refused(Format::Kalibr, "camchain.yaml", &alone, &["cam1", "T_cn_cnm1 is missing", "T_cam_imu"]);
}

#[test]
fn lenses_and_keys_of_kalibr_that_are_not_understood_are_named() {
    let good = chain(&["/a/i", "/b/i"], &["", STEP]);
    for (from, to, words) in [
        ("pinhole", "omni", &["cam0", "camera_model \"omni\" is not supported"][..]),
        ("pinhole", "ds", &["camera_model \"ds\""]),
        ("pinhole", "eucm", &["camera_model \"eucm\""]),
        ("radtan", "fov", &["distortion_model \"fov\" with 4"]),
        ("radtan", "none", &["none", "4 coefficients"]),
        ("radtan", "equi", &["distortion_model \"equi\""]),
        ("  rostopic: /a/i", "  line_delay: 0.00003\n  rostopic: /a/i", &["\"line_delay\" is not understood"]),
        ("  rostopic: /a/i", "  T_BS: [1]\n  rostopic: /a/i", &["\"T_BS\" is not understood"]),
        ("  rostopic: /a/i", "  timeshift_cam_imu: 0.1\n  rostopic: /a/i", &["cam1", "timeshift_cam_imu is missing"]),
        ("cam1:", "cam2:", &["cam1 is missing"]),
        ("cam1:", "cam0:", &["\"cam0\" is there twice"]),
        ("cam0:", "units: mm\ncam0:", &["\"units\" is not understood"]),
        ("[640, 480]", "[640, 1e300]", &["image height"]),
        ("500.0", ".nan", &["not a finite number"]),
        ("500.0", "fast", &["intrinsics is missing or no list of numbers"]),
        ("0.5]", "inf]", &["T_cn_cnm1"]),
    ] {
        assert!(good.contains(from), "{from}");
        refused(Format::Kalibr, "camchain.yaml", &good.replacen(from, to, 1), words);
    }
    let read = good.replace("radtan", "none").replace("[-0.1, 0.02, 0.001, -0.002]", "[]");
    assert_eq!(rig(Format::Kalibr, &[("camchain.yaml", read.as_bytes())]).cameras[0].intrinsics.lens, Lens::PINHOLE);
}

#[test]
fn yaml_that_would_fill_the_memory_is_refused_at_once() {
    let laughs: String = (1..12).fold("a0: &a0 [x, x, x, x, x, x, x, x, x]\n".to_owned(), |text, level| {
        let last = format!("*a{}, ", level - 1).repeat(9);
        format!("{text}a{level}: &a{level} [{last}]\n")
    });
    for (text, word) in [
        (laughs, "values; this is no calibration"),
        ("cam0: ".to_owned() + &"[".repeat(400_000), "line 1: "),
        ("cam0: ".to_owned() + &"{a: ".repeat(200_000), "line 1: "),
        ((0..20_000).map(|depth| " ".repeat(depth.min(200)) + "- \n").collect(), "YAML"),
        ("cam0: &a [*a]\n".to_owned(), "line 1"),
        ("cam0: [".to_owned() + &"1,".repeat(3_000_000) + "]", "values; this is no calibration"),
        ("cam0:\n".to_owned() + &"- 1\n".repeat(1_000_000), "values; this is no calibration"),
        ("cam0:\n".to_owned() + &"- ".repeat(1_000_000), "deep"),
    ] {
        let begin = std::time::Instant::now();
        refused(Format::Kalibr, "camchain.yaml", &text, &[word]);
        assert!(begin.elapsed().as_secs() < 5, "{word}: {:?}", begin.elapsed());
    }
}

// FileStorage

const STORAGE: &str = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 500., 0., \
    320., 0., 510.,\n       240., 0., 0., 1. ]\ndistortion_model: MODEL\ndistortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n   data: [ \
    0.05, -0.02, 0.006, 0.001 ]\n";

#[test]
fn the_distortion_model_of_a_storage_is_heeded_or_named() {
    let lens = |text: &str| read(Format::OpenCv, &[("a.yml", text.as_bytes())]).unwrap().lenses()[0].1.lens;
    for model in ["equidistant", "fisheye", "kannala_brandt", "Equidistant"] {
        assert_eq!(lens(&STORAGE.replace("MODEL", model)), FISHEYE, "{model}");
    }
    for model in ["plumb_bob", "radtan", "rational_polynomial", "radial-tangential"] {
        assert_eq!(lens(&STORAGE.replace("MODEL", model)), RADIAL, "{model}");
    }
    assert_eq!(lens(&STORAGE.replace("distortion_model: MODEL\n", "")), RADIAL);
    let with = |line: &str| STORAGE.replace("distortion_model: MODEL", line);
    assert_eq!(lens(&with("fisheye_model: 1")), FISHEYE);
    assert_eq!(lens(&with("fisheye_model: true")), FISHEYE);
    assert_eq!(lens(&with("camera_model: fisheye")), FISHEYE);
    assert_eq!(lens(&with("camera_model: pinhole\ndistortion_model: fisheye")), FISHEYE);
    for (line, word) in [
        ("distortion_model: fov", "distortion_model: model \"fov\""),
        ("distortion_model: inverse_brown_conrady", "distortion_model: model \"inverse_brown"),
        ("distortion_model: 3", "distortion_model: model \"3\""),
        ("distortion_model: [a]", "distortion_model is no word"),
        ("fisheye_model: 2", "fisheye_model is \"2\""),
        ("fisheye_model: 1\ndistortion_model: plumb_bob", "contradict each other"),
        ("camera_model: omnidirectional", "camera_model: model \"omnidirectional\""),
        ("xi: 0.9", "\"xi\" is not understood"),
        ("model_type: MEI", "\"model_type\" is not understood"),
        ("units: mm", "\"units\" is not understood"),
        ("axis_convention: opengl", "\"axis_convention\" is not understood"),
    ] {
        refused(Format::OpenCv, "a.yml", &with(line), &[word]);
    }
}

#[test]
fn a_storage_reads_in_each_of_its_forms() {
    let yaml = STORAGE.replace("MODEL", "fisheye")
        + "rvec: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 0.1, 0., 0. ]\ntvec: !!opencv-matrix\n   \
        rows: 3\n   cols: 1\n   dt: d\n   data: [ 1., 2., 3. ]\n";
    let expected = rig(Format::OpenCv, &[("a.yml", yaml.as_bytes())]);
    let xml = r#"<?xml version="1.0"?>
        <opencv_storage><image_width>640</image_width><image_height>480</image_height>
        <camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>500. 0. 320. 0. 510.
            240. 0. 0. 1.</data></camera_matrix><distortion_model>fisheye</distortion_model>
        <distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>4</cols><dt>d</dt><data>0.05 -0.02 0.006 0.001</data></distortion_coefficients>
        <rvec type_id="opencv-matrix"><rows>3</rows><cols>1</cols><dt>d</dt><data>0.1 0. 0.</data></rvec>
        <tvec type_id="opencv-matrix"><rows>3</rows><cols>1</cols><dt>d</dt><data>1. 2. 3.</data></tvec></opencv_storage>"#;
    let json = r#"{"image_width": 640, "image_height": 480
        // flags: +fix_aspect_ratio: yes
        , "camera_matrix": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d",
        "data": [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]}, "distortion_model": "fisheye", "distortion_coefficients": {"type_id":
        "opencv-matrix", "rows": 1, "cols": 4, "dt": "d", "data": [0.05, -0.02, 0.006, 0.001]}, "rvec": {"rows": 3, "cols": 1, "dt": "d",
        "data": [0.1, 0.0, 0.0]}, "tvec": {"rows": 3, "cols": 1, "dt": "d", "data": [1.0, 2.0, 3.0]}}"#;
    // The sample of OpenCV 2.4, voxl's keys, and ROS' plain YAML with lists.
    let old = yaml
        .replace("camera_matrix", "Camera_Matrix")
        .replace("distortion_coeff", "Distortion_Coeff")
        .replace("image_w", "image_W")
        .replace("image_h", "image_H");
    let voxl = yaml.replace("camera_matrix", "M").replace("distortion_coefficients", "D").replace("image_", "")
        + "reprojection_error: 0.2\n";
    let ros = "image_width: 640\nimage_height: 480\ncamera_name: a\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [500, 0, 320, 0, 510, 240, 0, 0, 1]\n\
        distortion_model: equidistant\ndistortion_coefficients: [0.05, -0.02, 0.006, 0.001]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, \
        0, 0, 1]\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: [500, 0, 320, 0, 0, 510, 240, 0, 0, 0, 1, 0]\nrvec: [0.1, 0.0, 0.0]\ntvec: [1, 2, 3]\n";
    for (name, text) in [("a.xml", xml), ("a.json", json), ("a.yml", &old), ("a.yml", &voxl), ("a.yaml", ros)] {
        assert_eq!(rig(Format::OpenCv, &[(name, text.as_bytes())]), expected, "{name}: {text}");
        let dir = folder(&[(name, text.as_bytes())]);
        assert_eq!(Format::detect(&dir.path().join(name)), Some(Format::OpenCv), "{name}");
    }
    refused(Format::OpenCv, "a.yml", "%YAML:1.0\n---\nM1: 1\nD1: 2\n", &["stereo pair"]);
    refused(Format::OpenCv, "a.xml", "<opencv_storage><a>", &["not a YAML file of OpenCV's FileStorage"]);
    refused(Format::OpenCv, "a.yml", &yaml.replace("[ 0.1, 0., 0. ]", "!!binary |\n     ZGRkZA=="), &["base64"]);
}

// EasyMocap

fn easymocap(lens: &str, pose: &str) -> Result<Rig, String> {
    let intri = format!(
        "%YAML:1.0\r\n---\r\nnames:\r\n  - \"00\"\r\nK_00: !!opencv-matrix\r\n  rows: 3\r\n  cols: 3\r\n  dt: d\r\n  data: [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, \
         0.0, 0.0, 1.0]\r\nH_00: 480.0000000000\r\nW_00: 640.0000000000\r\n{lens}"
    );
    let extri = format!(
        "%YAML:1.0\r\n---\r\nnames:\r\n  - \"00\"\r\nT_00: !!opencv-matrix\r\n  rows: 3\r\n  cols: 1\r\n  dt: d\r\n  data: [0.0, 1.0, 3.0]\r\n{pose}"
    );
    let dir = folder(&[("intri.yml", intri.as_bytes()), ("extri.yml", extri.as_bytes())]);
    load_easymocap(dir.path(), &NO_SIZE).map_err(|error| error.to_string())
}

fn matrix(key: &str, rows: usize, data: &str) -> String {
    let cols = data.split(',').count() / rows;
    format!("{key}: !!opencv-matrix\r\n  rows: {rows}\r\n  cols: {cols}\r\n  dt: d\r\n  data: [{data}]\r\n")
}

#[test]
fn lenses_of_easyvolcap_are_read_and_its_fisheyes_named() {
    let pose = matrix("R_00", 3, "0.1, 0.0, 0.0");
    let own = matrix("D_00", 5, "-0.041, 0.052, 0.0007, -0.0011, 0.013");
    let lens = Lens::RadialTangential { radial: [-0.041, 0.052, 0.013], tangential: [0.0007, -0.0011] };
    assert_eq!(easymocap(&own, &pose).unwrap().cameras[0].intrinsics.lens, lens);
    let both = own.clone() + &own.replace("D_00", "dist_00");
    assert_eq!(easymocap(&both, &pose).unwrap().cameras[0].intrinsics.lens, lens);
    let turned = matrix("Rot_00", 3, "1, 0, 0, 0, 0, -1, 0, 1, 0");
    for (lens, pose, word) in [
        (own.clone() + &matrix("dist_00", 5, "0, 0, 0, 0, 0"), pose.clone(), "dist_00 and D_00 differ"),
        (own.clone() + &matrix("rdist_00", 4, "0.1, 0, 0, 0"), pose.clone(), "rdist_00 is a fisheye's"),
        (own.clone() + "fisheye_00: 1\r\n", pose.clone(), "key \"fisheye\" is not understood"),
        (own.clone(), pose.clone() + &turned, "Rot_00 and R_00 are different rotations"),
        (own.replace("0.013", ".nan"), pose, "D_00 holds NaN"),
    ] {
        let error = easymocap(&lens, &pose).unwrap_err();
        assert!(error.contains(word), "{word}: {error}");
    }
}

// Text

#[test]
fn every_reader_takes_text_as_editors_on_windows_save_it() {
    let lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.0], tangential: [0.001, -0.002] };
    let plain = easymocap(&matrix("dist_00", 1, "-0.1, 0.02, 0.001, -0.002, 0.0"), &matrix("R_00", 3, "0.1, 0.0, 0.0"))
        .unwrap();
    assert_eq!(plain.cameras[0].intrinsics.lens, lens);
    let wide = |text: &str, mark: [u8; 2], bytes: fn(u16) -> [u8; 2]| {
        [mark.to_vec(), text.encode_utf16().flat_map(bytes).collect()].concat()
    };
    for format in Format::ALL {
        let dir = tempfile::tempdir().unwrap();
        let files = format.write(dir.path(), &plain).unwrap();
        let expected = format.read(dir.path(), &NO_SIZE, 1.0).unwrap().rig(dir.path()).unwrap();
        for way in 0..5 {
            let out = tempfile::tempdir().unwrap();
            for name in files.iter().filter(|name| !name.ends_with(".bin")) {
                let text = fs::read_to_string(dir.path().join(name)).unwrap();
                let lines = text.replace('\n', "\r\n");
                let bytes = match way {
                    0 => lines.into_bytes(),
                    1 => [b"\xef\xbb\xbf".to_vec(), lines.into_bytes()].concat(),
                    2 => wide(&lines, [0xff, 0xfe], u16::to_le_bytes),
                    3 => wide(&lines, [0xfe, 0xff], u16::to_be_bytes),
                    _ => text.replace('\n', " \t\r\n").into_bytes(),
                };
                fs::write(out.path().join(name), bytes).unwrap();
            }
            assert_eq!(Format::detect(out.path()), Some(format), "{way}");
            let found =
                format.read(out.path(), &NO_SIZE, 1.0).unwrap_or_else(|error| panic!("{format:?} {way}: {error}"));
            let found = found.rig(out.path()).unwrap();
            assert_eq!(found, expected, "{format:?} {way}");
        }
    }
}
