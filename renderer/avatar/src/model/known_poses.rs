//! Poses of the take, which show how far a new pose is from all of them.

use flyrig_body::{Skeleton, SkinWeights};
use flyrig_types::Pose;
use glam::DQuat;

/// Largest number of stored frames, evenly spaced: all of them would fill the file.
const MOST_FRAMES: usize = 64;
/// Distance to the nearest frame beyond which a Gaussian is in a pose unlike those of the take, radians.
const FAR_RAD: f64 = 0.5;

/// Poses of a take: local rotations of the joints, one list per frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct KnownPoses(pub(crate) Vec<Vec<DQuat>>);

impl KnownPoses {
    /// Stores poses of a take.
    #[must_use]
    pub fn new(poses: &[Pose]) -> Self {
        let step = poses.len().div_ceil(MOST_FRAMES).max(1);
        // As precise as the file keeps them.
        let rounded = |pose: &Pose| pose.joint_rotations.iter().map(|turn| turn.as_quat().as_dquat()).collect();
        Self(poses.iter().step_by(step).map(rounded).collect())
    }

    /// Returns the local rotations of the joints, one list per frame.
    #[must_use]
    pub fn rotations(&self) -> &[Vec<DQuat>] {
        &self.0
    }

    /// Returns the share of the Gaussians in a pose unlike those of the take: the joints that move them, and with a
    /// third of the weight their parents, differ by more than 30 degrees (root mean square) from every frame. 0 where
    /// no pose is known.
    #[must_use]
    pub fn far_share(&self, skeleton: &Skeleton, skin: &[SkinWeights], pose: &Pose) -> f64 {
        if self.0.is_empty() {
            return 0.0;
        }
        let joints = skeleton.joints();
        let frames: Vec<Vec<f64>> = self.0.iter().map(|frame| squared_angles(frame, &pose.joint_rotations)).collect();
        let angle = |frame: &[f64], joint: usize| frame.get(joint).copied().unwrap_or_default();
        let is_far = |skin: &&SkinWeights| {
            frames.iter().all(|frame| {
                let of = |(joint, weight): (&u16, f32)| {
                    let joint = usize::from(*joint);
                    let parent = joints.get(joint).and_then(|joint| joint.parent);
                    f64::from(weight) * (angle(frame, joint) + parent.map_or(0.0, |parent| angle(frame, parent) / 3.0))
                };
                skin.joints.iter().zip(skin.weights).map(of).sum::<f64>() > FAR_RAD * FAR_RAD
            })
        };
        skin.iter().filter(is_far).count() as f64 / skin.len().max(1) as f64
    }
}

/// Returns the squared angles between the joints of two poses. They are 0 for the root, which turns the whole person,
/// and for non-finite joints.
fn squared_angles(a: &[DQuat], b: &[DQuat]) -> Vec<f64> {
    let angle = |(joint, (a, b)): (usize, (&DQuat, &DQuat))| {
        let angle = if joint == 0 { 0.0 } else { 2.0 * a.dot(*b).abs().min(1.0).acos() };
        if angle.is_finite() { angle * angle } else { 0.0 }
    };
    a.iter().zip(b).enumerate().map(angle).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::avatar::tests::small;

    #[test]
    fn poses_unlike_those_of_the_take_are_counted() {
        let avatar = small(2000, 7);
        let skeleton = &avatar.template.skeleton;
        let elbow = skeleton.joints().iter().position(|joint| joint.name == "LeftForeArm").unwrap();
        let bent = |bend: f64| {
            let mut pose = skeleton.rest_pose();
            pose.joint_rotations[elbow] *= DQuat::from_rotation_x(bend);
            pose
        };
        let known = KnownPoses::new(&[bent(0.0), bent(0.3), bent(0.6)]);
        let far = |pose: &Pose| known.far_share(skeleton, &avatar.skin, pose);
        for near in [0.0, 0.45, 1.0] {
            assert!(far(&bent(near)) <= 0.0, "{near}");
        }
        // The forearm and the hand on it, and no more; the other way as well.
        for bend in [1.6, -0.8] {
            let share = far(&bent(bend));
            assert!(share > 0.005 && share < 0.1, "{bend}: {share}");
        }
        // Turning around changes nothing, nor does the sign of quaternions.
        let mut turned = bent(0.3);
        turned.joint_rotations[0] *= DQuat::from_rotation_z(2.0);
        turned.joint_rotations.iter_mut().for_each(|rotation| *rotation = -*rotation);
        assert!(far(&turned) <= 0.0);
        let mut other = skeleton.rest_pose();
        other.joint_rotations.iter_mut().for_each(|rotation| *rotation *= DQuat::from_rotation_z(2.0));
        assert!(far(&other) > 0.9);
        // Poison counts as no difference, and so does what is missing.
        other.joint_rotations.fill(DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0));
        assert!(far(&other) <= 0.0);
        other.joint_rotations.clear();
        assert!(far(&other) <= 0.0 && KnownPoses::default().far_share(skeleton, &avatar.skin, &other) <= 0.0);
    }

    #[test]
    fn long_takes_are_thinned_out() {
        let avatar = small(40, 2);
        let KnownPoses(kept) = KnownPoses::new(&vec![avatar.template.skeleton.rest_pose(); 1000]);
        assert!(kept.len() <= MOST_FRAMES && kept.len() > MOST_FRAMES / 2);
        assert_eq!(KnownPoses::new(&[]), KnownPoses::default());
    }
}
