//! Calibration boards and `board.toml`.

use std::path::Path;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::error::CalibError;

/// Allowed number of squares along a side.
const SQUARES: std::ops::RangeInclusive<u32> = 3..=40;
/// Allowed side of a square, millimetres.
const SQUARE_MM: std::ops::RangeInclusive<f64> = 5.0..=1000.0;
/// Allowed side of a marker relative to the square's.
const MARKER: std::ops::RangeInclusive<f64> = 0.4..=0.9;

/// Pattern on a board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "pattern", rename_all = "lowercase", deny_unknown_fields)]
pub enum Pattern {
    /// Black and white squares only. The whole board must be in the image.
    Chessboard,
    /// Squares with ArUco markers in the white ones: any part of the board is recognised.
    Charuco {
        /// Name of the markers' dictionary, such as "DICT_4X4_50".
        dictionary: String,
        /// Side of a marker relative to the square's.
        marker: f64,
    },
}

/// Flat board of squares; the one at the top left is black.
///
/// Board axes: x right and y down along the printed side, z into the board; the origin is the inner corner at the top left.
///
/// ```
/// use flyrig_calib::{Board, Pattern};
///
/// let board = Board { columns: 9, rows: 6, square_mm: 30.0, pattern: Pattern::Chessboard };
/// board.check()?;
/// let points: Vec<_> = (0..board.corner_count()).map(|index| board.corner(index)).collect();
/// assert_eq!(points.len(), 8 * 5);
/// assert!((points[1].x - 0.03).abs() < 1e-12 && points[1].y == 0.0, "metres along x");
/// # Ok::<(), String>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Board {
    /// Squares along x.
    pub columns: u32,
    /// Squares along y.
    pub rows: u32,
    /// Side of a square, millimetres: measure it on the print.
    pub square_mm: f64,
    /// Pattern.
    #[serde(flatten)]
    pub pattern: Pattern,
}

impl Default for Board {
    fn default() -> Self {
        let pattern = Pattern::Charuco { dictionary: "DICT_5X5_100".to_owned(), marker: 0.75 };
        Self { columns: 9, rows: 6, square_mm: 30.0, pattern }
    }
}

impl Board {
    /// Reads `board.toml`.
    ///
    /// # Errors
    /// [`CalibError::Board`] names the file, the key and the fix.
    pub fn load(path: &Path) -> Result<Self, CalibError> {
        let refused = |reason: String| CalibError::Board { path: path.to_owned(), reason };
        let text = flyrig_types::read_text(path)
            .map_err(|error| refused(format!("cannot be read: {error}; print one with flyrig calibrate board")))?;
        let board: Self = toml::from_str(&text).map_err(|error| refused(error.to_string()))?;
        board.check().map_err(refused)?;
        Ok(board)
    }

    /// Returns the text of `board.toml`.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let mut text = format!(
            "# A calibration board. Measure square_mm on the print: it is the scale of everything.\n\
             columns = {}\nrows = {}\nsquare_mm = {:?}\n",
            self.columns, self.rows, self.square_mm
        );
        text += &match &self.pattern {
            Pattern::Chessboard => "pattern = \"chessboard\"\n".to_owned(),
            Pattern::Charuco { dictionary, marker } => {
                format!("pattern = \"charuco\"\ndictionary = {dictionary:?}\nmarker = {marker:?}\n")
            }
        };
        text
    }

    /// Checks every value; the error text names the key and the fix.
    ///
    /// # Errors
    /// Names the invalid key.
    pub fn check(&self) -> Result<(), String> {
        for (key, count) in [("columns", self.columns), ("rows", self.rows)] {
            if !SQUARES.contains(&count) {
                return Err(format!("{key} is {count}, expected {} to {}", SQUARES.start(), SQUARES.end()));
            }
        }
        if !SQUARE_MM.contains(&self.square_mm) {
            return Err(format!(
                "square_mm is {}, expected {} to {}",
                self.square_mm,
                SQUARE_MM.start(),
                SQUARE_MM.end()
            ));
        }
        match &self.pattern {
            Pattern::Chessboard if self.columns % 2 == self.rows % 2 => Err(format!(
                "a chessboard of {} x {} squares looks the same upside down; make one side even and the other odd",
                self.columns, self.rows
            )),
            Pattern::Chessboard => Ok(()),
            Pattern::Charuco { dictionary, marker } => {
                if !MARKER.contains(marker) {
                    return Err(format!("marker is {marker}, expected {} to {}", MARKER.start(), MARKER.end()));
                }
                crate::dictionary::check_dictionary(dictionary, self.marker_count())
            }
        }
    }

    /// Returns the number of white squares.
    #[must_use]
    pub fn marker_count(&self) -> usize {
        (self.columns as usize * self.rows as usize) / 2
    }

    /// Returns the number of inner corners along x and y.
    #[must_use]
    pub fn inner(&self) -> [u32; 2] {
        [self.columns.saturating_sub(1), self.rows.saturating_sub(1)]
    }

    /// Returns the number of inner corners.
    #[must_use]
    pub fn corner_count(&self) -> usize {
        self.inner().into_iter().map(|n| n as usize).product()
    }

    /// Returns the position of an inner corner in board axes, metres; corners are numbered along x first.
    #[must_use]
    pub fn corner(&self, index: usize) -> DVec3 {
        let across = self.inner()[0].max(1) as usize;
        DVec3::new((index % across) as f64, (index / across) as f64, 0.0) * (1e-3 * self.square_mm)
    }

    /// Returns the centre of the inner corners in board axes, metres.
    #[must_use]
    pub fn middle(&self) -> DVec3 {
        let [x, y] = self.inner();
        DVec3::new(f64::from(x.saturating_sub(1)), f64::from(y.saturating_sub(1)), 0.0) * (0.5e-3 * self.square_mm)
    }
}
