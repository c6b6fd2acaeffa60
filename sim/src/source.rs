//! Simulated cameras behind the capture trait.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind};
use flyrig_types::{CameraId, Frame, Image};

use crate::{Delivery, FramePlan, SimError, Simulator};

/// One camera of a [`Simulator`]. Simulated time moves by exactly one frame interval a call, whatever the
/// wall clock does; all sources of a simulator see the same instants but for what the configured faults do.
#[derive(Debug)]
pub struct SimSource {
    simulator: Arc<Mutex<Simulator>>,
    camera: CameraId,
    slot: usize,
    next_index: u64,
    /// Frame that has the sequence number 0.
    first_index: u64,
    disconnected: bool,
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
        .map(|(slot, camera)| SimSource {
            simulator: Arc::clone(simulator),
            camera,
            slot,
            next_index: 0,
            first_index: 0,
            disconnected: false,
            frames,
        })
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
        let shared = Arc::clone(&self.simulator);
        let mut simulator = shared.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let index = self.next_index;
            if self.frames.is_some_and(|frames| index >= frames) {
                let message = format!("the simulation ends after {index} frames");
                return Err(CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, message));
            }
            let plan = simulator.config().faults.plan(&self.camera, index, |index| simulator.frame_nanos(index));
            let fault = |kind, message: &str| Err(CaptureError::new(&self.camera, kind, message));
            match plan.delivery {
                Delivery::Frame => {
                    if self.disconnected {
                        (self.disconnected, self.first_index) = (false, index);
                    }
                    let frame = self.taken(&mut simulator, index, plan)?;
                    self.next_index += 1;
                    return Ok(frame);
                }
                Delivery::Dropped => self.next_index += 1,
                Delivery::Stalled => {
                    self.next_index += 1;
                    return fault(CaptureErrorKind::Timeout, "stalled by the fault script");
                }
                Delivery::Disconnected => {
                    self.next_index += 1;
                    self.disconnected = true;
                    return fault(CaptureErrorKind::Disconnected, "disconnected by the fault script");
                }
                Delivery::Undecodable => {
                    self.next_index += 1;
                    return fault(CaptureErrorKind::Corrupt, "frame made undecodable by the fault script");
                }
            }
        }
    }
}

impl SimSource {
    fn taken(&self, simulator: &mut Simulator, index: u64, plan: FramePlan) -> Result<Frame, CaptureError> {
        let taken = simulator.capture_exposed(plan.true_nanos, self.slot, plan.exposure).and_then(|(image, mask)| {
            let Some(share) = plan.sound_share else { return Ok((image, mask)) };
            let mut rgb = image.bytes().to_vec();
            simulator.config().faults.spoil(&mut rgb, share, index);
            Ok((Image::new(image.width(), image.height(), image.format(), rgb)?, mask))
        });
        let (image, mask) = taken.map_err(|error| {
            let kind = match error {
                SimError::Gpu(_) => CaptureErrorKind::Disconnected,
                _ => CaptureErrorKind::Unsupported,
            };
            CaptureError::new(&self.camera, kind, error.to_string())
        })?;
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: index - self.first_index,
            capture_nanos: plan.stamp_nanos,
            exposure_nanos: Some(0),
            image,
            mask: Some(mask),
        })
    }
}
