//! Frames and sets of frames.

use std::sync::Arc;

use crate::{CameraId, Image, Mask};

/// One image of one camera.
#[derive(Debug)]
pub struct Frame {
    /// Which camera.
    pub camera: CameraId,
    /// Counts the camera's frames; a gap is a loss before us.
    pub sequence: u64,
    /// Middle of the exposure, `CLOCK_MONOTONIC` of the capturing host (a recording: of its own clock).
    pub capture_nanos: i64,
    /// Exposure time where the source knows it.
    pub exposure_nanos: Option<u64>,
    /// The pixels.
    pub image: Image,
    /// The person's mask where the source has one (simulated or prepared data).
    pub mask: Option<Mask>,
}

/// How whole a set is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SetKind {
    /// Every camera of the rig is there.
    Complete,
    /// At least one camera is missing.
    Partial,
}

/// The frames of one instant, one slot a camera in rig order. Each frame keeps its own capture time.
#[derive(Debug, Clone)]
pub struct FrameSet {
    /// Counts sets from 0.
    pub index: u64,
    /// The master clock's time of the set.
    pub master_nanos: i64,
    /// A slot a camera, `None` where the camera gave nothing inside the window.
    pub frames: Vec<Option<Arc<Frame>>>,
}

impl FrameSet {
    /// Whether a camera is missing.
    #[must_use]
    pub fn kind(&self) -> SetKind {
        if self.frames.iter().all(Option::is_some) { SetKind::Complete } else { SetKind::Partial }
    }

    /// The frames that are there, with their slot.
    pub fn present(&self) -> impl Iterator<Item = (usize, &Arc<Frame>)> {
        self.frames.iter().enumerate().filter_map(|(slot, frame)| frame.as_ref().map(|frame| (slot, frame)))
    }
}
