//! The one trait behind which every camera stands.

use std::time::Duration;

use flyrig_types::{CameraId, Frame};

use crate::CaptureError;

/// What a source knows of itself beyond its frames and errors; counts since it was made.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SourceHealth {
    /// Frames that the driver numbered and nobody got.
    pub lost_by_driver: u64,
    /// Times that the camera came back after it was gone.
    pub reconnects: u64,
    /// Times that it went silent without an error.
    pub silences: u64,
    /// Time stamps that could not be right and were replaced.
    pub stamps_replaced: u64,
    /// Format, size and rate in force, as text; empty where it says nothing.
    pub mode: String,
}

/// A camera, real, recorded or simulated, read by one thread.
pub trait CameraSource: Send {
    /// Name of the camera; never changes.
    fn camera(&self) -> &CameraId;

    /// The next frame in the order of capture; waits at most about `timeout` for a camera, while a
    /// recording may take as long as decoding takes.
    ///
    /// # Errors
    /// After an error of a recoverable kind ([`crate::CaptureErrorKind::is_recoverable`]) the next
    /// call goes on: with the next frame after `Corrupt`, with an attempt to reconnect after
    /// `Disconnected` and `Io`. Every other kind is final, `EndOfStream` among them.
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError>;

    /// Time by which [`crate::Pacing::Lossless`] puts the frame given last in order with those of other
    /// cameras, nanoseconds: its capture time, unless the source knows that its stamps are wrong.
    fn order_nanos(&self, frame: &Frame) -> i64 {
        frame.capture_nanos
    }

    /// Counts beyond frames and errors.
    fn health(&self) -> SourceHealth {
        SourceHealth::default()
    }
}

impl<S: CameraSource + ?Sized> CameraSource for Box<S> {
    fn camera(&self) -> &CameraId {
        (**self).camera()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        (**self).next_frame(timeout)
    }

    fn order_nanos(&self, frame: &Frame) -> i64 {
        (**self).order_nanos(frame)
    }

    fn health(&self) -> SourceHealth {
        (**self).health()
    }
}
