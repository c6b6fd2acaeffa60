//! One person in the images of every camera by itself: neither time stamps nor poses of the cameras against each other have a part
//! in what is found.

use std::sync::Arc;

use flyrig_body::Template;
use flyrig_types::{Frame, FrameSet, Image, Pose, Rig};
use rayon::prelude::*;

use crate::{PoseConfig, PoseEstimate, PoseEstimator, PoseNet, TrackError, TrackErrorKind};

/// A pose estimator for each camera.
#[derive(Debug, Clone)]
pub struct Viewers {
    alone: Vec<PoseEstimator>,
    /// All cameras at once: finds the person for a camera that does not by itself, from the side for example.
    together: PoseEstimator,
    sets: u64,
}

impl Viewers {
    /// For any person, from a template; `plates` are empty images by slot.
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
                estimator.look_at_all(true);
                if let Some(plate) = plate {
                    estimator.set_plate(0, &plate)?;
                }
                Ok(estimator)
            })
            .collect::<Result<_, TrackError>>()?;
        let together = PoseConfig { masks: false, ..config.clone() };
        Ok(Self { alone, together: PoseEstimator::new(net.clone(), template, rig, together)?, sets: 0 })
    }

    /// Looks at the images of a set, each by itself. Its stamps are only believed to a stride or so, and only to find who is
    /// not seen. `None` by slot where there is no image, or nobody in it.
    ///
    /// # Errors
    /// Those of [`PoseEstimator::estimate`] but `Lost`.
    pub fn look(&mut self, set: &FrameSet) -> Result<Vec<Option<PoseEstimate>>, TrackError> {
        self.sets += 1;
        let number = self.sets;
        let look = |(estimator, frame): (&mut PoseEstimator, &Option<Arc<Frame>>)| match frame {
            Some(frame) => look_alone(estimator, frame, number),
            None => Ok(None),
        };
        let mut found: Vec<Option<PoseEstimate>> =
            self.alone.par_iter_mut().zip(&set.frames).map(look).collect::<Result<_, TrackError>>()?;
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
                    *found = look_alone(estimator, frame, number)?;
                }
                Ok(())
            })?;
        Ok(found)
    }
}

/// The person in an image; `None` when nobody is found.
fn look_alone(
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
