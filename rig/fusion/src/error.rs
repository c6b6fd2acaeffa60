//! Errors of a session and of a live rig.

use flyrig_avatar::AvatarError;
use flyrig_body::BodyError;
use flyrig_capture::CaptureError;
use flyrig_fit::FitError;
use flyrig_gpu::GpuError;
use flyrig_renderer::{AppearanceError, BackwardError};
use flyrig_stfa::StfaError;
use flyrig_tracker::TrackError;
use flyrig_transport::TransportError;
use flyrig_types::{CameraId, ImageError, PersonId};

/// Error of a session. Each text names the faulty item and the fix.
#[derive(Debug, thiserror::Error)]
pub enum FusionError {
    /// Fault of the graphics device, see [`Self::is_device_fault`].
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Error of the template or its surface.
    #[error(transparent)]
    Body(#[from] BodyError),
    /// Error of direct appearance.
    #[error(transparent)]
    Appearance(#[from] AppearanceError),
    /// Error of the derivatives of a rendered view.
    #[error(transparent)]
    Backward(#[from] BackwardError),
    /// Error of the person's avatar.
    #[error(transparent)]
    Avatar(#[from] AvatarError),
    /// Error of the fit of the person's avatar.
    #[error(transparent)]
    Fit(#[from] FitError),
    /// Error of the networks of learned appearance.
    #[error(transparent)]
    Networks(#[from] StfaError),
    /// Error of perception or the deformation solver.
    #[error(transparent)]
    Track(#[from] TrackError),
    /// Error of a camera.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// Error of publishing.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// Error of an image that cannot be created or read.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// Mask that does not fit its image.
    #[error("camera {camera}: the mask is {}x{} pixels, the image {}x{}", mask.0, mask.1, image.0, image.1)]
    MaskSize {
        /// Id of the camera.
        camera: CameraId,
        /// Width and height of the mask, pixels.
        mask: (u32, u32),
        /// Width and height of the image, pixels.
        image: (u32, u32),
    },
    /// Setting out of its range, or two settings that exclude each other.
    #[error("{0}")]
    Setting(String),
    /// Person that the session does not know.
    #[error("there is no person {0}; see `Session::subjects`")]
    NoSuchPerson(PersonId),
    /// Saved person that cannot be used.
    #[error("saved person {name}: {problem}")]
    SavedPerson {
        /// Name of the file or the person.
        name: String,
        /// Problem and fix.
        problem: String,
    },
    /// Person that cannot be sent as a stream.
    #[error(transparent)]
    Stream(#[from] flyrig_stream::StreamError),
    /// View that panicked while it was drawn.
    #[error("drawing it panicked: {0}; this is a fault of flyrig, please report it with the log")]
    View(String),
    /// Thread that the system did not start.
    #[error(
        "cannot start the thread '{name}': {source}; end other programs, or raise the limit of processes (ulimit -u)"
    )]
    Thread {
        /// Name of the thread.
        name: &'static str,
        /// Error of the system.
        source: std::io::Error,
    },
    /// Thread that panicked too often to be restarted once more.
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
    /// Returns whether the graphics device is lost, out of memory or rejected a command. The session must then be rebuilt on a new device
    /// ([`crate::Session::rebuild`]).
    #[must_use]
    pub fn is_device_fault(&self) -> bool {
        match self {
            Self::Gpu(error) => error.is_device_fault(),
            Self::Appearance(AppearanceError::Gpu(error))
            | Self::Backward(BackwardError::Gpu(error))
            | Self::Avatar(AvatarError::Gpu(error))
            | Self::Fit(FitError::Gpu(error)) => error.is_device_fault(),
            _ => false,
        }
    }
}
