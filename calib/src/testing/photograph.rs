//! Simulated photographs of printed boards.

use flyrig_types::{Camera, Isometry};
use glam::DVec2;

use crate::board::Board;
use crate::detect::GrayImage;
use crate::print::BoardSheet;

/// Resolution of the scanned sheet, pixels per millimetre, and samples along a side of an image's pixel.
const SCAN: f64 = 8.0;
const SAMPLES: i32 = 3;
/// Grey levels of paper, ink and wall; amplitude of the noise.
const PAPER: u8 = 235;
const INK: u8 = 20;
const WALL: f64 = 120.0;
const NOISE: f64 = 2.0;

/// Photographs the printed board at `world_from_board` with a camera without distortion, optionally mirrored.
///
/// # Errors
/// As [`Board::check`].
pub fn photograph(
    board: &Board,
    camera: &Camera,
    world_from_board: &Isometry,
    mirrored: bool,
) -> Result<GrayImage, String> {
    let sheet = BoardSheet::new(board, None)?;
    let [width, height] = sheet.size_mm.map(|mm| (mm * SCAN) as usize);
    let mut scan = vec![PAPER; width * height];
    for [x, y, w, h] in &sheet.rectangles {
        let pixels = |from: f64, length: f64| (from * SCAN).round() as usize..((from + length) * SCAN).round() as usize;
        for row in pixels(*y, *h) {
            scan[row * width..][pixels(*x, *w)].fill(INK);
        }
    }
    let side_m = 1e-3 * board.square_mm;
    let board_from_world = world_from_board.inverse();
    let origin = board_from_world.transform_point(camera.position());
    let world_from_camera = camera.camera_from_world.rotation.inverse();
    let mut state = 1u32;
    let [columns, rows] = camera.size();
    let mut pixels = Vec::new();
    for y in 0..rows {
        for x in 0..columns {
            let mut sum = 0.0;
            for k in 0..SAMPLES * SAMPLES {
                let part = DVec2::new(f64::from(k % SAMPLES), f64::from(k / SAMPLES)) + 0.5;
                let at = DVec2::new(f64::from(x), f64::from(y)) + part / f64::from(SAMPLES) - 0.5;
                let sight = (at - camera.intrinsics.center_px) / camera.intrinsics.focal_px;
                let ray = board_from_world.rotation * (world_from_camera * sight.extend(1.0));
                let distance = -origin.z / ray.z;
                // The first inner corner is a square away from the board's corner.
                let mut mm = ((origin + ray * distance).truncate() + side_m) * 1e3;
                if mirrored {
                    mm.x = f64::from(board.columns) * board.square_mm - mm.x;
                }
                let place = (mm + DVec2::from(sheet.board_at_mm)) * SCAN;
                // The back of the sheet, and what lies behind the camera, shows no board.
                let is_front = distance > 0.0 && ray.z > 0.0;
                let inside = place.min_element() >= 0.0 && place.x < width as f64 && place.y < height as f64;
                let paper = || f64::from(scan[place.y as usize * width + place.x as usize]);
                sum += if is_front && inside { paper() } else { WALL };
            }
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = (f64::from(state >> 16) / 32_768.0 - 1.0) * NOISE;
            pixels.push((sum / f64::from(SAMPLES * SAMPLES) + noise).round() as u8);
        }
    }
    Ok(GrayImage { width: columns as usize, height: rows as usize, pixels })
}
