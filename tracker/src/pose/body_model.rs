//! A template's skeleton as the solver sees it: rotations away from the bind pose, in canonical axes.
//!
//! With `G_j` the rotation of joint j's flesh from canonical axes to the world, the parameters are
//! `A_j = G_parent⁻¹ G_j`: identity in the bind pose for every joint, in axes that mean the same for every
//! skeleton (x left, y up, z forward).

use flyrig_body::Template;
use flyrig_types::Pose;
use glam::{DQuat, DVec3};

use crate::error::{TrackError, TrackErrorKind};
use crate::landmarks::bias::add_biases;
use crate::landmarks::keypoints::{LANDMARK_COUNT, LEFT_HIP, LEFT_SHOULDER, RIGHT_HIP, RIGHT_SHOULDER};
use crate::landmarks::surface_marks::{BodyMark, find_marks};
use crate::pose::anatomy::{JointRange, Roles, joint_ranges};

/// Rotations of all joints and the root's place in the world.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct JointTurns {
    /// Origin of the root joint, world metres.
    pub root: DVec3,
    /// `A_j`; for the root `G_root`.
    pub turns: Vec<DQuat>,
}

impl JointTurns {
    /// Extrapolates the motion from `before` to here by a share of it.
    pub fn advanced(&self, before: &Self, share: f64) -> Self {
        let turn = |(now, before): (&DQuat, &DQuat)| {
            let change = (*now * before.inverse()).normalize();
            // Takes the shorter way round.
            let change = if change.w < 0.0 { -change } else { change };
            (DQuat::from_scaled_axis(change.to_scaled_axis() * share) * *now).normalize()
        };
        Self {
            root: self.root + (self.root - before.root) * share,
            turns: self.turns.iter().zip(&before.turns).map(turn).collect(),
        }
    }
}

/// Skeleton in the world.
#[derive(Debug, Clone)]
pub(crate) struct PosedSkeleton {
    /// `G_j`.
    pub rotation: Vec<DQuat>,
    /// Joint origins, metres.
    pub origin: Vec<DVec3>,
}

/// Skeleton of a template with roles, ranges and landmarks.
#[derive(Debug, Clone)]
pub(crate) struct BodyModel {
    pub parents: Vec<Option<usize>>,
    /// Rotation of `canonical_from_joint`.
    pub bind_rotation: Vec<DQuat>,
    /// Joint origins in canonical space, metres.
    pub origins: Vec<DVec3>,
    /// Joint origins relative to their parents', canonical axes, metres.
    pub offsets: Vec<DVec3>,
    pub roles: Roles,
    pub ranges: Vec<Option<JointRange>>,
    pub marks: [BodyMark; LANDMARK_COUNT],
}

impl BodyModel {
    /// Reads a template, with landmarks at the biased places where the network finds them.
    ///
    /// # Errors
    /// Kind `Template` when joints or skin are missing or not finite.
    pub fn new(template: &Template) -> Result<Self, TrackError> {
        let mut model = Self::with_anatomical_marks(template)?;
        add_biases(template, &mut model.marks);
        Ok(model)
    }

    /// Reads a template, with landmarks at their anatomical places.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn with_anatomical_marks(template: &Template) -> Result<Self, TrackError> {
        let joints = template.skeleton.joints();
        let roles = Roles::find(&template.skeleton, &template.name)?;
        let canonical_from_joint: Vec<_> = joints.iter().map(|joint| joint.joint_from_canonical.inverse()).collect();
        let bind_rotation: Vec<DQuat> =
            canonical_from_joint.iter().map(|m| m.to_scale_rotation_translation().1.normalize()).collect();
        let origins: Vec<DVec3> = canonical_from_joint.iter().map(|m| m.w_axis.truncate()).collect();
        let parents: Vec<Option<usize>> = joints.iter().map(|joint| joint.parent).collect();
        let offsets = joints
            .iter()
            .map(|joint| joint.parent.map_or(DVec3::ZERO, |parent| bind_rotation[parent] * joint.rest_translation))
            .collect();
        let finite = template.positions.iter().all(|p| p.is_finite())
            && template.skin.len() == template.positions.len()
            && template.skin.iter().all(|s| s.joints.iter().all(|&j| usize::from(j) < joints.len()))
            && origins.iter().all(|o| o.is_finite())
            && bind_rotation.iter().all(|q| q.is_finite());
        if !finite {
            return Err(TrackError::new(
                TrackErrorKind::Template,
                format!("template '{}' holds numbers that are not finite or skin for joints it has not", template.name),
            ));
        }
        let marks = find_marks(template, &roles, &origins)?;
        let ranges = joint_ranges(&template.skeleton, &roles, &origins);
        Ok(Self { parents, bind_rotation, origins, offsets, roles, ranges, marks })
    }

    /// Returns the bind pose with the root joint at a place, world metres.
    pub fn bind_turns(&self, root: DVec3) -> JointTurns {
        JointTurns { root, turns: vec![DQuat::IDENTITY; self.parents.len()] }
    }

    /// Computes forward kinematics.
    pub fn pose(&self, turns: &JointTurns) -> PosedSkeleton {
        let mut posed = PosedSkeleton { rotation: Vec::with_capacity(self.parents.len()), origin: Vec::new() };
        for (joint, parent) in self.parents.iter().enumerate() {
            let (rotation, origin) = match *parent {
                None => (turns.turns[joint], turns.root),
                Some(parent) => (
                    posed.rotation[parent] * turns.turns[joint],
                    posed.origin[parent] + posed.rotation[parent] * self.offsets[joint],
                ),
            };
            posed.rotation.push(rotation.normalize());
            posed.origin.push(origin);
        }
        posed
    }

    /// Returns the world position of a landmark, metres.
    pub fn mark(&self, posed: &PosedSkeleton, landmark: usize) -> DVec3 {
        let mark = &self.marks[landmark];
        posed.origin[mark.joint] + posed.rotation[mark.joint] * (mark.point - self.origins[mark.joint])
    }

    /// Returns the world positions of all landmarks, metres.
    pub fn marks(&self, turns: &JointTurns) -> [DVec3; LANDMARK_COUNT] {
        let posed = self.pose(turns);
        std::array::from_fn(|i| self.mark(&posed, i))
    }

    /// Converts to a pose of the template's skeleton.
    pub fn to_pose(&self, turns: &JointTurns) -> Pose {
        let rotations = self.parents.iter().enumerate().map(|(joint, parent)| {
            let bind = self.bind_rotation[joint];
            match *parent {
                None => turns.turns[joint] * bind,
                Some(parent) => self.bind_rotation[parent].inverse() * turns.turns[joint] * bind,
            }
            .normalize()
        });
        Pose { root_translation: turns.root, joint_rotations: rotations.collect() }
    }

    /// Converts from a pose of the template's skeleton; `None` when it does not fit the skeleton or is not finite.
    pub fn to_turns(&self, pose: &Pose) -> Option<JointTurns> {
        if !pose.is_valid() || pose.joint_rotations.len() != self.parents.len() {
            return None;
        }
        let turns = self.parents.iter().enumerate().map(|(joint, parent)| {
            let local = pose.joint_rotations[joint];
            let unbind = self.bind_rotation[joint].inverse();
            match *parent {
                None => local * unbind,
                Some(parent) => self.bind_rotation[parent] * local * unbind,
            }
            .normalize()
        });
        Some(JointTurns { root: pose.root_translation, turns: turns.collect() })
    }

    /// Returns the distance from the middle of the hips to the middle of the shoulders, metres.
    pub fn trunk_length(&self) -> f64 {
        let at = |i: usize| self.marks[i].point;
        (0.5 * (at(LEFT_SHOULDER) + at(RIGHT_SHOULDER)) - 0.5 * (at(LEFT_HIP) + at(RIGHT_HIP))).length()
    }

    /// Whether a joint is beyond the wrist.
    pub fn is_finger(&self, joint: usize) -> bool {
        self.roles.hand.iter().any(|&hand| joint != hand && self.hangs_below(joint, hand))
    }

    /// Whether a joint hangs below another or is it.
    pub fn hangs_below(&self, mut joint: usize, ancestor: usize) -> bool {
        // Parents come before their children.
        while joint > ancestor {
            match self.parents[joint] {
                Some(parent) => joint = parent,
                None => return false,
            }
        }
        joint == ancestor
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{body, random_turns};

    #[test]
    fn our_kinematics_agree_with_the_skeletons() {
        let template = body();
        let model = BodyModel::new(&template).unwrap();
        let turns = random_turns(&model, 3);
        let pose = model.to_pose(&turns);
        let world_from_canonical = template.skeleton.world_from_canonical(&pose);
        for (i, mark) in model.marks(&turns).into_iter().enumerate() {
            let expected = world_from_canonical[model.marks[i].joint].transform_point3(model.marks[i].point);
            assert!((mark - expected).length() < 1e-6, "landmark {i}: {mark} {expected}");
        }
        let back = model.to_turns(&pose).unwrap();
        for (a, b) in turns.turns.iter().zip(&back.turns) {
            assert!(a.dot(*b).abs() > 1.0 - 1e-9);
        }
    }

    #[test]
    fn the_marks_lie_where_a_person_has_them() {
        let template = body();
        let model = BodyModel::new(&template).unwrap();
        let at = |landmark: usize| model.marks[landmark].point;
        for (left, right) in
            [(2, 5), (7, 8), (9, 10), (11, 12), (15, 16), (17, 18), (19, 20), (21, 22), (29, 30), (31, 32)]
        {
            assert!(at(left).x > 0.005 && at(right).x < -0.005, "{left} {right}");
            assert!((at(left).x + at(right).x).abs() < 0.02, "{left} {right} are not mirrored");
        }
        assert!(at(0).y > at(9).y && at(2).y > at(0).y, "eyes over nose over mouth");
        assert!(at(0).z > at(7).z + 0.05, "the nose is in front of the ears");
        assert!(at(31).z > at(29).z + 0.15, "toes are in front of the heels");
        for (finger, most) in [(17, 0.16), (19, 0.16), (21, 0.13)] {
            let distance = (at(finger) - at(15)).length();
            assert!((0.03..most).contains(&distance), "landmark {finger} is {distance} m from the wrist");
        }
        // The network's biases bring these two together.
        let anatomical = BodyModel::with_anatomical_marks(&template).unwrap().marks;
        let width = (anatomical[17].point - anatomical[19].point).length();
        assert!(width > 0.03, "the hand has a width of {width} m");
    }

    #[test]
    fn a_pose_that_is_not_finite_is_refused() {
        let model = BodyModel::new(&body()).unwrap();
        let mut pose = model.to_pose(&model.bind_turns(DVec3::ZERO));
        pose.joint_rotations[3].x = f64::NAN;
        assert!(model.to_turns(&pose).is_none());
    }
}
