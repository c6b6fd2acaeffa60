//! Errors of a session.

use flyrig_body::BodyError;
use flyrig_capture::CaptureError;
use flyrig_gpu::GpuError;
use flyrig_renderer::{AppearanceError, BackwardError};
use flyrig_stfa::StfaError;
use flyrig_tracker::TrackError;
use flyrig_transport::TransportError;
use flyrig_types::{CameraId, ImageError, PersonId};

/// Why a session cannot go on, or cannot do what was asked. Each text names the faulty item and the fix.
#[derive(Debug, thiserror::Error)]
pub enum FusionError {
    /// The graphics device, see [`Self::is_device_fault`].
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The template or its surface.
    #[error(transparent)]
    Body(#[from] BodyError),
    /// Direct appearance.
    #[error(transparent)]
    Appearance(#[from] AppearanceError),
    /// Derivatives of a drawn view.
    #[error(transparent)]
    Backward(#[from] BackwardError),
    /// The networks of learned appearance.
    #[error(transparent)]
    Networks(#[from] StfaError),
    /// Perception or the deformation solver.
    #[error(transparent)]
    Track(#[from] TrackError),
    /// A camera.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// Publishing.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// An image that cannot be made or read.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// A mask that does not fit its image.
    #[error("camera {camera}: the mask is {}x{} pixels, the image {}x{}", mask.0, mask.1, image.0, image.1)]
    MaskSize {
        /// The camera.
        camera: CameraId,
        /// Width and height of the mask, pixels.
        mask: (u32, u32),
        /// Width and height of the image, pixels.
        image: (u32, u32),
    },
    /// A setting out of its range, or two that exclude each other.
    #[error("{0}")]
    Setting(String),
    /// A person that the session does not know.
    #[error("there is no person {0}; see `Session::subjects`")]
    NoSuchPerson(PersonId),
    /// A saved person that cannot be used.
    #[error("saved person {name}: {problem}")]
    SavedPerson {
        /// The file's name, or the person's.
        name: String,
        /// Problem and fix.
        problem: String,
    },
    /// A person that cannot be sent as a stream.
    #[error(transparent)]
    Stream(#[from] flyrig_stream::StreamError),
    /// A thread that the system did not start.
    #[error(
        "cannot start the thread '{name}': {source}; end other programs, or raise the limit of processes (ulimit -u)"
    )]
    Thread {
        /// Name of the thread.
        name: &'static str,
        /// The system's error.
        source: std::io::Error,
    },
    /// A thread that panicked too often to be restarted once more.
    #[error(
        "the thread '{name}' panicked again and again: {panic}; this is a fault of flyrig, please report it with the log"
    )]
    ThreadFailed {
        /// Name of the thread.
        name: String,
        /// Text of its last panic.
        panic: String,
    },
}

impl FusionError {
    /// Whether the graphics device is lost, out of memory or rejected a command: the session must be rebuilt on a new one
    /// ([`crate::Session::rebuild`]).
    #[must_use]
    pub fn is_device_fault(&self) -> bool {
        match self {
            Self::Gpu(error) => error.is_device_fault(),
            Self::Appearance(AppearanceError::Gpu(error)) | Self::Backward(BackwardError::Gpu(error)) => {
                error.is_device_fault()
            }
            _ => false,
        }
    }
}
