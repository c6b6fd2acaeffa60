//! Silhouettes of one person in the pictures of every camera by itself; stamps only help to find whom a camera misses.

use std::sync::Arc;

use anyhow::Result;
use flyrig_body::{ShapeParams, default_template};
use flyrig_sync::SilhouetteTrack;
use flyrig_tracker::{PoseConfig, PoseEstimator, PoseNet, TrackErrorKind};
use flyrig_types::{Camera, Frame, FrameSet, Image, Pose, Rig};
use glam::DVec3;
use rayon::prelude::*;

/// Finds silhouettes.
pub struct Silhouettes {
    viewers: Vec<Viewer>,
    /// All cameras at once: finds the person for a camera that does not by itself, from the side for example.
    together: PoseEstimator,
}

impl Silhouettes {
    /// `plates` are empty pictures by slot; `given_masks` uses those that come with the pictures.
    pub fn new(rig: &Rig, plates: Vec<Option<Image>>, given_masks: bool) -> Result<Self> {
        let viewers = (rig.cameras.iter().zip(plates))
            .map(|(camera, plate)| Viewer::new(camera, rig.world_up, plate, given_masks))
            .collect::<Result<_>>()?;
        let config = PoseConfig { masks: false, ..PoseConfig::default() };
        Ok(Self { viewers, together: estimator(rig, config)? })
    }

    /// Adds the pictures of a set. Its stamps are only believed to a stride or so, and only to find who is not seen.
    pub fn add(&mut self, set: &FrameSet) -> Result<()> {
        let look = |(viewer, frame): (&mut Viewer, &Option<Arc<Frame>>)| match frame {
            Some(frame) => viewer.look(frame),
            None => Ok(true),
        };
        let seen: Vec<bool> = self.viewers.par_iter_mut().zip(&set.frames).map(look).collect::<Result<_>>()?;
        if seen.iter().all(|seen| *seen) {
            return Ok(());
        }
        let pose = match self.together.estimate(set) {
            Ok(estimate) => estimate.pose,
            Err(error) if error.kind == TrackErrorKind::Lost => return Ok(()),
            Err(error) => return Err(error.into()),
        };
        (self.viewers.par_iter_mut().zip(&set.frames).zip(seen)).filter(|(_, seen)| !seen).try_for_each(
            |((viewer, frame), _)| match frame {
                Some(frame) => viewer.look_at(frame, &pose),
                None => Ok(()),
            },
        )
    }

    /// What was found, a track a camera.
    pub fn into_tracks(self) -> Vec<SilhouetteTrack> {
        self.viewers.into_iter().map(|viewer| viewer.track).collect()
    }
}

fn estimator(rig: &Rig, config: PoseConfig) -> Result<PoseEstimator> {
    Ok(PoseEstimator::new(PoseNet::embedded()?, &default_template(&ShapeParams::default())?, rig, config)?)
}

/// One camera and the person in its pictures.
struct Viewer {
    estimator: PoseEstimator,
    track: SilhouetteTrack,
    given_masks: bool,
    sets: u64,
}

impl Viewer {
    fn new(camera: &Camera, world_up: DVec3, plate: Option<Image>, given_masks: bool) -> Result<Self> {
        let alone = Rig { cameras: vec![camera.clone()], world_up };
        let mut estimator = estimator(&alone, PoseConfig::default())?;
        if let Some(plate) = plate {
            estimator.set_plate(0, &plate)?;
        }
        Ok(Self { estimator, track: SilhouetteTrack::new(camera), given_masks, sets: 0 })
    }

    /// Adds the silhouette of a picture; false when nobody is found.
    fn look(&mut self, frame: &Arc<Frame>) -> Result<bool> {
        if let Some(mask) = frame.mask.as_ref().filter(|_| self.given_masks) {
            self.track.add(frame.capture_nanos, mask);
            return Ok(true);
        }
        let set =
            FrameSet { index: self.sets, master_nanos: frame.capture_nanos, frames: vec![Some(Arc::clone(frame))] };
        self.sets += 1;
        match self.estimator.estimate(&set) {
            Ok(estimate) => {
                estimate.masks.iter().flatten().for_each(|mask| self.track.add(frame.capture_nanos, mask));
                Ok(true)
            }
            Err(error) if error.kind == TrackErrorKind::Lost => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    /// The same, told where the person is.
    fn look_at(&mut self, frame: &Arc<Frame>, pose: &Pose) -> Result<()> {
        if self.estimator.start_from(pose, frame.capture_nanos) {
            self.look(frame)?;
        }
        Ok(())
    }
}
