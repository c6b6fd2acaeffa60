//! Axes of flexion and spread of fingers.

use glam::{DQuat, DVec3};

use crate::{FingerJoints, Skeleton, find_fingers};

/// Axes of a finger at rest: unit vectors in canonical axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FingerAxes {
    /// Axis about which a positive rotation bends the finger towards the palm, the thumb towards the little finger.
    pub flexion: DVec3,
    /// Axis about which a positive rotation moves the finger towards the thumb's side, the thumb away from the palm's plane.
    pub spread: DVec3,
}

impl FingerAxes {
    /// Returns the rotation of a joint away from rest: first `flexion`, then `spread`, radians.
    #[must_use]
    pub fn turn(&self, flexion: f64, spread: f64) -> DQuat {
        DQuat::from_axis_angle(self.spread, spread) * DQuat::from_axis_angle(self.flexion, flexion)
    }
}

/// Returns the joints of all fingers and their axes, left then right, thumb to little finger. `None` for a skeleton without
/// fingers or with fingers whose joints coincide.
#[must_use]
pub fn finger_axes(skeleton: &Skeleton) -> Option<(FingerJoints, [[FingerAxes; 5]; 2])> {
    let joints = find_fingers(skeleton)?;
    let origins = skeleton.canonical_origins();
    let mut axes = [[FingerAxes { flexion: DVec3::X, spread: DVec3::Y }; 5]; 2];
    for (side, sign) in [(0, 1.0), (1, -1.0)] {
        let fingers = &joints[side];
        let along = |finger: usize| (origins[fingers[finger][1]] - origins[fingers[finger][0]]).try_normalize();
        let knuckle = |finger: usize| origins[fingers[finger][0]];
        // Out of the palm: across the row of knuckles and along the middle finger.
        let across = (knuckle(4) - knuckle(1)).try_normalize()?;
        let palm = (across.cross(along(2)?) * sign).try_normalize()?;
        for (finger, axes) in axes[side].iter_mut().enumerate() {
            let along = along(finger)?;
            let towards = if finger == 0 { knuckle(4) - knuckle(0) } else { palm };
            let flexion = along.cross(towards).try_normalize()?;
            let spread = along.cross(flexion) * if finger == 0 { 1.0 } else { -sign };
            *axes = FingerAxes { flexion, spread: spread.try_normalize()? };
        }
    }
    Some((joints, axes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ShapeParams, Template, default_template};
    use flyrig_types::Pose;

    fn body() -> Template {
        default_template(&ShapeParams::default()).unwrap().with_fingers().unwrap()
    }

    fn posed(body: &Template, each: impl Fn(&FingerAxes, usize, usize) -> DQuat) -> Vec<DVec3> {
        let (joints, axes) = finger_axes(&body.skeleton).unwrap();
        let mut pose: Pose = body.skeleton.rest_pose();
        for side in 0..2 {
            for finger in 0..5 {
                for (k, &joint) in joints[side][finger].iter().enumerate() {
                    pose.joint_rotations[joint] = each(&axes[side][finger], finger, k);
                }
            }
        }
        body.skeleton.world_from_joint(&pose).iter().map(|m| m.w_axis.truncate()).collect()
    }

    #[test]
    fn bent_fingers_come_to_the_palms_side_where_the_thumb_is() {
        let body = body();
        let (joints, _) = finger_axes(&body.skeleton).unwrap();
        let rest = body.skeleton.canonical_origins();
        let fist = posed(&body, |axes, finger, _| axes.turn(if finger == 0 { 0.0 } else { 1.2 }, 0.0));
        for side in joints {
            let wrist = rest[side[0][0]];
            for finger in &side[1..] {
                let (before, after) = (rest[finger[2]], fist[finger[2]]);
                assert!(after.distance(wrist) < before.distance(wrist) - 0.015, "{before} {after}");
                // The thumb lies on the palm's side of the fingers.
                let thumb = rest[side[0][2]];
                assert!(after.distance(thumb) < before.distance(thumb) + 0.02);
            }
        }
        for (left, right) in joints[0].iter().zip(&joints[1]) {
            let mirrored = fist[right[2]] * DVec3::new(-1.0, 1.0, 1.0);
            assert!((fist[left[2]] - mirrored).length() < 2e-3, "both hands bend alike");
        }
    }

    #[test]
    fn spreading_moves_fingers_to_the_thumbs_side_and_a_bent_thumb_crosses_the_palm() {
        let body = body();
        let (joints, _) = finger_axes(&body.skeleton).unwrap();
        let rest = body.skeleton.canonical_origins();
        let spread = posed(&body, |axes, finger, k| axes.turn(0.0, if finger > 0 && k == 0 { 0.3 } else { 0.0 }));
        let bent = posed(&body, |axes, finger, _| axes.turn(if finger == 0 { 0.5 } else { 0.0 }, 0.0));
        for side in joints {
            let to_thumb = rest[side[1][0]] - rest[side[4][0]];
            for finger in &side[1..] {
                assert!((spread[finger[2]] - rest[finger[2]]).dot(to_thumb.normalize()) > 0.004);
            }
            let little = rest[side[4][0]];
            assert!(bent[side[0][2]].distance(little) < rest[side[0][2]].distance(little) - 0.005);
        }
    }
}
