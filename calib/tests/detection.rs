//! Detection of printed boards: every corner has the right number and position.
#![allow(clippy::unwrap_used)] // helpers of tests

use flyrig_calib::{Board, BoardSheet, GrayImage, Pattern, detector, testing::photograph};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3};

const SIZE: [u32; 2] = [960, 720];
fn charuco(dictionary: &str) -> Board {
    let pattern = Pattern::Charuco { dictionary: dictionary.to_owned(), marker: 0.75 };
    Board { columns: 7, rows: 5, square_mm: 40.0, pattern }
}

fn chessboard() -> Board {
    Board { pattern: Pattern::Chessboard, columns: 8, ..charuco("") }
}

fn camera() -> Camera {
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
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

/// Places the board's centre in front of the camera, turned.
fn pose(board: &Board, turn: DVec3, middle: DVec3) -> Isometry {
    let rotation = DQuat::from_scaled_axis(turn);
    Isometry::new(rotation, middle - rotation * board.middle())
}

/// Returns the number of corners and their largest error, pixels.
fn check(board: &Board, at: &Isometry) -> (usize, f64) {
    let camera = camera();
    let seen = detector(board).unwrap().detect(&photograph(board, &camera, at, false).unwrap());
    let off = |corner: &flyrig_calib::SeenCorner| {
        camera.project(at.transform_point(board.corner(corner.index))).unwrap().distance(corner.pixel)
    };
    let rms = (seen.iter().map(|corner| off(corner).powi(2)).sum::<f64>() / seen.len() as f64).sqrt();
    println!("{} of {} corners, rms {rms:.3} px", seen.len(), board.corner_count());
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
    let image = photograph(&board, &camera(), &at, false).unwrap();
    let seen = |board: &Board, image: &GrayImage| detector(board).unwrap().detect(image).len();
    assert_eq!(seen(&charuco("DICT_6X6_250"), &image), 0, "another dictionary");
    assert_eq!(seen(&board, &photograph(&board, &camera(), &at, true).unwrap()), 0, "mirrored");
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
