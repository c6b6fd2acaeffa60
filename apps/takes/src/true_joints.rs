//! Estimated poses with some true joints, which measure the cost of each part of a pose.

use flyrig_body::Template;
use flyrig_fusion::{
    Effort, EstimatedPerception, FusionError, KnownPerson, Perception, PersonObservation, SeenPerson, StageTimes,
};
use flyrig_types::{FrameSet, Pose, PoseTrack};
use glam::DQuat;

/// Name that selects the true position of the root joint.
const PLACE: &str = "place";

/// Perception that replaces world orientations of joints by the true ones. Template and track share a skeleton.
pub(crate) struct TrueJoints {
    pub inner: EstimatedPerception,
    pub template: Template,
    pub track: PoseTrack,
    /// Substrings of the joints' names, or [`PLACE`].
    pub names: Vec<String>,
}

impl TrueJoints {
    /// Returns `pose` with the chosen joints in the world orientations of `truth`.
    fn mix(&self, pose: &Pose, truth: &Pose) -> Pose {
        let joints = self.template.skeleton.joints();
        let is_true =
            |joint: usize| self.names.iter().any(|name| joints.get(joint).is_some_and(|of| of.name.contains(name)));
        let world = |pose: &Pose| {
            let mut world: Vec<DQuat> = Vec::with_capacity(joints.len());
            for (joint, rotation) in joints.iter().zip(&pose.joint_rotations) {
                let parent = joint.parent.map_or(DQuat::IDENTITY, |parent| world[parent]);
                world.push((parent * *rotation).normalize());
            }
            world
        };
        let (ours, theirs) = (world(pose), world(truth));
        let mixed: Vec<DQuat> =
            (0..ours.len().min(theirs.len())).map(|j| if is_true(j) { theirs[j] } else { ours[j] }).collect();
        let local = |(joint, world): (usize, &DQuat)| match joints[joint].parent {
            Some(parent) => (mixed[parent].inverse() * *world).normalize(),
            None => *world,
        };
        let root = if self.names.iter().any(|name| name == PLACE) { truth } else { pose };
        let joint_rotations = mixed.iter().enumerate().map(local).collect();
        Pose { root_translation: root.root_translation, joint_rotations }
    }
}

impl Perception for TrueJoints {
    fn people(&self) -> Vec<KnownPerson<'_>> {
        self.inner.people()
    }

    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError> {
        let truth = self.track.at(set.master_nanos);
        let observed = self.inner.observe(set, stages)?;
        let mixed = observed.into_iter().map(|observation| match observation {
            PersonObservation::Seen(seen) => {
                PersonObservation::Seen(SeenPerson { pose: self.mix(&seen.pose, &truth), ..seen })
            }
            lost @ PersonObservation::Lost { .. } => lost,
        });
        Ok(mixed.collect())
    }

    fn set_effort(&mut self, effort: Effort) {
        self.inner.set_effort(effort);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};
    use flyrig_fusion::PerceptionSettings;
    use flyrig_types::{Camera, Intrinsics, Isometry, Rig};
    use glam::DVec3;

    use super::*;

    #[test]
    fn chosen_joints_stand_as_in_the_truth_and_the_others_as_estimated() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let joints = template.skeleton.joints();
        let turned = |angle: f64| {
            let mut pose = template.skeleton.rest_pose();
            for (k, rotation) in pose.joint_rotations.iter_mut().enumerate() {
                *rotation *= DQuat::from_scaled_axis(DVec3::new(0.1, 0.2, 0.3) * angle * (k as f64 * 0.7).sin());
            }
            pose.root_translation = DVec3::splat(angle);
            pose
        };
        let (ours, truth) = (turned(0.3), turned(-0.5));
        let track = PoseTrack::new(vec![(0, truth.clone()), (1_000, truth.clone())]).unwrap();
        let camera = Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: "a".into(),
            intrinsics: Intrinsics::pinhole(64, 64, 60.0),
            camera_from_world: Isometry::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::Z, DVec3::Z),
        };
        let rig = Rig { cameras: vec![camera], world_up: DVec3::Z };
        let mix = |names: &[&str]| {
            let inner = EstimatedPerception::new(&rig, &template, &PerceptionSettings::default(), &[None]).unwrap();
            let names = names.iter().map(|name| (*name).to_owned()).collect();
            TrueJoints { inner, template: template.clone(), track: track.clone(), names }.mix(&ours, &truth)
        };
        let world = |pose: &Pose| -> Vec<DQuat> {
            template.skeleton.world_from_joint(pose).iter().map(|m| m.to_scale_rotation_translation().1).collect()
        };
        let mixed = mix(&["Arm", "place"]);
        assert_eq!(mixed.root_translation, truth.root_translation);
        for (k, ((mixed, ours), truth)) in world(&mixed).iter().zip(world(&ours)).zip(world(&truth)).enumerate() {
            let expected = if joints[k].name.contains("Arm") { truth } else { ours };
            assert!(mixed.dot(expected).abs() > 1.0 - 1e-9, "{}", joints[k].name);
        }
        let same = |a: &Pose, b: &Pose| {
            a.joint_rotations.iter().zip(&b.joint_rotations).all(|(a, b)| a.dot(*b).abs() > 1.0 - 1e-9)
        };
        assert!(same(&mix(&[]), &ours) && same(&mix(&[""]), &truth));
    }
}
