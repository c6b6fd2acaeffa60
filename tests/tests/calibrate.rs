//! Calibration from a printed board: lenses and rig are recovered from images of the board alone.
#![allow(clippy::unwrap_used)] // helpers of tests

use std::path::Path;

use flyrig_calib::{Board, load_calibration, load_lenses, testing::photograph};
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
    let order: Vec<Option<u32>> = (0..BOARDS).map(Some).collect();
    cameras.iter().for_each(|camera| write_images(folder, board, camera, &order));
}

/// Writes the images of a camera: the boards of these numbers, or nothing but grey.
fn write_images(folder: &Path, board: &Board, camera: &Camera, order: &[Option<u32>]) {
    let images = folder.join("images").join(camera.id.as_str());
    std::fs::create_dir_all(&images).unwrap();
    for (i, shown) in order.iter().enumerate() {
        let pixels = shown.map(|number| photograph(board, camera, &pose(board, number), false).unwrap().pixels);
        let pixels = pixels.unwrap_or_else(|| vec![128; (SIZE[0] * SIZE[1]) as usize]);
        let image = image::GrayImage::from_raw(SIZE[0], SIZE[1], pixels).unwrap();
        image::DynamicImage::ImageLuma8(image).to_rgb8().save(images.join(format!("{i:06}.png"))).unwrap();
    }
}

/// Asserts that lenses of a folder are those of the cameras with these names, to 3 pixels.
fn assert_lenses(folder: &Path, names: &[&str]) {
    let lenses = load_lenses(folder, &|_| None).unwrap();
    assert_eq!(lenses.iter().map(|(id, _)| id.as_str()).collect::<Vec<_>>(), names);
    for (id, found) in lenses {
        let truth = cameras().into_iter().find(|camera| camera.id == id).unwrap().intrinsics;
        let off = (found.focal_px - truth.focal_px).abs().max_element();
        assert!(off < 3.0, "{id}: focal length off by {off} px");
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

/// Returns the number of boards that a camera shares with the camera of a column of the page's first table.
fn shares(page: &str, camera: &str, column: usize) -> u32 {
    let row = page.split(&format!("<tr><td>{camera}<td>")).nth(1).unwrap().split("<tr>").next().unwrap();
    row.split("</table>").next().unwrap().split("<td>").nth(column).unwrap().parse().unwrap()
}

#[test]
fn cameras_that_no_board_joins_get_their_lenses_and_a_page_that_shows_who_shares_boards() {
    let folder = tempfile::tempdir().unwrap();
    let at = |path: &str| folder.path().join(path);
    let command = |text: &str| run(PROGRAM, &text.split(' ').collect::<Vec<_>>(), folder.path()).unwrap();
    let printed = command("calibrate board --columns 7 --rows 5 --square-mm 50 --dictionary DICT_4X4_50 --out board");
    assert_eq!(printed.code, Some(0), "{}", printed.stderr);
    let board = Board::load(&at("board/board.toml")).unwrap();
    let cameras = cameras();
    // Stills: the board stands where the left and the middle camera see it, then where the right one does.
    let turns: Vec<[Option<u32>; 2]> = (0..BOARDS).flat_map(|i| [[Some(i), None], [None, Some(i)]]).collect();
    for (camera, side) in cameras.iter().zip([0, 0, 1]) {
        let order: Vec<Option<u32>> = turns.iter().map(|turn| turn[side]).collect();
        write_images(&at("apart"), &board, camera, &order);
    }
    write_take(&at("together"), &board, &cameras);
    let failed = |finished: flyrig_tests::Finished, expected: &[&str]| {
        assert_eq!(finished.code, Some(1), "{}", finished.stdout);
        let errors: Vec<&str> = finished.stderr.lines().filter(|line| line.starts_with("error:")).collect();
        assert_eq!(errors.len(), 1, "{}", finished.stderr);
        assert!(expected.iter().all(|part| errors[0].contains(part)), "{}", errors[0]);
        finished.stdout
    };
    let page = |path: &str| std::fs::read_to_string(at(path)).unwrap();

    // Every still is used without any option.
    let apart = command("calibrate rig apart --out cal");
    let groups = "no board joins the groups of cameras [left middle] and [right]; show it between them";
    let stdout =
        failed(apart, &[groups, "cal/calibration.html shows how many boards the cameras share", "--lenses cal/lenses"]);
    assert!(stdout.contains("looked at all 52 frame sets"), "{stdout}");
    assert_lenses(&at("cal/lenses"), &["left", "middle", "right"]);
    assert!(!at("cal/calibration.toml").exists(), "a calibration without poses");
    let shown = page("cal/calibration.html");
    assert!(shown.contains(groups) && !shown.contains("NaN") && !shown.contains("http-equiv"), "{shown:.3000}");
    assert!(
        shares(&shown, "left", 1) >= 8 && shares(&shown, "left", 1) == shares(&shown, "middle", 0),
        "{shown:.3000}"
    );
    let with_right = [("left", 2), ("middle", 2), ("right", 0), ("right", 1)];
    assert!(with_right.iter().all(|(camera, other)| shares(&shown, camera, *other) == 0), "{shown:.3000}");

    // With those lenses and the missing boards the same folder gets its calibration.
    let joined = command("calibrate rig together --lenses cal/lenses --out cal");
    assert_eq!(joined.code, Some(0), "{}", joined.stderr);
    let found = load_calibration(&at("cal"), &|_| None).unwrap();
    assert_eq!(found.cameras.len(), 3);
    assert!(page("cal/calibration.html").contains("From above: cameras"));
    // Lenses that are there are not replaced unasked.
    std::fs::remove_file(at("cal/calibration.toml")).unwrap();
    std::fs::remove_file(at("cal/calibration.json")).unwrap();
    failed(
        command("calibrate rig apart --out cal"),
        &["cal/lenses/calibration.toml is there already; --force replaces it"],
    );

    // A camera that never saw the board: the lenses of the others are kept. Given lenses are not written again.
    let none = vec![None; BOARDS as usize];
    write_images(&at("together"), &board, &cameras[2], &none);
    let unseen = command("calibrate rig together --out unseen");
    failed(unseen, &["camera right: no board in its 26 images", "unseen/lenses holds the lenses of the other cameras"]);
    assert_lenses(&at("unseen/lenses"), &["left", "middle"]);
    assert!(shares(&page("unseen/calibration.html"), "left", 1) >= 8);
    failed(command("calibrate rig together --lenses cal/lenses --out given"), &[groups, "given/calibration.html"]);
    assert!(at("given/calibration.html").exists() && !at("given/lenses").exists());
}
