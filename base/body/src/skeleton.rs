//! Joint trees and forward kinematics.

use flyrig_types::Pose;
use glam::{DMat4, DQuat, DVec3};

use crate::part::part_of_joints;
use crate::{BodyError, Part};

/// Joint of a skeleton.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Name, unique in its skeleton.
    pub name: String,
    /// Index of the parent, smaller than the joint's own; `None` for the root alone.
    pub parent: Option<usize>,
    /// Origin in the parent's frame at rest (root: in the world), metres.
    pub rest_translation: DVec3,
    /// Rotation `parent_from_joint` at rest (root: `world_from_joint`).
    pub rest_rotation: DQuat,
    /// Inverse bind matrix: from canonical mesh space to the joint's frame.
    pub joint_from_canonical: DMat4,
}

impl Joint {
    /// Returns the rotation `canonical_from_joint` in the bind pose.
    pub(crate) fn bind_rotation(&self) -> DQuat {
        let (_, rotation, _) = self.joint_from_canonical.inverse().to_scale_rotation_translation();
        rotation.normalize()
    }
}

/// Tree of joints, parents before children, the root at index 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Skeleton {
    joints: Vec<Joint>,
}

impl Skeleton {
    /// Creates a skeleton from joints in order.
    ///
    /// # Errors
    /// [`BodyError::Skeleton`] when there is no joint, a parent does not come before its child, there is a
    /// second root, a name appears twice or a number is not finite.
    pub fn new(joints: Vec<Joint>) -> Result<Self, BodyError> {
        if joints.is_empty() {
            return Err(BodyError::Skeleton("no joints; a body needs at least one".to_owned()));
        }
        if joints.len() > usize::from(u16::MAX) {
            return Err(BodyError::Skeleton(format!("{} joints, more than the {} allowed", joints.len(), u16::MAX)));
        }
        let mut names = std::collections::HashSet::new();
        for (index, joint) in joints.iter().enumerate() {
            let name = &joint.name;
            match joint.parent {
                None if index > 0 => {
                    let root = &joints[0].name;
                    return Err(BodyError::Skeleton(format!(
                        "joints '{root}' and '{name}' both have no parent; one root is needed"
                    )));
                }
                Some(parent) if parent >= index => {
                    return Err(BodyError::Skeleton(format!("joint '{name}' stands before its parent")));
                }
                _ => {}
            }
            if !names.insert(name.as_str()) {
                return Err(BodyError::Skeleton(format!("two joints are called '{name}'; rename one")));
            }
            let finite = joint.rest_translation.is_finite()
                && joint.rest_rotation.is_finite()
                && joint.joint_from_canonical.is_finite();
            if !finite || !joint.rest_rotation.is_normalized() {
                return Err(BodyError::Skeleton(format!(
                    "joint '{name}' has a number that is not finite or a rest rotation that is not of unit length"
                )));
            }
        }
        Ok(Self { joints })
    }

    /// Returns the joints, parents before children.
    #[must_use]
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Returns the index of the joint with this exact name.
    #[must_use]
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Returns the rest pose: the bind pose for the built-in body; a glTF file may rest in another one.
    #[must_use]
    pub fn rest_pose(&self) -> Pose {
        Pose {
            root_translation: self.joints[0].rest_translation,
            joint_rotations: self.joints.iter().map(|joint| joint.rest_rotation).collect(),
        }
    }

    /// Checks that the pose has one rotation per joint and is finite.
    ///
    /// # Errors
    /// [`BodyError::Pose`] names the fault.
    pub fn check_pose(&self, pose: &Pose) -> Result<(), BodyError> {
        let (found, expected) = (pose.joint_rotations.len(), self.joints.len());
        if found != expected {
            return Err(BodyError::Pose(format!("{found} joint rotations for a skeleton of {expected} joints")));
        }
        if !pose.is_valid() {
            return Err(BodyError::Pose("a number is not finite or a rotation is not of unit length".to_owned()));
        }
        Ok(())
    }

    /// Returns the direction from the feet to the head in a pose, a unit vector in the world; `None` for a skeleton without joints
    /// of these names.
    #[must_use]
    pub fn standing(&self, pose: &Pose) -> Option<DVec3> {
        let parts = part_of_joints(self);
        let world = self.world_from_joint(pose);
        let mean = |wanted: &[Part]| {
            let of = |(part, world): (&Part, &DMat4)| wanted.contains(part).then(|| world.w_axis.truncate());
            let places: Vec<DVec3> = parts.iter().zip(&world).filter_map(of).collect();
            (!places.is_empty()).then(|| places.iter().sum::<DVec3>() / places.len() as f64)
        };
        (mean(&[Part::Head])? - mean(&[Part::LeftFoot, Part::RightFoot])?).try_normalize()
    }

    /// Computes forward kinematics: `world_from_joint` of each joint. The root lies at the pose's root translation, other joints at
    /// their rest translation in the parent's frame. Joints without a rotation in the pose stay at rest.
    #[must_use]
    pub fn world_from_joint(&self, pose: &Pose) -> Vec<DMat4> {
        let mut world: Vec<DMat4> = Vec::with_capacity(self.joints.len());
        for (index, joint) in self.joints.iter().enumerate() {
            let rotation = pose.joint_rotations.get(index).copied().unwrap_or(joint.rest_rotation);
            world.push(match joint.parent {
                None => DMat4::from_rotation_translation(rotation, pose.root_translation),
                Some(parent) => world[parent] * DMat4::from_rotation_translation(rotation, joint.rest_translation),
            });
        }
        world
    }

    /// Returns the skinning matrix `world_from_joint * joint_from_canonical` of each joint.
    #[must_use]
    pub fn world_from_canonical(&self, pose: &Pose) -> Vec<DMat4> {
        self.world_from_joint(pose)
            .into_iter()
            .zip(&self.joints)
            .map(|(world_from_joint, joint)| world_from_joint * joint.joint_from_canonical)
            .collect()
    }

    /// Returns the origin of each joint in canonical space, metres.
    #[must_use]
    pub fn canonical_origins(&self) -> Vec<DVec3> {
        self.joints.iter().map(|joint| joint.joint_from_canonical.inverse().w_axis.truncate()).collect()
    }

    /// Iterates over the indices of the direct children of a joint.
    pub fn children(&self, joint: usize) -> impl Iterator<Item = usize> + '_ {
        self.joints.iter().enumerate().filter(move |(_, j)| j.parent == Some(joint)).map(|(index, _)| index)
    }
}
