//! Simulated cameras behind the capture trait.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind};
use flyrig_types::{CameraId, Frame};

use crate::{SimError, Simulator};

/// One camera of a [`Simulator`]. Simulated time moves by exactly one frame interval a call, whatever the
/// wall clock does; all sources of a simulator see the same instants.
#[derive(Debug)]
pub struct SimSource {
    simulator: Arc<Mutex<Simulator>>,
    camera: CameraId,
    slot: usize,
    next_index: u64,
    frames: Option<u64>,
}

/// A source for every camera of the rig, in rig order.
#[must_use]
pub fn sources(simulator: &Arc<Mutex<Simulator>>) -> Vec<SimSource> {
    let guard = simulator.lock().unwrap_or_else(PoisonError::into_inner);
    let frames = guard.config().frames;
    let camera_ids = guard.rig().cameras.iter().map(|camera| camera.id.clone());
    camera_ids
        .enumerate()
        .map(|(slot, camera)| SimSource { simulator: Arc::clone(simulator), camera, slot, next_index: 0, frames })
        .collect()
}

impl SimSource {
    /// Place of the camera in the rig.
    #[must_use]
    pub fn slot(&self) -> usize {
        self.slot
    }
}

impl CameraSource for SimSource {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        let sequence = self.next_index;
        if self.frames.is_some_and(|frames| sequence >= frames) {
            let message = format!("the simulation ends after {sequence} frames");
            return Err(CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, message));
        }
        let mut simulator = self.simulator.lock().unwrap_or_else(PoisonError::into_inner);
        let capture_nanos = simulator.frame_nanos(sequence);
        let (image, mask) = simulator.capture(capture_nanos, self.slot).map_err(|error| {
            let kind = match error {
                SimError::Gpu(_) => CaptureErrorKind::Disconnected,
                _ => CaptureErrorKind::Unsupported,
            };
            CaptureError::new(&self.camera, kind, error.to_string())
        })?;
        self.next_index += 1;
        Ok(Frame {
            camera: self.camera.clone(),
            sequence,
            capture_nanos,
            exposure_nanos: Some(0),
            image,
            mask: Some(mask),
        })
    }
}
