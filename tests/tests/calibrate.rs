//! Calibration from a printed board: lenses and rig are recovered from images of the board alone.
#![allow(clippy::unwrap_used)] // helpers of tests

use std::path::Path;

use flyrig_calib::{Board, load_calibration, testing::photograph};
use flyrig_tests::run;
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
const SIZE: [u32; 2] = [640, 480];
const BOARDS: u32 = 26;

/// Returns three cameras on an arc of 1 m, each with a different lens.
fn cameras() -> Vec<Camera> {
    [("left", -0.6f64, 610.0), ("middle", 0.0, 640.0), ("right", 0.6, 590.0)]
        .into_iter()
        .map(|(name, angle, focal)| {
            let eye = DVec3::new(angle.sin(), -angle.cos(), 0.65 + 0.1 * angle);
            Camera {
                time_offset_nanos: 0,
                color: Default::default(),
                id: name.into(),
                intrinsics: Intrinsics {
                    width: SIZE[0],
                    height: SIZE[1],
                    focal_px: DVec2::splat(focal),
                    center_px: DVec2::new(322.0, 236.0),
                    lens: Lens::PINHOLE,
                },
                camera_from_world: Isometry::look_at(eye, DVec3::Z * 0.15, DVec3::Z),
            }
        })
        .collect()
}

/// Returns the pose of board `i`: the first lies on the floor, the others are held up, tilted, in all parts of the images.
fn pose(board: &Board, i: u32) -> Isometry {
    let (a, b) = (f64::from(i) * 2.4, f64::from(i) * 1.7);
    // Faces the cameras, which look along y and down.
    let upright = DQuat::from_rotation_x(-2.0);
    let (turn, middle) = if i == 0 {
        (DQuat::from_rotation_x(-std::f64::consts::PI) * DQuat::from_rotation_z(0.1), DVec3::new(0.0, -0.1, 0.0))
    } else {
        let tilt = DQuat::from_rotation_x(0.55 * a.sin()) * DQuat::from_rotation_z(0.6 * b.cos());
        (tilt * upright, DVec3::new(0.24 * b.sin(), 0.2 * a.cos(), 0.18 + 0.12 * (a + b).cos()))
    };
    Isometry::new(turn, middle - turn * board.middle())
}

fn write_take(folder: &Path, board: &Board, cameras: &[Camera]) {
    for camera in cameras {
        let images = folder.join("images").join(camera.id.as_str());
        std::fs::create_dir_all(&images).unwrap();
        for i in 0..BOARDS {
            let gray = photograph(board, camera, &pose(board, i), false).unwrap();
            let image = image::GrayImage::from_raw(SIZE[0], SIZE[1], gray.pixels).unwrap();
            image::DynamicImage::ImageLuma8(image).to_rgb8().save(images.join(format!("{i:06}.png"))).unwrap();
        }
    }
}

#[test]
fn a_printed_board_calibrates_lenses_and_rig() {
    let folder = tempfile::tempdir().unwrap();
    let command = |text: &str| run(PROGRAM, &text.split(' ').collect::<Vec<_>>(), folder.path()).unwrap();
    let printed = command("calibrate board --columns 7 --rows 5 --square-mm 50 --dictionary DICT_4X4_50 --out board");
    assert_eq!(printed.code, Some(0), "{}", printed.stderr);
    let board = Board::load(&folder.path().join("board/board.toml")).unwrap();
    let cameras = cameras();
    write_take(&folder.path().join("take"), &board, &cameras);

    let lenses = command("calibrate lens take --fps 1 --out lenses");
    assert_eq!(lenses.code, Some(0), "{}{}", lenses.stdout, lenses.stderr);
    let rig = command("calibrate rig take --fps 1 --lenses lenses --out calibration --floor");
    assert_eq!(rig.code, Some(0), "{}{}", rig.stdout, rig.stderr);
    assert!(rig.stdout.contains("left and middle share"), "{}", rig.stdout);
    let found = load_calibration(&folder.path().join("calibration"), &|_| None).unwrap();
    for truth in &cameras {
        let camera = found.cameras.iter().find(|camera| camera.id == truth.id).unwrap();
        let focal = (camera.intrinsics.focal_px - truth.intrinsics.focal_px).abs().max_element();
        assert!(focal < 3.0, "{}: focal length off by {focal} px", truth.id);
        let other = |rig: &[Camera]| rig.iter().map(Camera::position).collect::<Vec<_>>();
        for (a, b) in other(&found.cameras).into_iter().zip(other(&cameras)) {
            let distance = (camera.position().distance(a) - truth.position().distance(b)).abs();
            assert!(distance < 0.006, "{}: {distance} m", truth.id);
        }
        let height = camera.position().z - truth.position().z;
        assert!(height.abs() < 0.01, "{}: {height} m above the true height", truth.id);
    }

    // `calibrate live` gives the same result, with hints, from boards in different poses.
    let live = command("calibrate live take --fps 1 --lenses lenses --out live --floor --listen 127.0.0.1:0");
    assert_eq!(live.code, Some(0), "{}{}", live.stdout, live.stderr);
    assert!(live.stderr.contains("progress at http://127.0.0.1:") && live.stderr.contains("next: "), "{}", live.stderr);
    let hinted = load_calibration(&folder.path().join("live"), &|_| None).unwrap();
    for (a, b) in hinted.cameras.iter().zip(&found.cameras) {
        assert!(a.position().distance(b.position()) < 0.004, "{}: {} {}", a.id, a.position(), b.position());
    }

    let page = std::fs::read_to_string(folder.path().join("calibration/calibration.html")).unwrap();
    assert_eq!(page.matches("<svg").count(), 5, "from above, three images, and the boards");
    assert!(
        page.contains("<td>left and middle<td>") && page.contains("two solves from either half of the boards"),
        "{page:.2000}"
    );
    assert!(!page.contains("NaN") && !page.contains("http"), "complete and self-contained");

    // Nothing is overwritten without --force, and each error is one line.
    let again = command("calibrate rig take --fps 1 --lenses lenses --out calibration");
    assert_eq!(again.code, Some(1));
    assert!(again.stderr.contains("calibration.toml is there already; --force replaces it"), "{}", again.stderr);
    let text = std::fs::read_to_string(folder.path().join("board/board.toml")).unwrap();
    std::fs::write(folder.path().join("other.toml"), text.replace("4X4_50", "5X5_100")).unwrap();
    let other = command("calibrate rig take --fps 1 --board other.toml --lenses lenses --out none");
    assert_eq!(other.code, Some(1));
    assert!(other.stderr.contains("camera left: no board in its 26 images"), "{}", other.stderr);
    assert!(!folder.path().join("none").exists());
}
