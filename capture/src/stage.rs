//! Work on frames between a camera's thread and the common queue, in a thread of its own.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    time::Duration,
};

use flyrig_types::Frame;

use crate::{CaptureError, CaptureErrorKind, LatestQueue, threads::Shared};

/// Frames that may wait for a stage: one to work on next, one for jitter. More would only be older.
const WAITING: usize = 2;

/// Work on every frame of a camera that shall not hold up the camera's own thread: decoding, compressing.
pub trait FrameStage: Send {
    /// Makes another frame of a frame.
    ///
    /// # Errors
    /// Costs this frame alone and is counted; so is a panic, as `Corrupt`.
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

impl Shared {
    /// The body of a stage's thread.
    pub(crate) fn run_stage(&self, slot: usize, mut stage: Box<dyn FrameStage>) {
        let Some(hand) = self.hand(slot) else { return };
        let camera = self.camera(slot);
        // Ends when the camera's thread has closed the queue, and all that was in it is done.
        while let Ok((frame, order_nanos)) = hand.0.pop(Duration::MAX) {
            let sequence = frame.sequence;
            let done = catch_unwind(AssertUnwindSafe(|| stage.process(frame))).unwrap_or_else(|_| {
                Err(CaptureError::general(CaptureErrorKind::Corrupt, "made the decoder fail inside"))
            });
            match done {
                Ok(frame) => {
                    if !self.deliver(slot, frame, order_nanos) {
                        hand.close();
                        break;
                    }
                }
                Err(error) => {
                    let message = format!("frame {sequence} {}", error.message);
                    self.count(slot, CaptureError { message, ..error }.of(&camera));
                }
            }
        }
        self.end(slot);
    }
}
