//! Settings and counts of the cameras' threads.

use std::collections::BTreeMap;

use flyrig_types::CameraId;

use crate::{CaptureError, CaptureErrorKind, SourceHealth};

/// When frames go into the queue, and what happens when it is full.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Pacing {
    /// As the sources give them; the oldest is dropped. For live cameras.
    #[default]
    AsDelivered,
    /// At the pace of their capture times; the oldest is dropped. For a recording played as live.
    RealTime,
    /// As fast as they are taken out, nothing is dropped, and in the order of capture over all
    /// cameras, so that every run is the same. For evaluation.
    Lossless,
}

/// Settings of [`crate::CaptureThreads`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThreadsConfig {
    /// Frames of all cameras together that wait in the queue.
    pub queue_capacity: usize,
    /// See [`Pacing`].
    pub pacing: Pacing,
}

impl Default for ThreadsConfig {
    fn default() -> Self {
        Self { queue_capacity: 16, pacing: Pacing::default() }
    }
}

/// Counts of one camera's thread.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraStats {
    /// Which camera.
    pub camera: CameraId,
    /// Frames put into the queue.
    pub frames: u64,
    /// Frames of this camera that were dropped out of the full queue.
    pub dropped: u64,
    /// Frames that newer ones overtook before the camera's stage (see [`crate::FrameStage`]) came to them.
    pub overtaken: u64,
    /// Errors by kind; the end of a recording is none.
    pub errors: BTreeMap<CaptureErrorKind, u64>,
    /// The error that came last.
    pub last_error: Option<CaptureError>,
    /// Health as the source reports it; counts are over all sources of the camera.
    pub health: SourceHealth,
    /// Times that the camera was opened anew because its source had failed for good or panicked.
    pub restarts: u64,
    /// Times that its stage was made anew because it had panicked.
    pub stage_restarts: u64,
    /// Whether the camera has a source now. Without one it is being opened, or, when not `running`, has ended.
    pub opened: bool,
    /// Whether the thread still reads.
    pub running: bool,
}
