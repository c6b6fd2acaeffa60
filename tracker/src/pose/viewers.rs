//! Pose estimation in each camera independently, so that wrong timestamps and extrinsics do not affect the result.
//!
//! The calibration from a person and `flyrig sync-check` use it.

use std::sync::Arc;

use flyrig_body::Template;
use flyrig_types::{Frame, FrameSet, Image, Pose, Rig};
use rayon::prelude::*;

use crate::error::{TrackError, TrackErrorKind};
use crate::network::pose_net::PoseNet;
use crate::pose::config::PoseConfig;
use crate::pose::estimate::PoseEstimate;
use crate::pose::estimator::PoseEstimator;

/// One pose estimator of a single person per camera.
#[derive(Debug, Clone)]
pub struct Viewers {
    alone: Vec<PoseEstimator>,
    /// Estimator with all cameras, which locates the person for a camera that fails alone.
    together: PoseEstimator,
    sets: u64,
}

impl Viewers {
    /// Creates estimators for one person. `plates` are images of the empty scene in rig order.
    ///
    /// # Errors
    /// Those of [`PoseEstimator::new`] and [`PoseEstimator::set_plate`].
    pub fn new(
        net: &PoseNet,
        template: &Template,
        rig: &Rig,
        plates: Vec<Option<Image>>,
        config: &PoseConfig,
    ) -> Result<Self, TrackError> {
        let alone = (rig.cameras.iter().zip(plates))
            .map(|(camera, plate)| {
                let alone = Rig { cameras: vec![camera.clone()], world_up: rig.world_up };
                let mut estimator = PoseEstimator::new(net.clone(), template, &alone, config.clone())?;
                estimator.infer_always(true);
                if let Some(plate) = plate {
                    estimator.set_plate(0, &plate)?;
                }
                Ok(estimator)
            })
            .collect::<Result<_, TrackError>>()?;
        let together = PoseConfig { masks: false, ..config.clone() };
        Ok(Self { alone, together: PoseEstimator::new(net.clone(), template, rig, together)?, sets: 0 })
    }

    /// Estimates the pose in each image of a frame set independently. Timestamps matter only to locate a person whom a
    /// camera does not find alone. Returns `None` for slots without an image or a person.
    ///
    /// # Errors
    /// Those of [`PoseEstimator::estimate`] but `Lost`.
    pub fn estimate(&mut self, set: &FrameSet) -> Result<Vec<Option<PoseEstimate>>, TrackError> {
        self.sets += 1;
        let number = self.sets;
        let estimate = |(estimator, frame): (&mut PoseEstimator, &Option<Arc<Frame>>)| match frame {
            Some(frame) => estimate_alone(estimator, frame, number),
            None => Ok(None),
        };
        let mut found: Vec<Option<PoseEstimate>> =
            self.alone.par_iter_mut().zip(&set.frames).map(estimate).collect::<Result<_, TrackError>>()?;
        if set.present().all(|(slot, _)| found[slot].is_some()) {
            return Ok(found);
        }
        let pose: Pose = match self.together.estimate(set) {
            Ok(estimate) => estimate.pose,
            Err(error) if error.kind == TrackErrorKind::Lost => return Ok(found),
            Err(error) => return Err(error),
        };
        (self.alone.par_iter_mut().zip(&set.frames).zip(&mut found))
            .filter(|(_, found)| found.is_none())
            .try_for_each(|((estimator, frame), found)| -> Result<(), TrackError> {
                if let Some(frame) = frame
                    && estimator.start_from(&pose, frame.capture_nanos)
                {
                    *found = estimate_alone(estimator, frame, number)?;
                }
                Ok(())
            })?;
        Ok(found)
    }
}

/// Estimates the pose in one image; `None` when no person is found.
fn estimate_alone(
    estimator: &mut PoseEstimator,
    frame: &Arc<Frame>,
    index: u64,
) -> Result<Option<PoseEstimate>, TrackError> {
    let set = FrameSet { index, master_nanos: frame.capture_nanos, frames: vec![Some(Arc::clone(frame))] };
    match estimator.estimate(&set) {
        Ok(estimate) => Ok(Some(estimate)),
        Err(error) if error.kind == TrackErrorKind::Lost => Ok(None),
        Err(error) => Err(error),
    }
}
