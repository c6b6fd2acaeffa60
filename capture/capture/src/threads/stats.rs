//! Settings and counts of the cameras' threads.

use std::collections::BTreeMap;

use flyrig_types::CameraId;

use crate::error::{CaptureError, CaptureErrorKind};
use crate::source::SourceHealth;
use crate::threads::rate::FrameRate;

/// Timing of frames into the queue, and behaviour when it is full.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Pacing {
    /// As the sources yield them; the oldest is dropped. For live cameras.
    #[default]
    AsDelivered,
    /// At the pace of their capture times; the oldest is dropped. For a recording played as live.
    RealTime,
    /// As fast as they are consumed, without drops, in the order of capture over all cameras, so that every run is
    /// identical. For evaluation.
    Lossless,
}

/// Settings of [`crate::CaptureThreads`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThreadsConfig {
    /// Queue capacity, frames of all cameras together.
    pub queue_capacity: usize,
    /// See [`Pacing`].
    pub pacing: Pacing,
}

impl Default for ThreadsConfig {
    fn default() -> Self {
        Self { queue_capacity: 16, pacing: Pacing::default() }
    }
}

/// Counts of one camera's threads.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraStats {
    /// Name of the camera.
    pub camera: CameraId,
    /// Frames put into the queue.
    pub frames: u64,
    /// Frames of this camera dropped from the full queue.
    pub dropped: u64,
    /// Frames overtaken by newer ones before the camera's stage (see [`crate::FrameStage`]) processed them.
    pub overtaken: u64,
    /// Errors by kind; the end of a recording does not count.
    pub errors: BTreeMap<CaptureErrorKind, u64>,
    /// Most recent error.
    pub last_error: Option<CaptureError>,
    /// Health as the source reports it, summed over all sources of the camera.
    pub health: SourceHealth,
    /// Rate at which the camera captures; `None` for the first three seconds, while it is gone, and where its mode is not known.
    pub rate: Option<FrameRate>,
    /// Number of times that the camera was reopened because its source had failed for good or panicked.
    pub restarts: u64,
    /// Number of times that its stage was created anew after a panic.
    pub stage_restarts: u64,
    /// Whether the camera has a source now. Without one it is being opened or, when not `running`, has ended.
    pub opened: bool,
    /// Whether the thread still reads.
    pub running: bool,
}
