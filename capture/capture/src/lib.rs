//! Frame sources (cameras, recordings, folders, videos) behind one trait, and the threads that read them.
//!
//! A [`CameraSource`] yields [`flyrig_types::Frame`]s with capture time, sequence number and camera name, or a
//! [`CaptureError`] whose kind determines the reaction. [`CaptureThreads`] reads every source in a thread of its own
//! into one [`LatestQueue`], optionally through a [`FrameStage`] (decoding, compression) in a second thread per camera.
//! A [`SourceOpener`] opens a camera that may be missing at the start.
//!
//! # Example
//!
//! Reads all cameras of a folder in the order of capture, without loss:
//!
//! ```no_run
//! use std::time::Duration;
//!
//! use flyrig_capture::{CameraSource, CaptureThreads, FolderOptions, FolderReplay, Pacing, ThreadsConfig};
//!
//! let replays = FolderReplay::open("take".as_ref(), None, &FolderOptions::default())?;
//! let sources = replays.into_iter().map(|replay| Box::new(replay) as Box<dyn CameraSource>).collect();
//! let config = ThreadsConfig { queue_capacity: 16, pacing: Pacing::Lossless };
//! let threads = CaptureThreads::start(sources, config)?;
//! while let Ok(frame) = threads.queue().pop(Duration::from_secs(10)) {
//!     println!("{} {}: {} ns", frame.camera, frame.sequence, frame.capture_nanos);
//! }
//! # Ok::<(), flyrig_capture::CaptureError>(())
//! ```

mod blocking;
mod camera_options;
mod clock;
mod container;
mod decoding;
mod device_settings;
mod encoding;
mod error;
mod folder;
mod image_file;
mod mjpeg;
mod nokhwa_camera;
mod pool;
mod queue;
mod recording;
mod rgb;
mod source;
mod stage;
mod stamps;
mod threads;
mod turns;
#[cfg(target_os = "linux")]
mod v4l2;
mod video;

pub use camera_options::{CameraControls, CameraIdentity, CameraOptions, FormatChoice};
pub use clock::monotonic_nanos;
pub use decoding::Decoding;
pub use device_settings::{DeviceOptions, DeviceSettings};
pub use encoding::JpegEncoding;
pub use error::{CaptureError, CaptureErrorKind};
pub use folder::{FolderOptions, FolderReplay, folder_image_size};
pub use image_file::read_image;
pub use nokhwa_camera::{NokhwaCamera, NokhwaDevice, NokhwaOptions, nokhwa_cameras};
pub use pool::BufferPool;
pub use queue::{LatestQueue, PopError};
pub use recording::{
    Compression, ForeignCamera, ForeignCameras, FrameTimes, McapReplay, MessageTap, Note, RESERVE_BYTES, Recorded,
    RecordedCamera, RecordedSpan, Recorder, RecorderConfig, Recording, Rotation, RotationError, SourceTap,
    foreign_cameras, recorded_messages, recorded_notes, recorded_spans,
};
pub use rgb::{to_rgb8, to_rgb8_into};
pub use source::{CameraSource, NetworkHealth, SourceHealth};
pub use stage::FrameStage;
pub use threads::{CameraStats, CaptureThreads, FrameRate, Pacing, SourceOpener, ThreadsConfig};
#[cfg(target_os = "linux")]
pub use v4l2::{BusPlan, CameraNode, CameraReport, FormatReport, UsbPlace, V4l2Camera, camera_reports, plan_buses};
pub use video::{VideoOptions, VideoReplay};
