//! People whose poses are known: a simulator's, a recorded motion's.

use std::borrow::Cow;

use flyrig_body::{Template, skin_mesh};
use flyrig_tracker::mask_from_plate;
use flyrig_types::{Camera, FrameSet, Image, Mask, PersonId, Pose, PoseTrack, Rig};

use super::split_mask::{PosedMesh, split_mask};
use super::{Observation, Perception, SeenPerson, ViewObservation};
use crate::{FusionError, Origin, StageTimes};

/// One person with a known motion.
#[derive(Debug, Clone)]
pub struct GivenPerson {
    /// Who.
    pub person: PersonId,
    /// Shape, skin and skeleton.
    pub template: Template,
    /// Poses over time.
    pub track: PoseTrack,
    /// Whether the motion starts again at its end.
    pub repeat: bool,
}

impl GivenPerson {
    fn at(&self, nanos: i64) -> Pose {
        if self.repeat { self.track.at_repeated(nanos) } else { self.track.at(nanos) }
    }
}

/// Poses from tracks; masks from the frames, or from the difference to the empty scene.
#[derive(Debug)]
pub struct GivenPerception {
    people: Vec<GivenPerson>,
    cameras: Vec<Camera>,
    masks: Origin,
    /// Images of the empty scene by slot.
    plates: Vec<Option<Image>>,
}

impl GivenPerception {
    /// Observes these people with the cameras of `rig`, taking the masks from the frames. A frame's mask covers everybody: it
    /// is divided among several people by their posed bodies.
    #[must_use]
    pub fn new(rig: &Rig, people: Vec<GivenPerson>) -> Self {
        let plates = rig.cameras.iter().map(|_| None).collect();
        Self { people, cameras: rig.cameras.clone(), masks: Origin::Given, plates }
    }

    /// Observes one person who repeats a motion for ever.
    #[must_use]
    pub fn repeating(rig: &Rig, template: Template, track: PoseTrack) -> Self {
        Self::new(rig, vec![GivenPerson { person: PersonId::default(), template, track, repeat: true }])
    }

    /// Makes masks from the difference to images of the empty scene, one slot a camera, where `masks` is estimated.
    #[must_use]
    pub fn with_masks(self, masks: Origin, plates: Vec<Option<Image>>) -> Self {
        Self { masks, plates, ..self }
    }
}

impl Perception for GivenPerception {
    fn people(&self) -> Vec<(PersonId, &Template)> {
        self.people.iter().map(|given| (given.person, &given.template)).collect()
    }

    fn observe<'a>(&mut self, set: &'a FrameSet, stages: &mut StageTimes) -> Result<Vec<Observation<'a>>, FusionError> {
        let poses: Vec<Pose> = self.people.iter().map(|given| given.at(set.master_nanos)).collect();
        let mut masks = Vec::new();
        for (slot, frame) in set.present() {
            masks.push(match (self.masks, self.plates.get(slot).and_then(Option::as_ref)) {
                (Origin::Given, _) => frame.mask.as_ref().map(Cow::Borrowed),
                (Origin::Estimated, None) => None,
                (Origin::Estimated, Some(plate)) => {
                    stages.time("mask from plate", || mask_from_plate(&frame.image, plate))?.map(Cow::Owned)
                }
            });
        }
        let confidence = if self.masks == Origin::Given { 1.0 } else { 0.5 };
        let views = match self.people.as_slice() {
            [_] => vec![masks.into_iter().map(|mask| ViewObservation::of_mask(mask, confidence)).collect()],
            people => stages.time("divide masks", || self.divide(set, people, &poses, &masks, confidence)),
        };
        let seen = |((given, pose), views): ((&GivenPerson, Pose), Vec<ViewObservation<'a>>)| {
            let person = given.person;
            if pose.is_valid() {
                Observation::Seen(SeenPerson { person, pose, confidence: 1.0, views })
            } else {
                Observation::Lost { person, reason: "the pose holds numbers that are not finite".to_owned() }
            }
        };
        Ok(self.people.iter().zip(poses).zip(views).map(seen).collect())
    }

    fn pose_at(&self, person: PersonId, nanos: i64) -> Option<Pose> {
        self.people.iter().find(|given| given.person == person).map(|given| given.at(nanos))
    }
}

impl GivenPerception {
    /// Divides everybody's masks: by person, then by present frame.
    fn divide<'a>(
        &self,
        set: &'a FrameSet,
        people: &[GivenPerson],
        poses: &[Pose],
        masks: &[Option<Cow<'a, Mask>>],
        confidence: f64,
    ) -> Vec<Vec<ViewObservation<'a>>> {
        let mut views: Vec<Vec<ViewObservation<'a>>> = people.iter().map(|_| Vec::new()).collect();
        for ((slot, frame), mask) in set.present().zip(masks) {
            let Some((mask, camera)) = mask.as_ref().zip(self.cameras.get(slot)) else {
                views.iter_mut().for_each(|views| views.push(ViewObservation::default()));
                continue;
            };
            // Each image shows the bodies at its own time.
            let meshes: Vec<PosedMesh<'_>> = people
                .iter()
                .zip(poses)
                .map(|(given, pose)| {
                    let own = given.at(frame.capture_nanos);
                    let pose = if own.is_valid() { &own } else { pose };
                    let vertices = skin_mesh(&given.template, pose).0;
                    PosedMesh { vertices, triangles: &given.template.triangles }
                })
                .collect();
            for (views, (own, others)) in views.iter_mut().zip(split_mask(camera, mask, &meshes)) {
                let mut view = ViewObservation::of_mask(Some(Cow::Owned(own)), confidence);
                view.others = Some(others);
                views.push(view);
            }
        }
        views
    }
}
