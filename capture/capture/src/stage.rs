//! Processing between a camera's thread and the common queue, in a thread of its own.

use std::sync::Arc;

use flyrig_types::{CameraId, Frame, caught};

use crate::error::CaptureError;
use crate::queue::LatestQueue;

/// Queued frames of a stage: one to process next, one for jitter. More would only add latency.
const WAITING: usize = 2;

/// Processing of a camera's frames that must not block the camera's own thread: decoding, compression.
pub trait FrameStage: Send {
    /// Transforms a frame.
    ///
    /// # Errors
    /// An error loses this frame only and is counted. So is a panic, as `Corrupt`, after which the next frames go to a
    /// new stage where one can be created ([`crate::CaptureThreads::start_opening_staged`]).
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError>;
}

/// Hand-over from a camera's thread to its stage: frame and order time, nanoseconds.
#[derive(Debug)]
pub(crate) struct Hand(pub LatestQueue<(Frame, i64)>);

impl Hand {
    pub fn new() -> Self {
        Self(LatestQueue::new(WAITING))
    }

    pub fn close(&self) {
        self.0.close();
    }
}

/// Factory of a camera's stage.
pub(crate) type StageMaker = Arc<dyn Fn(&CameraId) -> Box<dyn FrameStage> + Send + Sync>;

/// Stage with the factory of its successor after a panic; without one the same stage continues.
pub(crate) struct Stage {
    pub stage: Box<dyn FrameStage>,
    pub maker: Option<StageMaker>,
}

impl Stage {
    /// Replaces the stage, if a factory exists; returns whether it did.
    pub fn renew(&mut self, camera: &CameraId) -> bool {
        let Some(maker) = &self.maker else { return false };
        let Ok(fresh) = caught(|| maker(camera)) else { return false };
        let broken = std::mem::replace(&mut self.stage, fresh);
        let _ = caught(move || drop(broken));
        true
    }
}
