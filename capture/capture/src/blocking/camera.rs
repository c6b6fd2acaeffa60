//! Interface of a camera whose reads block.

use flyrig_types::PixelFormat;

use crate::CaptureError;

/// A camera that is open. It lives and dies in one thread.
pub(crate) trait BlockingCamera {
    /// Format, size and rate, for people.
    fn mode(&self) -> String;

    /// Waits for the next image as long as it takes, and puts its bytes into `bytes`, which are empty.
    ///
    /// # Errors
    /// `Corrupt` costs the image; after every other kind the camera is closed.
    fn read(&mut self, bytes: &mut Vec<u8>) -> Result<Shot, CaptureError>;
}

/// What a camera is opened with: once at first and again whenever it was lost, each time in a new thread.
pub(crate) trait Opener: Send + Sync + 'static {
    type Camera: BlockingCamera;

    /// Names what is opened, the same at every attempt.
    fn device(&self) -> String;

    /// Takes as long as it takes.
    fn open(&self) -> Result<Self::Camera, CaptureError>;
}

/// An image without its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Shot {
    pub size: (u32, u32),
    pub format: PixelFormat,
    /// When the system says that it was taken.
    pub stamp_nanos: Option<i64>,
    /// When the call returned.
    pub arrival_nanos: i64,
}
