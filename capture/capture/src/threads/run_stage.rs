//! Main loop of a stage's thread.

use std::time::Duration;

use flyrig_types::caught;

use super::shared::ThreadsState;
use crate::error::{CaptureError, CaptureErrorKind};
use crate::queue::PopError;
use crate::stage::Stage;

/// Interval of the heartbeats of an idle stage.
const TURN: Duration = Duration::from_millis(500);

impl ThreadsState {
    /// Runs a stage until its camera ends.
    pub(crate) fn run_stage(&self, slot: usize, mut stage: Stage) {
        let Some(hand) = self.hand(slot) else { return };
        let (camera, pulse) = (self.camera(slot), &self.pulses(slot).stage);
        // Ends when the camera's thread has closed the queue, and all that was in it is done.
        loop {
            pulse.beat();
            let (frame, order_nanos) = match hand.0.pop(TURN) {
                Ok(next) => next,
                Err(PopError::Timeout) => continue,
                Err(PopError::Closed) => break,
            };
            pulse.beat();
            let sequence = frame.sequence;
            let done = caught(|| stage.stage.process(frame)).unwrap_or_else(|text| {
                if stage.renew(&camera) {
                    self.count_stage_restart(slot);
                }
                let message = format!("made the decoder fail inside: {text}");
                Err(CaptureError::general(CaptureErrorKind::Corrupt, message))
            });
            match done {
                Ok(frame) => {
                    if !self.deliver(slot, pulse, frame, order_nanos) {
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
        let _ = caught(move || drop(stage));
        pulse.rest();
        self.end(slot);
    }
}
