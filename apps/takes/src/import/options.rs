//! Options of an import.

use std::path::PathBuf;

/// Files to import, and how.
#[derive(Debug, Clone)]
pub struct ImportOptions {
    /// One folder, or the videos of all cameras.
    pub inputs: Vec<PathBuf>,
    /// File or folder of a calibration; searched for otherwise.
    pub calibration: Option<PathBuf>,
    /// Length of the calibration's unit, metres.
    pub scale: f64,
    /// Names of cameras in the footage, and in the calibration.
    pub names: Vec<(String, String)>,
    /// New folder of the take.
    pub out: PathBuf,
    /// Frame rate of a folder of images, frames per second.
    pub fps: f64,
    /// Whether the calibration is taken as it is.
    pub trusts_calibration: bool,
}
