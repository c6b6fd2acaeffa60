//! Frame sources of simulated cameras.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind, SourceHealth};
use flyrig_types::{CameraId, Frame, Image, lock};

use crate::camera::clock::RealClock;
use crate::camera::clock::SimTime;
use crate::camera::faults::{Delivery, FramePlan};
use crate::camera::shot::Shot;
use crate::error::SimError;
use crate::simulator::Simulator;

/// Frame source of one camera of a [`Simulator`]. All sources of a simulator see the same instants except for the
/// configured faults. Dropping it removes the camera from the rig.
#[derive(Debug)]
pub struct SimSource {
    simulator: Arc<Mutex<Simulator>>,
    /// Clock in [`SimTime::Real`].
    clock: Option<Arc<RealClock>>,
    camera: CameraId,
    slot: usize,
    next_index: u64,
    /// Index of the frame with sequence number 0.
    first_index: u64,
    /// Due time of the last frame.
    order_nanos: Option<i64>,
    disconnected: bool,
    frames: Option<u64>,
    /// Frames per second.
    fps: f64,
    health: SourceHealth,
}

/// Consecutive lost frames after which a call returns, so that it never blocks for ever.
const MOST_DROPPED: u32 = 64;

/// Creates a source for every camera of the rig, in rig order. In [`SimTime::Real`] each needs a thread of its own,
/// since all wait for each other.
#[must_use]
pub fn sources(simulator: &Arc<Mutex<Simulator>>, time: SimTime) -> Vec<SimSource> {
    let guard = lock(simulator);
    let (frames, fps) = (guard.config().frames, guard.config().fps);
    let mode: Arc<str> = format!("{}x{} at {fps:.2}", guard.config().width, guard.config().height).into();
    let clock = match time {
        SimTime::Exact => None,
        SimTime::Real => Some(Arc::new(RealClock::new(guard.rig().cameras.len(), guard.config().fps))),
    };
    let camera_ids = guard.rig().cameras.iter().map(|camera| camera.id.clone());
    camera_ids
        .enumerate()
        .map(|(slot, camera)| SimSource {
            simulator: Arc::clone(simulator),
            clock: clock.clone(),
            camera,
            slot,
            next_index: 0,
            first_index: 0,
            order_nanos: None,
            disconnected: false,
            frames,
            fps,
            health: SourceHealth { mode: Arc::clone(&mode), ..SourceHealth::default() },
        })
        .collect()
}

impl SimSource {
    /// Returns the slot of the camera in the rig.
    #[must_use]
    pub fn slot(&self) -> usize {
        self.slot
    }
}

impl Drop for SimSource {
    fn drop(&mut self) {
        if let Some(clock) = &self.clock {
            clock.leave(self.slot);
        }
    }
}

impl CameraSource for SimSource {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let result = self.next_delivery(timeout);
        if let (Err(_), Some(clock)) = (&result, &self.clock) {
            // Whoever reads this source may pause after an error.
            clock.leave(self.slot);
        }
        result
    }

    /// Returns the due time of the frame: timestamps may be wrong, but not the order in which frames arrive.
    fn order_nanos(&self, frame: &Frame) -> i64 {
        self.order_nanos.unwrap_or(frame.capture_nanos)
    }

    fn next_nanos(&self) -> Option<i64> {
        Some((self.next_index as f64 * 1e9 / self.fps) as i64)
    }

    fn health(&self) -> SourceHealth {
        self.health.clone()
    }
}

impl SimSource {
    fn next_delivery(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let mut dropped = 0;
        loop {
            if let Some(clock) = &self.clock {
                self.next_index = clock.next(self.slot, timeout).ok_or_else(|| {
                    CaptureError::new(&self.camera, CaptureErrorKind::Timeout, "no instant was due in time")
                })?;
            }
            let index = self.next_index;
            if self.frames.is_some_and(|frames| index >= frames) {
                let message = format!("the simulation ends after {} frames", self.frames.unwrap_or(index));
                return Err(CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, message));
            }
            self.next_index += 1;
            let shared = Arc::clone(&self.simulator);
            let mut simulator = lock(&shared);
            let plan = simulator
                .plan(self.slot, index)
                .map_err(|error| CaptureError::new(&self.camera, CaptureErrorKind::Unsupported, error.to_string()))?;
            let fault = |kind, message: &str| Err(CaptureError::new(&self.camera, kind, message));
            match plan.delivery {
                Delivery::Frame => {
                    if self.disconnected {
                        (self.disconnected, self.first_index) = (false, index);
                    }
                    self.order_nanos = Some(simulator.frame_nanos(index));
                    return self.taken(&mut simulator, index, plan);
                }
                Delivery::Dropped => {
                    dropped += 1;
                    if dropped >= MOST_DROPPED {
                        return fault(CaptureErrorKind::Timeout, "all frames are dropped by the fault script");
                    }
                }
                Delivery::Stalled => return fault(CaptureErrorKind::Timeout, "stalled by the fault script"),
                Delivery::Disconnected => {
                    self.disconnected = true;
                    return fault(CaptureErrorKind::Disconnected, "disconnected by the fault script");
                }
                Delivery::Undecodable => {
                    return fault(CaptureErrorKind::Corrupt, "frame made undecodable by the fault script");
                }
            }
        }
    }

    fn taken(&self, simulator: &mut Simulator, index: u64, plan: FramePlan) -> Result<Frame, CaptureError> {
        let taken = simulator
            .capture_with(&shot(&plan, self.slot))
            .and_then(|(image, mask)| Ok((corrupted(simulator, &plan, index, image)?, mask)));
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

/// Returns the shot that a fault script makes of a frame.
pub(crate) fn shot(plan: &FramePlan, slot: usize) -> Shot {
    Shot { exposure: plan.exposure, camera_shift: plan.bump, ..Shot::new(plan.true_nanos, slot) }
}

/// Returns an image with noise over its lower part, where the fault script says so.
pub(crate) fn corrupted(simulator: &Simulator, plan: &FramePlan, index: u64, image: Image) -> Result<Image, SimError> {
    let Some(share) = plan.sound_share else { return Ok(image) };
    let mut rgb = image.bytes().to_vec();
    simulator.config().faults.corrupt(&mut rgb, share, index);
    Ok(Image::new(image.width(), image.height(), image.format(), rgb)?)
}
