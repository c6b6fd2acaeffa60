//! Errors of a simulation.

use std::path::PathBuf;

use flyrig_body::BodyError;
use flyrig_calib::CalibError;
use flyrig_gpu::GpuError;
use flyrig_types::{CameraError, ImageError, PoseError};

/// Error of a simulation.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// Setting out of its range.
    #[error("simulation: {field} is {found}, expected {expected}")]
    Config {
        /// Name of the setting.
        field: &'static str,
        /// Value found.
        found: String,
        /// Valid range.
        expected: &'static str,
    },
    /// Shape parameter that does not exist or is out of range.
    #[error("simulation: person.shape: {0}")]
    Shape(BodyError),
    /// Missing motion clip.
    #[error("motion clip {} not found; {mend}", path.display())]
    NoClip {
        /// Path that was tried.
        path: PathBuf,
        /// Fix.
        mend: &'static str,
    },
    /// Skeleton without a joint that a motion needs.
    #[error("the body's skeleton has no joint '{0}', which the simulated motion moves")]
    NoJoint(&'static str),
    /// Nonexistent camera.
    #[error("the simulated ring has {count} cameras, there is no slot {slot}")]
    NoSlot {
        /// Requested slot.
        slot: usize,
        /// Cameras of the ring.
        count: usize,
    },
    /// Error of the body.
    #[error(transparent)]
    Body(#[from] BodyError),
    /// Error of the motion.
    #[error("simulated motion: {0}")]
    Pose(#[from] PoseError),
    /// Error of the cameras.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Error of the graphics adapter.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Error of an image.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// Error of an image's JPEG or PNG codec.
    #[error("encoding a simulated image: {0}")]
    Code(#[from] image::ImageError),
    /// Error of a folder or file of an export.
    #[error("{} {message}", path.display())]
    Export {
        /// Path of the file or folder.
        path: PathBuf,
        /// Fault and fix.
        message: String,
    },
    /// Export stopped by its caller.
    #[error("stopped; nothing was written")]
    Stopped,
    /// Calibration that cannot be written.
    #[error(transparent)]
    Calib(#[from] CalibError),
    /// Malformed fault script.
    #[error("fault script: {0}")]
    Script(#[from] toml::de::Error),
}

/// Checks that a setting lies in its range.
pub(crate) fn check(
    field: &'static str,
    found: f64,
    low: f64,
    high: f64,
    expected: &'static str,
) -> Result<(), SimError> {
    if (low..=high).contains(&found) {
        Ok(())
    } else {
        Err(SimError::Config { field, found: found.to_string(), expected })
    }
}
