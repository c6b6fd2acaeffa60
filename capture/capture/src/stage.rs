//! Work on frames between a camera's thread and the common queue, in a thread of its own.

use std::sync::Arc;

use flyrig_types::{CameraId, Frame, caught};

use crate::{CaptureError, LatestQueue};

/// Frames that may wait for a stage: one to work on next, one for jitter. More would only be older.
const WAITING: usize = 2;

/// Work on every frame of a camera that shall not hold up the camera's own thread: decoding, compressing.
pub trait FrameStage: Send {
    /// Makes another frame of a frame.
    ///
    /// # Errors
    /// Costs this frame alone and is counted; so is a panic, as `Corrupt`, after which the next frames go to a new stage
    /// where one can be made ([`crate::CaptureThreads::start_opening_staged`]).
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError>;
}

/// From a camera's thread to its stage's: the frame and its place in the order of capture.
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

/// Makes a camera's stage.
pub(crate) type StageMaker = Arc<dyn Fn(&CameraId) -> Box<dyn FrameStage> + Send + Sync>;

/// A stage, and how to make another when it has panicked; without that it is used on.
pub(crate) struct Stage {
    pub stage: Box<dyn FrameStage>,
    pub maker: Option<StageMaker>,
}

impl Stage {
    /// Replaces the stage, if another can be made.
    pub fn renew(&mut self, camera: &CameraId) -> bool {
        let Some(maker) = &self.maker else { return false };
        let Ok(fresh) = caught(|| maker(camera)) else { return false };
        let broken = std::mem::replace(&mut self.stage, fresh);
        let _ = caught(move || drop(broken));
        true
    }
}
