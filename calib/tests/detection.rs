//! Printed boards, seen by a camera: every corner has the right number and place.
#![allow(clippy::unwrap_used)] // helpers of tests

use flyrig_calib::{Board, BoardSheet, GrayImage, Pattern, detector};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3};

const SIZE: [u32; 2] = [960, 720];
/// Pixels of the scanned sheet a millimetre, and samples along a side of an image's pixel.
const SCAN: f64 = 8.0;
const SAMPLES: i32 = 3;

fn charuco(dictionary: &str) -> Board {
    let pattern = Pattern::Charuco { dictionary: dictionary.to_owned(), marker: 0.75 };
    Board { columns: 7, rows: 5, square_mm: 40.0, pattern }
}

fn chessboard() -> Board {
    Board { pattern: Pattern::Chessboard, columns: 8, ..charuco("") }
}

fn camera() -> Camera {
    Camera {
        id: "00".into(),
        intrinsics: Intrinsics {
            width: SIZE[0],
            height: SIZE[1],
            focal_px: DVec2::splat(800.0),
            center_px: DVec2::new(479.5, 359.5),
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry::IDENTITY,
    }
}

/// Photographs the printed board at `world_from_board`, with noise, on a grey wall.
fn photograph(board: &Board, camera: &Camera, world_from_board: &Isometry, mirrored: bool) -> GrayImage {
    let sheet = BoardSheet::new(board, None).unwrap();
    let [width, height] = sheet.size_mm.map(|mm| (mm * SCAN) as usize);
    let mut scan = vec![235u8; width * height];
    for [x, y, w, h] in &sheet.rectangles {
        let pixels = |from: f64, length: f64| (from * SCAN).round() as usize..((from + length) * SCAN).round() as usize;
        for row in pixels(*y, *h) {
            scan[row * width..][pixels(*x, *w)].fill(20);
        }
    }
    let side_m = 1e-3 * board.square_mm;
    let board_from_world = world_from_board.inverse();
    let origin = board_from_world.transform_point(camera.position());
    let mut state = 1u32;
    let mut pixels = Vec::new();
    for y in 0..SIZE[1] {
        for x in 0..SIZE[0] {
            let mut sum = 0.0;
            for k in 0..SAMPLES * SAMPLES {
                let offset = DVec2::new(f64::from(k % SAMPLES), f64::from(k / SAMPLES)) / f64::from(SAMPLES);
                let at = DVec2::new(f64::from(x), f64::from(y)) + offset - 0.5 + 0.5 / f64::from(SAMPLES);
                let sight = (at - camera.intrinsics.center_px) / camera.intrinsics.focal_px;
                let ray = board_from_world.rotation * sight.extend(1.0);
                let on_board = origin + ray * (-origin.z / ray.z);
                // The first inner corner is a square away from the board's corner.
                let mut mm = (on_board.truncate() + side_m) * 1e3;
                if mirrored {
                    mm.x = f64::from(board.columns) * board.square_mm - mm.x;
                }
                let place = (mm + DVec2::from(sheet.board_at_mm)) * SCAN;
                let inside = place.min_element() >= 0.0 && place.x < width as f64 && place.y < height as f64;
                sum += if inside { f64::from(scan[place.y as usize * width + place.x as usize]) } else { 120.0 };
            }
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = f64::from(state >> 24) / 64.0 - 2.0;
            pixels.push((sum / f64::from(SAMPLES * SAMPLES) + noise).round() as u8);
        }
    }
    GrayImage { width: SIZE[0] as usize, height: SIZE[1] as usize, pixels }
}

/// The board's middle at a place before the camera, turned.
fn pose(board: &Board, turn: DVec3, middle: DVec3) -> Isometry {
    let rotation = DQuat::from_scaled_axis(turn);
    Isometry::new(rotation, middle - rotation * board.middle())
}

/// Number of corners, and the largest distance from the truth, pixels.
fn check(board: &Board, at: &Isometry) -> (usize, f64) {
    let camera = camera();
    let seen = detector(board).unwrap().detect(&photograph(board, &camera, at, false));
    let off = |corner: &flyrig_calib::SeenCorner| {
        camera.project(at.transform_point(board.corner(corner.index))).unwrap().distance(corner.pixel)
    };
    (seen.len(), seen.iter().map(off).fold(0.0, f64::max))
}

#[test]
fn a_charuco_board_is_read_from_its_own_print_in_any_turn() {
    for dictionary in ["DICT_4X4_50", "DICT_5X5_100", "DICT_APRILTAG_36h11"] {
        let board = charuco(dictionary);
        for turn in [
            DVec3::new(0.1, 0.05, 0.02),
            DVec3::new(0.5, 0.3, 0.2),
            DVec3::new(-0.4, 0.5, 1.6),
            DVec3::new(0.2, -0.5, 3.0),
        ] {
            let (count, off) = check(&board, &pose(&board, turn, DVec3::new(0.02, -0.01, 0.55)));
            assert!(count >= board.corner_count() - 2 && off < 0.25, "{dictionary} {turn}: {count} corners, {off} px");
        }
    }
}

#[test]
fn a_part_of_a_charuco_board_is_enough() {
    let board = charuco("DICT_4X4_50");
    let (count, off) = check(&board, &pose(&board, DVec3::new(0.3, 0.2, 0.4), DVec3::new(0.24, 0.1, 0.5)));
    assert!((6..board.corner_count()).contains(&count) && off < 0.25, "{count} corners, {off} px");
}

#[test]
fn a_chessboard_is_numbered_from_the_same_corner_in_any_turn() {
    let board = chessboard();
    for turn in [0.0, 1.5, 3.1, -1.6] {
        let at = pose(&board, DVec3::new(0.25, 0.2, turn), DVec3::new(0.0, 0.0, 0.6));
        let (count, off) = check(&board, &at);
        assert!(count == board.corner_count() && off < 0.25, "{turn}: {count} corners, {off} px");
    }
    // A part of it could be any part.
    let (count, _) = check(&board, &pose(&board, DVec3::ZERO, DVec3::new(0.25, 0.0, 0.5)));
    assert_eq!(count, 0);
}

#[test]
fn what_is_not_the_board_is_not_seen() {
    let board = charuco("DICT_4X4_50");
    let at = pose(&board, DVec3::new(0.2, 0.1, 0.0), DVec3::new(0.0, 0.0, 0.55));
    let image = photograph(&board, &camera(), &at, false);
    let seen = |board: &Board, image: &GrayImage| detector(board).unwrap().detect(image).len();
    assert_eq!(seen(&charuco("DICT_6X6_250"), &image), 0, "another dictionary");
    assert_eq!(seen(&board, &photograph(&board, &camera(), &at, true)), 0, "mirrored");
    for (width, height) in [(1, 1), (0, 0), (7, 300), (640, 480)] {
        let empty = GrayImage { width, height, pixels: vec![90; width * height] };
        assert_eq!(seen(&board, &empty) + seen(&chessboard(), &empty), 0, "{width}x{height}");
    }
}

#[test]
fn descriptions_say_what_is_wrong_with_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("board.toml");
    let load = |text: &str| {
        std::fs::write(&path, text).unwrap();
        Board::load(&path).map_err(|error| error.to_string())
    };
    for board in [charuco("DICT_4X4_50"), chessboard(), Board::default()] {
        assert_eq!(load(&board.to_toml()).unwrap(), board);
    }
    for (text, part) in [
        ("columns = 9\nrows = 7\nsquare_mm = 30.0\npattern = \"chessboard\"\n", "looks the same upside down"),
        ("columns = 2\nrows = 7\nsquare_mm = 30.0\npattern = \"chessboard\"\n", "columns is 2"),
        ("columns = 8\nrows = 7\nsquare_mm = nan\npattern = \"chessboard\"\n", "square_mm is NaN"),
        ("columns = 8\nrows = 7\nsquare_mm = 30.0\npattern = \"stripes\"\n", "stripes"),
        (
            "columns = 9\nrows = 6\nsquare_mm = 30.0\npattern = \"charuco\"\ndictionary = \"DICT_9\"\nmarker = 0.7\n",
            "DICT_9",
        ),
        (
            "columns = 20\nrows = 20\nsquare_mm = 30.0\npattern = \"charuco\"\ndictionary = \"DICT_4X4_50\"\nmarker = 0.7\n",
            "has 50 markers",
        ),
        (
            "columns = 9\nrows = 6\nsquare_mm = 30.0\npattern = \"charuco\"\ndictionary = \"DICT_4X4_50\"\nmarker = 0.1\n",
            "marker is 0.1",
        ),
        ("", "columns"),
    ] {
        let error = load(text).unwrap_err();
        assert!(error.contains("board.toml") && error.contains(part), "{error}");
    }
    assert!(BoardSheet::new(&Board::default(), Some([210.0, 148.0])).unwrap_err().contains("larger paper"));
}

#[test]
fn sheets_have_true_scale() {
    let sheet = BoardSheet::new(&charuco("DICT_4X4_50"), Some([297.0, 420.0])).unwrap();
    let svg = sheet.to_svg();
    assert!(svg.contains("width=\"420mm\" height=\"297mm\" viewBox=\"0 0 420 297\""), "{}", &svg[..200]);
    let pdf = sheet.to_pdf();
    assert!(pdf.starts_with(b"%PDF-"));
    let text = String::from_utf8_lossy(&pdf);
    // 420 x 297 mm in points of 1/72 inch.
    assert!(text.contains("/MediaBox [0 0 1190.551") && text.contains("841.889"), "{text}");
}
