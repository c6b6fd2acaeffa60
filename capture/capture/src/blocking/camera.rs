//! Interface of a camera whose reads block.

use flyrig_types::PixelFormat;

use crate::error::CaptureError;

/// An open camera, used by a single thread from opening to drop.
pub(crate) trait BlockingCamera {
    /// Returns format, size and rate as text for logs.
    fn mode(&self) -> String;

    /// Blocks until the next image and writes its bytes into `bytes`, which is empty on entry.
    ///
    /// # Errors
    /// `Corrupt` loses this image only; after any other kind the camera is closed.
    fn read(&mut self, bytes: &mut Vec<u8>) -> Result<DriverImage, CaptureError>;
}

/// Factory of a blocking camera. Called at the start and after every loss, each time in a new thread.
pub(crate) trait Opener: Send + Sync + 'static {
    type Camera: BlockingCamera;

    /// Returns a name of the device that is stable across attempts.
    fn device(&self) -> String;

    /// Opens the camera; may block indefinitely.
    fn open(&self) -> Result<Self::Camera, CaptureError>;
}

/// Metadata of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct DriverImage {
    pub size: (u32, u32),
    pub format: PixelFormat,
    /// Timestamp from the system, nanoseconds, where it provides one.
    pub stamp_nanos: Option<i64>,
    /// Time at which the read returned, nanoseconds.
    pub arrival_nanos: i64,
}
