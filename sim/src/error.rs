//! What can go wrong in a simulation.

use std::path::PathBuf;

use flyrig_body::BodyError;
use flyrig_calib::CalibError;
use flyrig_gpu::GpuError;
use flyrig_types::{CameraError, ImageError, PoseError};

/// Why there is no simulated frame.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// A setting out of its range.
    #[error("simulation: {field} is {found}, expected {expected}")]
    Config {
        /// Which setting.
        field: &'static str,
        /// What was found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// A shape target of the person that there is not, or out of its range.
    #[error("simulation: person.shape: {0}")]
    Shape(BodyError),
    /// The motion clip is not there.
    #[error("motion clip {} not found; {mend}", path.display())]
    NoClip {
        /// Where it was looked for.
        path: PathBuf,
        /// What to do.
        mend: &'static str,
    },
    /// The skeleton lacks a joint that a motion needs.
    #[error("the body's skeleton has no joint '{0}', which the simulated motion moves")]
    NoJoint(&'static str),
    /// No such camera.
    #[error("the simulated ring has {count} cameras, there is no slot {slot}")]
    NoSlot {
        /// The slot asked for.
        slot: usize,
        /// Cameras of the ring.
        count: usize,
    },
    /// The body.
    #[error(transparent)]
    Body(#[from] BodyError),
    /// The motion.
    #[error("simulated motion: {0}")]
    Pose(#[from] PoseError),
    /// The cameras.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The graphics adapter.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// An image.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// An image's JPEG or PNG code.
    #[error("coding a simulated image: {0}")]
    Code(#[from] image::ImageError),
    /// A folder or a file of an export.
    #[error("{} {message}", path.display())]
    Export {
        /// Which.
        path: PathBuf,
        /// Problem and fix.
        message: String,
    },
    /// An export that was told to stop.
    #[error("stopped; nothing was written")]
    Stopped,
    /// A calibration that cannot be written.
    #[error(transparent)]
    Calib(#[from] CalibError),
    /// A fault script.
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
