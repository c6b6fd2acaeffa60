//! Calibrations from images and of motion capture as other programs save them: every key of a lens, every state of a file.
#![allow(clippy::unwrap_used)] // helpers of tests

mod support;

use std::{fs, path::Path};

use flyrig_calib::Format;
use flyrig_types::{Lens, Rig};
use glam::DVec3;
use support::{FISHEYE, File, RADIAL, folder, names, read, refused, rig};

// transforms.json

fn frame(image: &str, x: f64, more: &str) -> String {
    format!(
        r#"{{"file_path": "{image}", "transform_matrix": [[1, 0, 0, {x}], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]], "fl_x": 500, "fl_y": 510, "cx": 320.5,
        "cy": 240.5, "w": 640, "h": 480 {more}}}"#
    )
}

fn transforms(root: &str, frames: &[String]) -> String {
    format!(r#"{{ {root} "frames": [{}] }}"#, frames.join(", "))
}

#[test]
fn every_key_of_a_lens_in_transforms_is_heeded_or_named() {
    let k = r#", "k1": 0.05, "k2": -0.02, "k3": 0.006, "k4": 0.001"#;
    let lens =
        |text: &str| read(Format::Nerfstudio, &[("transforms.json", text.as_bytes())]).unwrap().lenses()[0].1.lens;
    let of_frame = |more: &str| transforms("", &[frame("images/a.png", 0.0, &format!("{k}{more}"))]);
    for text in [
        of_frame(r#", "is_fisheye": true"#),
        of_frame(r#", "is_fisheye": 1"#),
        of_frame(r#", "camera_model": "OPENCV_FISHEYE", "is_fisheye": true"#),
        transforms(r#""is_fisheye": true,"#, &[frame("images/a.png", 0.0, k)]),
        transforms(
            r#""camera_model": "OPENCV", "is_fisheye": false,"#,
            &[frame("images/a.png", 0.0, &format!(r#"{k}, "camera_model": "OPENCV_FISHEYE", "is_fisheye": true"#))],
        ),
    ] {
        assert_eq!(lens(&text), FISHEYE, "{text}");
    }
    let rational = Lens::Rational { radial: [0.05, -0.02, 0.006, 0.001, 0.2, 0.3], tangential: [0.0; 2] };
    assert_eq!(lens(&of_frame(r#", "camera_model": "FULL_OPENCV", "k5": 0.2, "k6": 0.3"#)), rational);
    // Flags that say nothing are no reason to refuse.
    assert_eq!(
        lens(&of_frame(r#", "is_fisheye": true, "latlong": false, "rolling_shutter": [0, 0, 0, 0], "sharpness": 3"#)),
        FISHEYE
    );
    for (more, word) in [
        (r#", "is_fisheye": false"#, "k4 = 0.001"),
        (r#", "is_fisheye": "yes""#, "is_fisheye is neither"),
        (r#", "is_fisheye": true, "camera_model": "OPENCV""#, "contradict each other"),
        (r#", "is_fisheye": true, "p1": 0.1"#, "p1 = 0.1"),
        (r#", "camera_model": "OPENCV_FISHEYE", "k5": 0.1"#, "k5 = 0.1"),
        (r#", "camera_model": "FISHEYE624""#, "camera_model FISHEYE624 is not supported"),
        (r#", "camera_model": "EQUIRECTANGULAR""#, "camera_model EQUIRECTANGULAR is not supported"),
        (r#", "camera_model": 7"#, "camera_model is no word"),
        (r#", "ftheta_p0": 1.5"#, "\"ftheta_p0\" is not understood"),
        (r#", "latlong": true"#, "\"latlong\" is not understood"),
        (r#", "equirectangular": 1"#, "\"equirectangular\" is not understood"),
        (r#", "distortion_params": [1]"#, "\"distortion_params\" is not understood"),
        (r#", "camera_convention": "opencv""#, "\"camera_convention\" is not understood"),
        (r#", "k1": "a lot""#, "k1 is missing or no number"),
        (r#", "is_fisheye": true, "transform_matrix_end": [[1]]"#, "transform_matrix_end differs"),
    ] {
        refused(Format::Nerfstudio, "transforms.json", &of_frame(more), &[word]);
    }
    for (root, word) in [
        (r#""from_na": true,"#, "\"from_na\""),
        (r#""normal_mts_args": {},"#, "\"normal_mts_args\""),
        (r#""units": "mm","#, "\"units\""),
        (r#""up": [0, 0, 0],"#, "up is not a direction"),
        (r#""is_fisheye": true,"#, "is_fisheye with k1 to k4 of 0"),
    ] {
        refused(Format::Nerfstudio, "transforms.json", &transforms(root, &[frame("a.png", 0.0, "")]), &[word]);
    }
}

#[test]
fn angles_of_view_and_the_up_direction_of_transforms_are_read() {
    let plain = transforms(r#""up": [0, 2, 0], "applied_scale": 0.5,"#, &[frame("images/a.png", 0.0, "")]);
    let expected = rig(Format::Nerfstudio, &[("transforms.json", plain.as_bytes())]);
    assert_eq!(expected.world_up, DVec3::Y);
    let [x, y] = [320.0f64 / 500.0, 240.0 / 510.0].map(|tan| 2.0 * tan.atan());
    let degrees = format!(r#""x_fov": {}, "y_fov": {}"#, x.to_degrees(), y.to_degrees());
    for angles in [format!(r#""camera_angle_x": {x}, "camera_angle_y": {y}"#), degrees] {
        let text = plain.replace(r#""fl_x": 500, "fl_y": 510"#, &angles);
        let found = rig(Format::Nerfstudio, &[("transforms.json", text.as_bytes())]);
        let focal = |rig: &Rig| rig.cameras[0].intrinsics.focal_px;
        assert!(focal(&found).distance(focal(&expected)) < 1e-9, "{angles}: {}", focal(&found));
    }
    // Blender's sets have one angle, no centre, and the size of their images.
    let bare = plain
        .replace(r#""fl_x": 500, "fl_y": 510"#, &format!(r#""camera_angle_x": {x}"#))
        .replace("\"cx\": 320.5,", "")
        .replace("\"cy\": 240.5, \"w\": 640, \"h\": 480", "\"z\": 0");
    let dir = folder(&[("transforms.json", bare.as_bytes())]);
    let found = Format::Nerfstudio.read(dir.path(), &|_| Some((640, 480)), 1.0).unwrap().lenses()[0].1;
    assert!(
        found.focal_px.distance(glam::DVec2::splat(500.0)) < 1e-9 && found.center_px == glam::DVec2::new(319.5, 239.5),
        "{found:?}"
    );
    refused(Format::Nerfstudio, "transforms.json", &bare, &["w or h is missing", "--images"]);
}

#[test]
fn cameras_are_named_by_what_tells_their_images_apart() {
    let shots = |images: &[(&str, f64)]| -> Result<Vec<String>, String> {
        let frames: Vec<String> = images.iter().map(|(image, x)| frame(image, *x, "")).collect();
        let text = transforms("", &frames);
        let imported = read(Format::Nerfstudio, &[("transforms.json", text.as_bytes())])?;
        Ok(imported.cameras.iter().map(|camera| camera.id.to_string()).collect())
    };
    for (images, expected) in [
        (&[("rgb/cam00.png", 0.0), ("rgb/cam01.png", 1.0)][..], &["cam00", "cam01"][..]),
        (&[("frame_000000/cam00.png", 0.0), ("frame_000000/cam01.png", 1.0)], &["cam00", "cam01"]),
        (
            &[("f_0/cam00.png", 0.0), ("f_0/cam01.png", 1.0), ("f_1/cam00.png", 0.0), ("f_1/cam01.png", 1.0)],
            &["cam00", "cam01"],
        ),
        (&[("shot/cam00.png", 0.0), ("shot/cam01.png", 1.0)], &["cam00", "cam01"]),
        (&[(r"rgb\\cam00.png", 0.0), (r"rgb\\cam01.png", 1.0)], &["cam00", "cam01"]),
        (&[("cam00/0001.png", 0.0), ("cam01/0001.png", 1.0)], &["cam00", "cam01"]),
        (&[("cam00/0001.png", 0.0), ("cam00/0002.png", 0.0), ("cam01/0001.png", 1.0)], &["cam00", "cam01"]),
        (&[("cam00/rgb/0001.png", 0.0), ("cam01/rgb/0001.png", 1.0)], &["cam00", "cam01"]),
        (&[("image_00/0001.png", 0.0), ("image_01/0001.png", 1.0)], &["image_00", "image_01"]),
        (&[("take/rgb/front.jpg", 0.0)], &["front"]),
    ] {
        assert_eq!(shots(images).unwrap(), expected, "{images:?}");
    }
    // A camera that was moved is none.
    for images in [&[("a/0.png", 0.0), ("a/1.png", 1.0)][..], &[("a/0.png", 0.0), ("a/1.png", 1.0), ("b/2.png", 2.0)]] {
        let error = shots(images).unwrap_err();
        assert!(error.contains("frame 1: camera a has two poses; give one image of each camera"), "{error}");
    }
}

// COLMAP

fn binary(cameras: &[(u32, u32, [u64; 2], Vec<f64>)], images: &[(u32, [f64; 7], u32, &str, u64)]) -> [Vec<u8>; 2] {
    let mut files = [(cameras.len() as u64).to_le_bytes().to_vec(), (images.len() as u64).to_le_bytes().to_vec()];
    for (id, model, size, parameters) in cameras {
        files[0].extend(id.to_le_bytes().into_iter().chain(model.to_le_bytes()));
        files[0].extend(size.iter().flat_map(|side| side.to_le_bytes()));
        files[0].extend(parameters.iter().flat_map(|value| value.to_le_bytes()));
    }
    for (id, pose, camera, name, points) in images {
        files[1].extend(id.to_le_bytes());
        files[1].extend(pose.iter().flat_map(|value| value.to_le_bytes()));
        files[1].extend(camera.to_le_bytes());
        files[1].extend(name.bytes().chain([0]).chain(points.to_le_bytes()));
        files[1].extend(vec![7; 24 * usize::try_from(*points).unwrap()]);
    }
    files
}

fn model() -> [Vec<u8>; 2] {
    let turned = [0.5f64.sqrt(), 0.5f64.sqrt(), 0.0, 0.0, 0.0, 0.0, 4.0];
    let straight = [1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0];
    binary(
        &[
            (3, 4, [640, 480], vec![500.0, 510.0, 320.5, 240.5, 0.05, -0.02, 0.006, 0.001]),
            (9, 5, [800, 600], vec![400.0, 410.0, 400.5, 300.5, 0.05, -0.02, 0.006, 0.001]),
        ],
        &[
            (1, turned, 3, "frame_0/front view.png", 2),
            (2, straight, 9, "frame_0/side.png", 0),
            (5, straight, 9, "frame_1/side.png", 1),
        ],
    )
}

#[test]
fn a_binary_model_is_recognised_and_read() {
    let [cameras, images] = model();
    let files: [File<'_>; 4] =
        [("cameras.bin", &cameras), ("images.bin", &images), ("points3D.bin", &[0; 8]), ("rigs.bin", &[0; 8])];
    let expected = rig(Format::Colmap, &files);
    assert_eq!(names(&expected), ["front view", "side"]);
    let front = &expected.cameras[0];
    assert_eq!((front.size(), front.intrinsics.lens), ([640, 480], RADIAL));
    assert_eq!(front.intrinsics.center_px, glam::DVec2::new(320.0, 240.0));
    // Half a root twice: a quarter turn about x takes z up to y down.
    assert!(front.camera_from_world.transform_point(DVec3::Z).distance(DVec3::new(0.0, -1.0, 4.0)) < 1e-9);
    assert_eq!(expected.cameras[1].intrinsics.lens, FISHEYE);
    assert_eq!(expected.cameras[1].camera_from_world.translation, DVec3::new(1.0, 2.0, 3.0));
    // The same as text, in a workspace, and as it is written again.
    let text = "1 0.7071067811865476 0.7071067811865476 0 0 0 0 4 3 frame_0/front view.png\r\n1 2 -1 3 4 5\r\n2 1 0 0 0 1 2 3 9 frame_0/side.png\r\n\r\n";
    let lenses = "3 OPENCV 640 480 500 510 320.5 240.5 0.05 -0.02 0.006 0.001\n9 OPENCV_FISHEYE 800 600 400 410 400.5 300.5 0.05 -0.02 0.006 0.001\n";
    let as_text = rig(Format::Colmap, &[("cameras.txt", lenses.as_bytes()), ("images.txt", text.as_bytes())]);
    let workspace = rig(
        Format::Colmap,
        &[("sparse/0/cameras.bin", &cameras), ("sparse/0/images.bin", &images), ("images/x.txt", b"")],
    );
    let out = tempfile::tempdir().unwrap();
    let written = Format::Colmap.write(out.path(), &expected).unwrap();
    assert_eq!(written, ["cameras.txt", "images.txt", "points3D.txt", "cameras.bin", "images.bin", "points3D.bin"]);
    let back = |keep: &str| {
        let files = written.iter().filter(|name| name.ends_with(keep));
        let files: Vec<(String, Vec<u8>)> =
            files.map(|name| (name.clone(), fs::read(out.path().join(name)).unwrap())).collect();
        let files: Vec<File<'_>> = files.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())).collect();
        rig(Format::Colmap, &files)
    };
    for other in [as_text, workspace, back(".txt"), back(".bin"), back("")] {
        assert_eq!(names(&other), names(&expected));
        for (a, b) in other.cameras.iter().zip(&expected.cameras) {
            assert_eq!((a.intrinsics.lens, a.size()), (b.intrinsics.lens, b.size()));
            assert!(
                a.project(DVec3::new(0.3, 9.0, 5.0))
                    .map(|p| p.distance(b.project(DVec3::new(0.3, 9.0, 5.0)).unwrap()))
                    .is_none_or(|d| d < 1e-9)
            );
        }
    }
    let other = lenses.replace("500 510", "501 510");
    let error = read(
        Format::Colmap,
        &[
            ("cameras.bin", &cameras),
            ("images.bin", &images),
            ("cameras.txt", other.as_bytes()),
            ("images.txt", text.as_bytes()),
        ],
    );
    assert!(error.unwrap_err().contains("take the older one out"));
}

#[test]
fn damaged_models_are_named_whatever_they_promise() {
    let [cameras, images] = model();
    let check = |cameras: &[u8], images: &[u8], word: &str| {
        let error = read(Format::Colmap, &[("cameras.bin", cameras), ("images.bin", images)]).unwrap_err();
        assert!(error.contains(word) && error.contains("model_converter"), "{word}: {error}");
    };
    let with = |bytes: &[u8], at: usize, value: &[u8]| [&bytes[..at], value, &bytes[at + value.len()..]].concat();
    check(&[], &images, "cameras.bin: is cut off");
    for length in 0..cameras.len() {
        check(&cameras[..length], &images, "cameras.bin: is cut off");
    }
    for length in 0..images.len() {
        check(&cameras, &images[..length], "images.bin: is cut off");
    }
    check(&with(&cameras, 0, &[0xff; 8]), &images, "is cut off, or holds a wrong count");
    check(&[cameras.clone(), vec![0]].concat(), &images, "1 bytes after its last entry");
    check(&with(&cameras, 12, &7u32.to_le_bytes()), &images, "camera model FOV");
    check(&with(&cameras, 12, &u32::MAX.to_le_bytes()), &images, "camera model 4294967295 is not known");
    check(&with(&cameras, 32, &f64::NAN.to_le_bytes()), &images, "holds NaN");
    check(&cameras, &with(&images, 12, &f64::INFINITY.to_le_bytes()), "holds inf");
    check(&cameras, &with(&images, 12, &2.0f64.to_le_bytes()), "image 1: the quaternion has length");
    check(&cameras, &with(&images, 68, &4u32.to_le_bytes()), "image 1: camera 4 is not in cameras.bin");
    let name = 72 + "frame_0/front view.png".len() + 1;
    check(&cameras, &with(&images, name, &[0xff; 8]), "is cut off, or holds a wrong count");
    check(&cameras, &with(&images, 72, &[0xff]), "a name that is not UTF-8");
    let long = [&images[..72], &vec![b'x'; 10_000][..]].concat();
    check(&cameras, &long, "a name of more than 4096 bytes");
    let huge = with(&cameras, 16, &u64::MAX.to_le_bytes());
    let error = read(Format::Colmap, &[("cameras.bin", &huge), ("images.bin", &images)]).unwrap_err();
    assert!(error.contains("image width"), "{error}");
    // Whatever else changes, the result is an error or valid cameras.
    let mut state = 1u64;
    let mut random = move |most: usize| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % most
    };
    for _ in 0..1000 {
        let mut files = [cameras.clone(), images.clone()];
        for _ in 0..1 + random(3) {
            let file = &mut files[random(2)];
            let at = random(file.len());
            file[at] = u8::try_from(random(256)).unwrap();
        }
        if let Ok(imported) = read(Format::Colmap, &[("cameras.bin", &files[0]), ("images.bin", &files[1])]) {
            let rig = imported.rig(Path::new("x")).unwrap().unwrap();
            assert!(rig.cameras.iter().all(|camera| camera.validate().is_ok()));
        }
    }
    // Text whose images have no lines of points would lose every second camera.
    let lens = "1 PINHOLE 640 480 500 500 320 240\n";
    let missing = "1 1 0 0 0 0 0 0 1 a.png\n2 1 0 0 0 0 0 1 1 b.png\n";
    let error =
        read(Format::Colmap, &[("cameras.txt", lens.as_bytes()), ("images.txt", missing.as_bytes())]).unwrap_err();
    assert!(error.contains("line 2: expected the points of the image above"), "{error}");
}

// Qualisys, anipose, mrcal

const QUALISYS: &str = r#"<?xml version="1.0"?><calibration type="regular"><cameras>
    <camera active="1" calibrated="true" serial="26580" model="Miqus Video" viewrotation="0" video_resolution="1080p">
    <fov_video_max left="0" top="0" right="640" bottom="480"/><fov_video left="0" top="0" right="640" bottom="480"/>
    <transform x="0" y="-4000" z="0" r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0"/>
    <intrinsic focallength="9.2" sensorMinU="0.0" sensorMaxU="40959.0" sensorMinV="0" sensorMaxV="30719.0" focalLengthU="64000"
    focalLengthV="64000" centerPointU="20480" centerPointV="15360" skew="0" radialDistortion1="0" radialDistortion2="0"
    radialDistortion3="0" tangentalDistortion1="0" tangentalDistortion2="0"/></camera></cameras></calibration>"#;

#[test]
fn the_field_of_view_of_qualisys_is_heeded_and_its_other_keys_named() {
    let camera = |text: &str| rig(Format::Qualisys, &[("a.qca.txt", text.as_bytes())]).cameras[0].intrinsics;
    assert_eq!((camera(QUALISYS).width, camera(QUALISYS).center_px), (640, glam::DVec2::new(319.5, 239.5)));
    let cropped =
        QUALISYS.replace(r#"<fov_video left="0" top="0" right="640""#, r#"<fov_video left="100" top="20" right="500""#);
    assert_eq!((camera(&cropped).width, camera(&cropped).height), (400, 460));
    assert_eq!(camera(&cropped).center_px, glam::DVec2::new(219.5, 219.5));
    // Other versions say the last pixel.
    let last = cropped
        .replace("right=\"640\"", "right=\"639\"")
        .replace("right=\"500\"", "right=\"499\"")
        .replace("bottom=\"480\"", "bottom=\"479\"");
    assert_eq!(camera(&last), camera(&cropped));
    // The sensor ends at the first or at the last 64th of its last pixel.
    let first = last.replace("40959.0", "40896.000000").replace("30719.000000", "30656").replace("30719.0", "30656");
    assert_ne!(first, last);
    assert_eq!(camera(&first), camera(&last));
    for (from, to, word) in [
        ("skew=\"0\"", "skew=\"64\"", "skew is 64"),
        ("viewrotation=\"0\"", "viewrotation=\"90\"", "viewrotation is 90"),
        ("calibrated=\"true\"", "calibrated=\"false\"", "calibrated is not true"),
        ("sensorMaxU=\"40959.0\"", "sensorMaxU=\"639\"", "not in 64ths of a pixel"),
        ("right=\"640\"", "right=\"320\"", "fov_video"),
        ("radialDistortion3", "radialDistortion4=\"0.1\" radialDistortion3", "\"radialDistortion4\" is not understood"),
        ("skew=\"0\"", "skew=\"0\" lensModel=\"fisheye\"", "\"lensModel\" is not understood"),
        ("focalLengthU=\"64000\"", "focalLengthU=\"nan\"", "focalLengthU is missing or no number"),
        ("<transform", "<fisheye_lens/><transform", "\"fisheye_lens\" is not understood"),
        ("type=\"regular\"", "units=\"m\"", "\"units\" is not understood"),
    ] {
        assert!(QUALISYS.contains(from), "{from}");
        refused(Format::Qualisys, "a.qca.txt", &QUALISYS.replace(from, to), &["camera 26580", word]);
    }
}

#[test]
fn keys_of_anipose_and_mrcal_are_heeded_or_named() {
    let anipose = "[cam_0]\nname = \"a\"\nsize = [640, 480]\nmatrix = [[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]\ndistortions = [0.05, -0.02, 0.006, \
        0.001]\nrotation = [0.1, 0.0, 0.0]\ntranslation = [1.0, 2.0, 3.0]\n";
    let lens = |text: &str| read(Format::Anipose, &[("anipose.toml", text.as_bytes())]).unwrap().lenses()[0].1.lens;
    assert_eq!(lens(anipose), RADIAL);
    assert_eq!(lens(&format!("{anipose}fisheye = true\n")), FISHEYE);
    assert_eq!(lens(&format!("{anipose}fisheye = 1\n")), FISHEYE);
    assert_eq!(lens(&anipose.replace("[0.05, -0.02, 0.006, 0.001]", "[[0.05, -0.02, 0.006, 0.001]]")), RADIAL);
    for (more, word) in [
        ("fisheye = \"yes\"\n", "fisheye is \"yes\""),
        ("camera_model = \"omni\"\n", "\"camera_model\" is not understood"),
        ("units = \"mm\"\n", "\"units\" is not understood"),
        ("[cam_1]\nsize = [640, 480]\n", "camera cam_1: matrix is missing"),
        ("[metadata]\nworld_axes = \"y up\"\n", "\"world_axes\" is not understood"),
    ] {
        refused(Format::Anipose, "anipose.toml", &format!("{anipose}{more}"), &[word]);
    }
    let turned =
        read(Format::Anipose, &[("anipose.toml", format!("{anipose}rotation_count = 1\n").as_bytes())]).unwrap();
    assert!(turned.warnings[0].contains("rotation_count turns images for display"), "{:?}", turned.warnings);

    let mrcal = "{ 'distortion_model': 'DISTORTION_OPENCV4', 'intrinsics': [500, 510, 320, 240, 0.05, -0.02, 0.006, 0.001], 'extrinsics': [0, 0, 0, 0, 0, 4],\n\
        'imagersize': [640, 480], 'icam_intrinsics': 0 }";
    let lens = |text: &str| read(Format::Mrcal, &[("a.cameramodel", text.as_bytes())]).unwrap().lenses()[0].1.lens;
    assert_eq!(lens(mrcal), RADIAL);
    for (from, to, word) in [
        ("DISTORTION_OPENCV4", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3", "LENSMODEL_SPLINED"),
        ("'icam_intrinsics'", "'units'", "\"units\" is not understood"),
        ("'icam_intrinsics'", "'rt_ref_cam'", "extrinsics"),
    ] {
        let text =
            mrcal.replace(from, to).replace("'extrinsics'", if to == "'rt_ref_cam'" { "'rt'" } else { "'extrinsics'" });
        refused(Format::Mrcal, "a.cameramodel", &text, &[word]);
    }
}
