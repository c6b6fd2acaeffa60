//! Joints of a posed body, by name.

use std::collections::BTreeMap;

use flyrig_body::{Skeleton, Template};
use flyrig_types::Pose;
use glam::{DQuat, DVec3};

/// Joints that are compared, named as in the CMU skeleton.
pub const JOINTS: [&str; 14] = [
    "Hips",
    "Head",
    "LeftArm",
    "RightArm",
    "LeftForeArm",
    "RightForeArm",
    "LeftHand",
    "RightHand",
    "LeftUpLeg",
    "RightUpLeg",
    "LeftLeg",
    "RightLeg",
    "LeftFoot",
    "RightFoot",
];

/// Returns the world position (metres) of every joint, and the rotation from the bind pose of the part that it carries, by joint name.
pub fn places(skeleton: &Skeleton, pose: &Pose) -> BTreeMap<String, (DVec3, DQuat)> {
    let world = skeleton.world_from_canonical(pose);
    let place = |(joint, world): (&flyrig_body::Joint, &glam::DMat4)| {
        let origin = joint.joint_from_canonical.inverse().w_axis.truncate();
        let rotation = world.to_scale_rotation_translation().1.normalize();
        (joint.name.clone(), (world.transform_point3(origin), rotation))
    };
    skeleton.joints().iter().zip(&world).map(place).collect()
}

/// Returns the world position of the hips in a pose, metres.
pub fn hips(template: &Template, pose: &Pose) -> Option<DVec3> {
    places(&template.skeleton, pose).get("Hips").map(|(place, _)| *place)
}
