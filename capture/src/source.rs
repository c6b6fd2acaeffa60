//! The one trait behind which every camera stands.

use std::time::Duration;

use flyrig_types::{CameraId, Frame};

use crate::CaptureError;

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
}

impl<S: CameraSource + ?Sized> CameraSource for Box<S> {
    fn camera(&self) -> &CameraId {
        (**self).camera()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        (**self).next_frame(timeout)
    }
}
