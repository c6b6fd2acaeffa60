//! Frames come from here: one trait for cameras and recordings, and the threads that read them.

mod error;
mod source;

pub use error::{CaptureError, CaptureErrorKind};
pub use source::CameraSource;
