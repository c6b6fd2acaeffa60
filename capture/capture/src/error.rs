//! What can go wrong between a camera and a frame.

use std::fmt;

use flyrig_types::CameraId;

/// Kind of a [`CaptureError`]: what a program does about it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum CaptureErrorKind {
    /// No frame came in the time given; ask again.
    Timeout,
    /// The source has no more frames.
    EndOfStream,
    /// The camera or its thread is gone; a source tries to reconnect when it is asked again.
    Disconnected,
    /// This frame cannot be used; the next one may be fine.
    Corrupt,
    /// A format, size or setting that we cannot handle.
    Unsupported,
    /// No such camera, file or frame.
    NotFound,
    /// The operating system refused to read.
    Io,
}

impl CaptureErrorKind {
    /// Whether asking the same source again can help.
    #[must_use]
    pub fn is_recoverable(self) -> bool {
        matches!(self, Self::Timeout | Self::Disconnected | Self::Corrupt | Self::Io)
    }
}

/// An error of one camera, or of a whole recording when `camera` is `None`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CaptureError {
    /// Which camera, where it is known.
    pub camera: Option<CameraId>,
    /// What to do about it.
    pub kind: CaptureErrorKind,
    /// Problem and fix.
    pub message: String,
}

impl CaptureError {
    /// An error of one camera.
    #[must_use]
    pub fn new(camera: &CameraId, kind: CaptureErrorKind, message: impl Into<String>) -> Self {
        Self { camera: Some(camera.clone()), kind, message: message.into() }
    }

    /// An error that belongs to no camera.
    #[must_use]
    pub fn general(kind: CaptureErrorKind, message: impl Into<String>) -> Self {
        Self { camera: None, kind, message: message.into() }
    }

    /// The same error, said of a camera.
    #[must_use]
    pub fn of(self, camera: &CameraId) -> Self {
        Self { camera: Some(camera.clone()), ..self }
    }
}

impl fmt::Display for CaptureError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.camera {
            Some(camera) => write!(f, "camera {camera}: {}", self.message),
            None => f.write_str(&self.message),
        }
    }
}

impl std::error::Error for CaptureError {}
