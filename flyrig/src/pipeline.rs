//! From a frame set to a coloured person: where pose and masks come from, and what to do when they do not.

use anyhow::Result;
use flyrig_tracker::{PoseEstimator, mask_from_plate};
use flyrig_types::{Camera, FrameSet, Image, Mask, Pose, PoseTrack, Rig};

use crate::{
    config::Origin,
    engine::{Engine, InputView, RenderedView},
    pose_curve::PoseCurve,
    stats::StageTimes,
    track_state::{Remedy, TrackWatch},
};

/// Where the pose of an instant comes from.
pub enum PoseSource {
    /// A known curve in time; the flag repeats it for ever.
    Track { track: PoseTrack, repeat: bool },
    /// The pictures.
    Estimator(Box<PoseEstimator>),
}

/// What became of a frame set.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The person was posed and coloured.
    Updated,
    /// Nothing changed, because of this.
    Held(String),
}

/// What went wrong without stopping the pipeline, counted.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Sets that changed the person.
    pub updated: u64,
    /// Sets without a usable pose.
    pub lost: u64,
    /// Pictures that had no mask, or an empty one.
    pub without_mask: u64,
    /// Sets whose deformation was dropped because a number was not finite.
    pub poisoned: u64,
}

/// The stages after synchronisation.
pub struct Pipeline {
    engine: Engine,
    rig: Rig,
    pose: PoseSource,
    masks: Origin,
    /// Empty pictures by slot, where there are any: masks are then the difference to them.
    plates: Vec<Option<Image>>,
    last_pose: Option<Pose>,
    /// Slots of the views that the last update took in.
    viewed: Vec<usize>,
    /// Times of the last poses that were used, for what lies between and beyond them.
    curve: PoseCurve,
    /// How well the person is followed.
    pub watch: TrackWatch,
    /// Whether every picture is explained with the pose of its own capture time, not of the set's.
    pub per_view_time: bool,
    /// Times of every stage so far.
    pub stages: StageTimes,
    /// What happened so far.
    pub counts: Counts,
}

impl Pipeline {
    /// `rig` holds the input cameras in the order of the frame sets.
    pub fn new(engine: Engine, rig: Rig, pose: PoseSource, masks: Origin, plates: Vec<Option<Image>>) -> Self {
        Self {
            engine,
            rig,
            pose,
            masks,
            plates,
            last_pose: None,
            viewed: Vec::new(),
            curve: PoseCurve::default(),
            watch: TrackWatch::default(),
            per_view_time: true,
            stages: StageTimes::default(),
            counts: Counts::default(),
        }
    }

    /// Poses come from here from now on.
    pub fn follow(&mut self, pose: PoseSource) {
        self.pose = pose;
    }

    /// Takes in one frame set. Errors are those that a later frame cannot mend.
    pub fn process(&mut self, set: &FrameSet) -> Result<Outcome> {
        let (pose, masks) = match &mut self.pose {
            PoseSource::Track { track, repeat: true } => (track.at_repeated(set.master_nanos), None),
            PoseSource::Track { track, repeat: false } => (track.at(set.master_nanos), None),
            PoseSource::Estimator(estimator) => {
                match self.stages.time("pose from pictures", || estimator.estimate(set)) {
                    Ok(estimate) => (estimate.pose, Some(estimate.masks)),
                    Err(error) => {
                        self.counts.lost += 1;
                        self.watch.away(set.master_nanos);
                        return Ok(Outcome::Held(error.to_string()));
                    }
                }
            }
        };
        if !pose.is_valid() {
            self.counts.lost += 1;
            self.watch.away(set.master_nanos);
            return Ok(Outcome::Held("the pose holds numbers that are not finite".to_owned()));
        }
        let masks = self.masks(set, masks)?;
        self.curve.push(set.master_nanos, &pose);
        let poses: Vec<Option<Pose>> =
            set.present().map(|(_, frame)| self.pose_at(frame.capture_nanos, set.master_nanos)).collect();
        let (slots, views): (Vec<usize>, Vec<InputView<'_>>) = set
            .present()
            .zip(&masks)
            .zip(&poses)
            .filter_map(|(((slot, frame), mask), pose)| {
                let mask = mask.as_ref().map(MaskOf::mask).filter(|mask| mask.area_px() > 0)?;
                let camera = &self.rig.cameras[slot];
                Some((slot, InputView { camera, image: &frame.image, mask, pose: pose.as_ref() }))
            })
            .unzip();
        for ((_, frame), mask) in set.present().zip(&masks) {
            if mask.as_ref().is_none_or(|mask| mask.mask().area_px() == 0) {
                self.counts.without_mask += 1;
                // The 1st, 2nd, 4th ...: a camera that sees nobody all night must not fill the disk.
                if self.counts.without_mask.is_power_of_two() {
                    let (camera, count) = (&frame.camera, self.counts.without_mask);
                    tracing::warn!(set = set.index, %camera, count, "no person in the mask; going on without this view");
                }
            }
        }
        if views.is_empty() {
            self.watch.away(set.master_nanos);
        } else {
            match self.watch.arrive(set.master_nanos, &pose) {
                Remedy::Forget => self.engine.forget(),
                Remedy::Restart => self.engine.restart(),
                Remedy::None => {}
            }
        }
        self.viewed = slots;
        self.engine.update(&pose, &views, &mut self.stages)?;
        if !views.is_empty() {
            let ids = views.iter().map(|view| view.camera.id.clone());
            self.watch.judge(ids.zip(self.engine.agreement()).filter_map(|(id, quality)| Some((id, quality?))));
        }
        self.counts.poisoned += u64::from(self.engine.deform_report().is_some_and(|report| report.poisoned));
        self.last_pose = Some(pose);
        self.counts.updated += 1;
        Ok(Outcome::Updated)
    }

    /// Pose at a picture's own time, where that is another than the set's.
    fn pose_at(&self, nanos: i64, master_nanos: i64) -> Option<Pose> {
        if !self.per_view_time || nanos == master_nanos {
            return None;
        }
        let pose = match &self.pose {
            PoseSource::Track { track, repeat: true } => Some(track.at_repeated(nanos)),
            PoseSource::Track { track, repeat: false } => Some(track.at(nanos)),
            PoseSource::Estimator(_) => self.curve.at(nanos),
        };
        pose.filter(Pose::is_valid)
    }

    /// A mask a present frame, in their order.
    fn masks<'a>(
        &mut self,
        set: &'a FrameSet,
        estimated: Option<Vec<Option<Mask>>>,
    ) -> Result<Vec<Option<MaskOf<'a>>>> {
        let mut estimated = estimated.unwrap_or_default();
        let mut masks = Vec::new();
        for (slot, frame) in set.present() {
            masks.push(match self.masks {
                Origin::Given => frame.mask.as_ref().map(MaskOf::Given),
                Origin::Estimated => match estimated.get_mut(slot).and_then(Option::take) {
                    Some(mask) => Some(MaskOf::Made(mask)),
                    None => match self.plates.get(slot).and_then(Option::as_ref) {
                        Some(plate) => self
                            .stages
                            .time("mask from plate", || mask_from_plate(&frame.image, plate))?
                            .map(MaskOf::Made),
                        None => None,
                    },
                },
            });
        }
        Ok(masks)
    }

    /// Draws the person of the last update.
    pub fn render(&mut self, camera: &Camera) -> Result<RenderedView> {
        self.engine.render(camera, &mut self.stages)
    }

    /// Cameras whose pictures the last update took in, in the order of [`Engine::input`].
    pub fn viewed(&self) -> Vec<Camera> {
        self.viewed.iter().map(|&slot| self.rig.cameras[slot].clone()).collect()
    }

    /// Pose of the last update.
    pub fn pose(&self) -> Option<&Pose> {
        self.last_pose.as_ref()
    }

    /// Pose in which the last update drew the person: an estimated one with what the solver corrected.
    pub fn drawn_pose(&self) -> Option<Pose> {
        self.last_pose.as_ref().map(|pose| self.engine.corrected(pose))
    }

    /// The engine, for exports.
    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// The engine, to be told more.
    pub fn engine_mut(&mut self) -> &mut Engine {
        &mut self.engine
    }

    /// The input cameras.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }
}

enum MaskOf<'a> {
    Given(&'a Mask),
    Made(Mask),
}

impl MaskOf<'_> {
    fn mask(&self) -> &Mask {
        match self {
            Self::Given(mask) => mask,
            Self::Made(mask) => mask,
        }
    }
}
