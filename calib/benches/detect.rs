//! Benchmark of board detection in photographs of 1280x720: run time and detected corners, by pattern.
//!
//!     cargo bench -p flyrig-calib --bench detect [-- IMAGES]

use std::{error::Error, time::Instant};

use flyrig_calib::{Board, GrayImage, Pattern, detector, testing::Random, testing::photograph};
use flyrig_types::{Camera, Intrinsics, Isometry};
use glam::{DQuat, DVec3};
use rayon::prelude::*;

fn main() -> Result<(), Box<dyn Error>> {
    let images: u64 = std::env::args().skip(1).find(|text| text != "--bench").map_or(Ok(200), |text| text.parse())?;
    println!(
        "| board | images | with a board | corners of those | distance from the truth, px | all images s | an image ms |"
    );
    println!("|---|---|---|---|---|---|---|");
    let charuco = Pattern::Charuco { dictionary: "DICT_5X5_100".to_owned(), marker: 0.75 };
    for (name, pattern) in [("chessboard", Pattern::Chessboard), ("ChArUco", charuco)] {
        let board = Board { columns: 9, rows: 6, square_mm: 100.0, pattern };
        row(name, &board, images)?;
    }
    Ok(())
}

fn row(name: &str, board: &Board, images: u64) -> Result<(), Box<dyn Error>> {
    let camera = Camera {
        id: "a".into(),
        intrinsics: Intrinsics::pinhole(1280, 720, 1000.0),
        camera_from_world: Isometry::IDENTITY,
        time_offset_nanos: 0,
        color: Default::default(),
    };
    let taken: Vec<(Isometry, GrayImage)> = (0..images)
        .into_par_iter()
        .map(|seed| {
            let pose = pose(board, &mut Random(seed + 1));
            Ok((pose, photograph(board, &camera, &pose, false)?))
        })
        .collect::<Result<_, String>>()?;
    let finder = detector(board)?;
    let start = Instant::now();
    let found: Vec<_> = taken.par_iter().map(|(_, image)| finder.detect(image)).collect();
    let secs = start.elapsed().as_secs_f64();
    let (mut seen, mut off_px) = (0, Vec::new());
    for ((pose, _), corners) in taken.iter().zip(&found) {
        seen += usize::from(!corners.is_empty());
        for corner in corners {
            let truth = camera.project(pose.transform_point(board.corner(corner.index)));
            off_px.extend(truth.map(|truth| truth.distance(corner.pixel)));
        }
    }
    off_px.sort_by(f64::total_cmp);
    println!(
        "| {name} | {images} | {seen} | {} of {} | {:.3} | {secs:.1} | {:.1} |",
        off_px.len(),
        seen * board.corner_count(),
        off_px.get(off_px.len() / 2).copied().unwrap_or(f64::NAN),
        1e3 * secs / images as f64
    );
    Ok(())
}

/// Returns a random board pose in the image, 1.6 to 3.5 m away and tilted by up to half a radian.
fn pose(board: &Board, random: &mut Random) -> Isometry {
    let mut tilt = || random.between(-0.5, 0.5);
    // The camera looks along z, and so does the back of the board.
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, tilt(), tilt(), tilt());
    let away = random.between(1.6, 3.5);
    let middle = DVec3::new(random.between(-0.3, 0.3), random.between(-0.12, 0.12), 1.0) * away;
    Isometry::new(turn, middle - turn * board.middle())
}
