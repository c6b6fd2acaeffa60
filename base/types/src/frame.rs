//! Frames and frame sets.

use std::sync::Arc;

use crate::{CameraId, Image, Mask};

/// One image of one camera, with its capture time.
#[derive(Debug)]
pub struct Frame {
    /// Camera that took the image.
    pub camera: CameraId,
    /// Number of the camera's frame; a gap means that frames were lost before they reached this program.
    pub sequence: u64,
    /// Middle of the exposure, `CLOCK_MONOTONIC` of the capturing host (a recording: of its own clock).
    pub capture_nanos: i64,
    /// Exposure time, where the source knows it.
    pub exposure_nanos: Option<u64>,
    /// Pixels.
    pub image: Image,
    /// Mask of the person, where the source has one (simulated or prepared data).
    pub mask: Option<Mask>,
}

/// Completeness of a frame set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SetKind {
    /// All cameras of the rig delivered a frame.
    Complete,
    /// At least one camera delivered none.
    Partial,
}

/// Frames of one instant, one slot per camera in rig order. Each frame keeps its own capture time.
#[derive(Debug, Clone)]
pub struct FrameSet {
    /// Number of the frame set, from 0.
    pub index: u64,
    /// Time of the frame set by the master clock, nanoseconds.
    pub master_nanos: i64,
    /// One slot per camera; `None` where the camera delivered nothing within the window.
    pub frames: Vec<Option<Arc<Frame>>>,
}

impl FrameSet {
    /// Returns whether a camera is missing.
    #[must_use]
    pub fn kind(&self) -> SetKind {
        if self.frames.iter().all(Option::is_some) { SetKind::Complete } else { SetKind::Partial }
    }

    /// Iterates over the frames that are present, each with its slot.
    pub fn present(&self) -> impl Iterator<Item = (usize, &Arc<Frame>)> {
        self.frames.iter().enumerate().filter_map(|(slot, frame)| frame.as_ref().map(|frame| (slot, frame)))
    }
}
