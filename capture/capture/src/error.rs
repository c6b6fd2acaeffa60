//! Errors of frame sources.

use std::fmt;

use flyrig_types::CameraId;

/// Kind of a [`CaptureError`], which decides the caller's reaction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum CaptureErrorKind {
    /// No frame arrived in time; ask again.
    Timeout,
    /// The source has no more frames.
    EndOfStream,
    /// The camera or its thread is gone; a source tries to reconnect at the next call.
    Disconnected,
    /// This frame is unusable; the next one may be fine.
    Corrupt,
    /// Unsupported format, size or setting.
    Unsupported,
    /// No such camera, file or frame.
    NotFound,
    /// The operating system refused to read.
    Io,
}

impl CaptureErrorKind {
    /// Returns whether another call of the same source can succeed.
    #[must_use]
    pub fn is_recoverable(self) -> bool {
        matches!(self, Self::Timeout | Self::Disconnected | Self::Corrupt | Self::Io)
    }
}

/// Error of one camera, or of a whole recording when `camera` is `None`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CaptureError {
    /// Camera at fault, where it is known.
    pub camera: Option<CameraId>,
    /// Kind of the error.
    pub kind: CaptureErrorKind,
    /// Problem and fix.
    pub message: String,
}

impl CaptureError {
    /// Creates an error of one camera.
    #[must_use]
    pub fn new(camera: &CameraId, kind: CaptureErrorKind, message: impl Into<String>) -> Self {
        Self { camera: Some(camera.clone()), kind, message: message.into() }
    }

    /// Creates an error without a camera.
    #[must_use]
    pub fn general(kind: CaptureErrorKind, message: impl Into<String>) -> Self {
        Self { camera: None, kind, message: message.into() }
    }

    /// Attributes the error to a camera.
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
