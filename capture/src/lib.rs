//! Frames come from here: one trait for cameras and recordings, the recordings, and the threads
//! that read them.
//!
//! A [`CameraSource`] gives [`flyrig_types::Frame`]s with capture time, sequence number and camera
//! name, or a [`CaptureError`] whose kind says what to do. [`CaptureThreads`] reads every source in
//! a thread of its own into one [`LatestQueue`].

mod error;
mod folder;
mod picture;
mod pool;
mod queue;
mod rgb;
mod source;
mod threads;
mod turns;
mod video;

pub use error::{CaptureError, CaptureErrorKind};
pub use folder::{FolderOptions, FolderReplay, folder_picture_size};
pub use pool::BufferPool;
pub use queue::{LatestQueue, PopError};
pub use rgb::{to_rgb8, to_rgb8_into};
pub use source::CameraSource;
pub use threads::{CameraStats, CaptureThreads, Pacing, ThreadsConfig};
pub use video::{VideoOptions, VideoReplay};
