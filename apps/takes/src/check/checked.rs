//! Input and result of a check.

use flyrig_types::{Image, Rig};

use crate::footage::Footage;

/// Footage whose calibration is checked.
pub struct CheckInput<'a> {
    /// Footage with images of all cameras.
    pub footage: &'a Footage,
    /// Frame rate of a folder of images, frames per second.
    pub fps: f64,
    /// Calibrations that are possible, at least one; the first is the take's own.
    pub rigs: &'a [Rig],
    /// Images of the empty scene, one per slot.
    pub plates: Vec<Option<Image>>,
}

/// Result of a check.
#[derive(Debug, Clone)]
pub struct Checked {
    /// Calibration with what was adopted.
    pub rig: Rig,
    /// Which of the possible calibrations fits best.
    pub choice: usize,
    /// Whether the calibration differs from the chosen one.
    pub is_changed: bool,
    /// Faults that were found, for the user.
    pub sentences: Vec<String>,
    /// Figures of the check.
    pub(super) report: serde_json::Value,
}
