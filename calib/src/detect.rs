//! Detection of boards in images, through the crates `calib-targets-*`.

use calib_targets_charuco::{CharucoBoardSpec, CharucoDetector, CharucoParams};
use calib_targets_chessboard::{
    ChessboardDetector, ChessboardParams, DetectorConfig, GrayImageView, default_chess_config, detect_corner_frame,
};
use calib_targets_core::ImageRefiner;
use flyrig_types::{Image, PixelFormat};
use glam::DVec2;

use crate::board::{Board, Pattern};

/// Fewest corners at which a partly visible board is used.
const LEAST_CORNERS: usize = 6;

/// Smallest side of an image that can show a board, pixels.
const LEAST_SIDE: usize = 32;

/// Inner corner of a board in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenCorner {
    /// Number of the corner, see [`Board::corner`].
    pub index: usize,
    /// Pixel; pixel centres are at integers.
    pub pixel: DVec2,
}

/// Detector of a board in images.
pub trait BoardDetector: Send + Sync {
    /// Returns the detected corners, in ascending order; none where no board is recognised.
    fn detect(&self, gray: &GrayImage) -> Vec<SeenCorner>;
}

/// 8-bit grey image.
#[derive(Debug, Clone, PartialEq)]
pub struct GrayImage {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Pixels, row by row.
    pub pixels: Vec<u8>,
}

impl GrayImage {
    /// Converts a decoded image to grey; `None` for compressed and raw sensor formats.
    #[must_use]
    pub fn of(image: &Image) -> Option<Self> {
        let bytes = image.bytes();
        let luma = |r: u8, g: u8, b: u8| ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b)) >> 8) as u8;
        let pixels: Vec<u8> = match image.format() {
            PixelFormat::Rgb8 => bytes.chunks_exact(3).map(|p| luma(p[0], p[1], p[2])).collect(),
            PixelFormat::Bgr8 => bytes.chunks_exact(3).map(|p| luma(p[2], p[1], p[0])).collect(),
            _ => return None,
        };
        let (width, height) = (image.width() as usize, image.height() as usize);
        (pixels.len() == width * height).then_some(Self { width, height, pixels })
    }

    /// Returns whether the image is large enough to show a board and complete: the detectors check neither.
    fn is_usable(&self) -> bool {
        self.width.min(self.height) >= LEAST_SIDE && self.pixels.len() == self.width * self.height
    }

    fn view(&self) -> GrayImageView<'_> {
        GrayImageView { width: self.width, height: self.height, data: &self.pixels }
    }

    /// Returns the bilinear brightness at a pixel; `None` outside.
    fn at(&self, pixel: DVec2) -> Option<f64> {
        let base = pixel.floor();
        let inside =
            base.x >= 0.0 && base.y >= 0.0 && base.x + 1.0 < self.width as f64 && base.y + 1.0 < self.height as f64;
        if !inside {
            return None;
        }
        let (x, y, part) = (base.x as usize, base.y as usize, pixel - base);
        let value = |x: usize, y: usize| f64::from(self.pixels[y * self.width + x]);
        let row = |y| value(x, y) * (1.0 - part.x) + value(x + 1, y) * part.x;
        Some(row(y) * (1.0 - part.y) + row(y + 1) * part.y)
    }
}

/// Returns the detector for a board.
///
/// # Errors
/// As [`Board::check`].
pub fn detector(board: &Board) -> Result<Box<dyn BoardDetector>, String> {
    board.check()?;
    match &board.pattern {
        Pattern::Chessboard => {
            let detector = ChessboardDetector::new(ChessboardParams::default()).map_err(|error| error.to_string())?;
            Ok(Box::new(Chessboard { board: board.clone(), detector }))
        }
        Pattern::Charuco { dictionary, marker } => {
            let spec = CharucoBoardSpec::new(
                board.rows,
                board.columns,
                board.square_mm as f32,
                *marker as f32,
                crate::dictionary::dictionary(dictionary)?,
            );
            let mut params = CharucoParams::for_board(spec);
            params.chess = corner_config();
            let detector = CharucoDetector::new(params).map_err(|error| error.to_string())?;
            Ok(Box::new(Charuco { detector }))
        }
    }
}

/// Returns the settings of the corner refinement. Corners are saddle points of the brightness: on sharp images twice as
/// accurate as the detector's own centres of mass.
fn corner_config() -> DetectorConfig {
    default_chess_config().with_refiner(ImageRefiner::saddle_point())
}

struct Charuco {
    detector: CharucoDetector,
}

impl BoardDetector for Charuco {
    fn detect(&self, gray: &GrayImage) -> Vec<SeenCorner> {
        if !gray.is_usable() {
            return Vec::new();
        }
        let Ok(found) = self.detector.detect(&gray.view()) else { return Vec::new() };
        let corners = found.corners.iter().map(|corner| SeenCorner {
            index: corner.id as usize,
            pixel: DVec2::new(f64::from(corner.position.x), f64::from(corner.position.y)),
        });
        sorted(corners.collect())
    }
}

struct Chessboard {
    board: Board,
    detector: ChessboardDetector,
}

impl BoardDetector for Chessboard {
    fn detect(&self, gray: &GrayImage) -> Vec<SeenCorner> {
        if !gray.is_usable() {
            return Vec::new();
        }
        let frame = detect_corner_frame(&gray.view(), &corner_config());
        let Some(found) = self.detector.detect(&frame.corners) else { return Vec::new() };
        let labelled: Vec<([i32; 2], DVec2)> = found
            .corners
            .iter()
            .map(|c| ([c.grid.u, c.grid.v], DVec2::new(f64::from(c.position.x), f64::from(c.position.y))))
            .collect();
        sorted(self.oriented(&labelled, gray).unwrap_or_default())
    }
}

impl Chessboard {
    /// Numbers the corners of a whole board so that the square at its top left is black.
    fn oriented(&self, labelled: &[([i32; 2], DVec2)], gray: &GrayImage) -> Option<Vec<SeenCorner>> {
        let [across, down] = self.board.inner().map(|n| n as i32);
        if labelled.len() != self.board.corner_count() {
            return None;
        }
        // The four turns of the labels; two of them fit the board's sides, and one its colours.
        let turns: [fn([i32; 2]) -> [i32; 2]; 4] =
            [|[u, v]| [u, v], |[u, v]| [v, -u], |[u, v]| [-u, -v], |[u, v]| [-v, u]];
        turns.into_iter().find_map(|turn| {
            let turned: Vec<([i32; 2], DVec2)> = labelled.iter().map(|(at, pixel)| (turn(*at), *pixel)).collect();
            let least = |k: usize| turned.iter().map(|(at, _)| at[k]).min();
            let (u0, v0) = (least(0)?, least(1)?);
            let mut places = vec![None; labelled.len()];
            for ([u, v], pixel) in turned {
                let (u, v) = (u - u0, v - v0);
                if u >= across || v >= down {
                    return None;
                }
                places[(v * across + u) as usize] = Some(pixel);
            }
            let places: Vec<DVec2> = places.into_iter().collect::<Option<_>>()?;
            self.is_black_first(&places, gray)
                .then(|| places.iter().enumerate().map(|(index, &pixel)| SeenCorner { index, pixel }).collect())
        })
    }

    /// Returns whether the squares whose numbers have an even sum are the dark ones.
    fn is_black_first(&self, places: &[DVec2], gray: &GrayImage) -> bool {
        let [across, down] = self.board.inner().map(|n| n as usize);
        let (mut even, mut odd) = ((0.0, 0.0), (0.0, 0.0));
        for v in 0..down - 1 {
            for u in 0..across - 1 {
                let at = |u: usize, v: usize| places[v * across + u];
                let middle = 0.25 * (at(u, v) + at(u + 1, v) + at(u, v + 1) + at(u + 1, v + 1));
                let Some(value) = gray.at(middle) else { continue };
                // The square below and right of the first inner corner is (1, 1).
                let sum = if (u + v) % 2 == 0 { &mut even } else { &mut odd };
                *sum = (sum.0 + value, sum.1 + 1.0);
            }
        }
        even.0 * odd.1 < odd.0 * even.1
    }
}

fn sorted(mut corners: Vec<SeenCorner>) -> Vec<SeenCorner> {
    corners.retain(|corner| corner.pixel.is_finite());
    corners.sort_by_key(|corner| corner.index);
    corners.dedup_by_key(|corner| corner.index);
    if corners.len() < LEAST_CORNERS { Vec::new() } else { corners }
}
