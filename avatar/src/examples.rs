//! Shapes that clothes and hair had in the poses of the take: a pose alone gets a blend of those that its joints are nearest to.

use std::ops::Range;

use flyrig_body::{Skeleton, SkinWeights};
use flyrig_types::Pose;
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::Hanging;

/// Frames of a take that are kept, evenly spaced: two minutes of them would fill the file.
const MOST_FRAMES: usize = 64;
/// Widths that are tried, radians; the last one makes all frames count alike.
const WIDTHS_RAD: [f64; 6] = [0.05, 0.1, 0.2, 0.4, 0.8, f64::INFINITY];
/// Parts of the take that are left out in turn to choose a width.
const PARTS: usize = 4;
/// Weight of the take's mean, against 1 of a frame in the very same pose.
const MEAN_WEIGHT: f64 = 0.1;
/// Joints next to those that move a node count with this share of their weight: a bent knee pulls at the thigh's cloth.
const NEIGHBOR_SHARE: f64 = 0.3;
/// A node whose nearest frame is farther than this is in a pose unlike those of the take, radians.
const FAR_RAD: f64 = 0.5;

/// Poses of a take with the translations of the graph's nodes in them.
#[derive(Debug, Clone, PartialEq)]
pub struct Examples {
    /// Local rotations of the joints, a list a frame.
    pub(crate) rotations: Vec<Vec<DQuat>>,
    /// Translations of the nodes, canonical metres, a list a frame.
    pub(crate) translations: Vec<Vec<DVec3>>,
    /// Standard deviation of the weights over the angle between poses, radians.
    pub(crate) width_rad: f64,
    /// Joints that each node depends on, and their weights, sum 1.
    influences: Vec<Vec<(usize, f64)>>,
}

impl Examples {
    /// Learns from the frames of a take; None where there are fewer than two that belong to this graph. The width is the one of which the
    /// frames of one part of the take follow best from those of the others.
    #[must_use]
    pub fn learn<'a>(
        hanging: &Hanging,
        skin: &[SkinWeights],
        skeleton: &Skeleton,
        frames: impl IntoIterator<Item = (&'a Pose, &'a [DVec3])>,
    ) -> Option<Self> {
        let belongs = |pose: &Pose, nodes: &[DVec3]| {
            pose.joint_rotations.len() == skeleton.joints().len() && nodes.len() == hanging.nodes.len()
        };
        let frames: Vec<_> = frames.into_iter().filter(|(pose, nodes)| belongs(pose, nodes)).collect();
        let step = frames.len().div_ceil(MOST_FRAMES).max(1);
        let (rotations, translations): (Vec<_>, Vec<_>) = frames
            .iter()
            .step_by(step)
            .map(|(pose, nodes)| {
                // As precise as the file keeps them.
                let rotations: Vec<DQuat> =
                    pose.joint_rotations.iter().map(|rotation| rotation.as_quat().as_dquat()).collect();
                (rotations, nodes.iter().map(|moved| moved.as_vec3().as_dvec3()).collect::<Vec<_>>())
            })
            .unzip();
        let mut examples = Self::new(hanging, skin, skeleton, (rotations, translations), f64::INFINITY)?;
        let errors = WIDTHS_RAD.map(|width| {
            examples.width_rad = width;
            (width, examples.error())
        });
        let best = errors.iter().filter(|(_, error)| error.is_finite()).min_by(|a, b| a.1.total_cmp(&b.1));
        examples.width_rad = best?.0;
        Some(examples)
    }

    /// From frames that are known; None for fewer than two.
    pub(crate) fn new(
        hanging: &Hanging,
        skin: &[SkinWeights],
        skeleton: &Skeleton,
        (rotations, translations): (Vec<Vec<DQuat>>, Vec<Vec<DVec3>>),
        width_rad: f64,
    ) -> Option<Self> {
        let influences = influences(hanging, skin, skeleton);
        (rotations.len() > 1).then_some(Self { rotations, translations, width_rad, influences })
    }

    /// Returns the nodes' translations in a pose, canonical metres. Far from all frames they are the mean.
    #[must_use]
    pub fn translations(&self, pose: &Pose) -> Vec<DVec3> {
        self.blend(&pose.joint_rotations, 0..0)
    }

    /// Returns the share of the nodes that are in a pose unlike those of the take: more than 30 degrees from all of its frames.
    #[must_use]
    pub fn far_share(&self, pose: &Pose) -> f64 {
        let angles = self.squared_angles(&pose.joint_rotations);
        let is_far = |influences: &&Vec<(usize, f64)>| {
            angles.iter().all(|of_frame| distance_squared(influences, of_frame) > FAR_RAD * FAR_RAD)
        };
        self.influences.iter().filter(is_far).count() as f64 / self.influences.len().max(1) as f64
    }

    /// Squared angle between a joint's rotation and that of a frame, by frame and joint. The root turns the whole person, and joints that are
    /// missing or not finite count as alike.
    fn squared_angles(&self, rotations: &[DQuat]) -> Vec<Vec<f64>> {
        let angle = |(joint, (a, b)): (usize, (&DQuat, &DQuat))| {
            let angle = if joint == 0 { 0.0 } else { 2.0 * a.dot(*b).abs().min(1.0).acos() };
            if angle.is_finite() { angle * angle } else { 0.0 }
        };
        self.rotations.iter().map(|frame| frame.iter().zip(rotations).enumerate().map(angle).collect()).collect()
    }

    fn blend(&self, rotations: &[DQuat], without: Range<usize>) -> Vec<DVec3> {
        let angles = self.squared_angles(rotations);
        let of = |(node, influences): (usize, &Vec<(usize, f64)>)| {
            let (mut sum, mut total, mut mean, mut frames) = (DVec3::ZERO, 0.0, DVec3::ZERO, 0.0);
            for (frame, (of_frame, translations)) in angles.iter().zip(&self.translations).enumerate() {
                if without.contains(&frame) {
                    continue;
                }
                let exponent = -0.5 * distance_squared(influences, of_frame) / (self.width_rad * self.width_rad);
                let weight = exponent.exp();
                sum += translations[node] * weight;
                total += weight;
                mean += translations[node];
                frames += 1.0;
            }
            (sum + mean / f64::max(frames, 1.0) * MEAN_WEIGHT) / (total + MEAN_WEIGHT)
        };
        self.influences.par_iter().enumerate().map(of).collect()
    }

    /// Mean squared error of frames that follow from those of the other parts of the take, square metres.
    fn error(&self) -> f64 {
        let frames = self.rotations.len();
        let parts = PARTS.min(frames);
        let mut sum = 0.0;
        for part in 0..parts {
            let range = part * frames / parts..(part + 1) * frames / parts;
            for frame in range.clone() {
                let found = self.blend(&self.rotations[frame], range.clone());
                sum += found.iter().zip(&self.translations[frame]).map(|(a, b)| (a - b).length_squared()).sum::<f64>();
            }
        }
        sum / (frames * self.influences.len()).max(1) as f64
    }
}

/// Square of the angle between two poses as a node sees it, square radians.
fn distance_squared(influences: &[(usize, f64)], squared_angles: &[f64]) -> f64 {
    influences.iter().map(|(joint, weight)| weight * squared_angles.get(*joint).copied().unwrap_or_default()).sum()
}

/// Joints that move the Gaussians of each node, and with a share of their weight the joints next to them.
fn influences(hanging: &Hanging, skin: &[SkinWeights], skeleton: &Skeleton) -> Vec<Vec<(usize, f64)>> {
    let joints = skeleton.joints();
    let mut weights = vec![vec![0.0; joints.len()]; hanging.nodes.len()];
    for ((nodes, shares), skin) in hanging.gaussian_nodes.iter().zip(&hanging.gaussian_weights).zip(skin) {
        for (node, share) in nodes.iter().zip(shares) {
            for (joint, weight) in skin.joints.iter().zip(skin.weights) {
                if let Some(sum) = weights.get_mut(*node as usize).and_then(|row| row.get_mut(usize::from(*joint))) {
                    *sum += f64::from(share * weight);
                }
            }
        }
    }
    let spread = |row: &Vec<f64>| {
        let mut wide = row.clone();
        for (joint, weight) in row.iter().enumerate() {
            if let Some(parent) = joints[joint].parent {
                wide[parent] += NEIGHBOR_SHARE * weight;
                wide[joint] += NEIGHBOR_SHARE * row[parent];
            }
        }
        let sum: f64 = wide.iter().sum();
        let share = |(joint, weight): (usize, f64)| (joint, weight / sum);
        wide.into_iter().enumerate().filter(|(_, weight)| *weight > 1e-3 * sum).map(share).collect()
    };
    weights.iter().map(spread).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Avatar, avatar::tests::small};

    /// The elbow bends from 0 to 1 rad over 20 frames, and the nodes of the forearm move along with it.
    fn take(avatar: &Avatar) -> (usize, Vec<(Pose, Vec<DVec3>)>) {
        let skeleton = &avatar.template.skeleton;
        let elbow = skeleton.joints().iter().position(|joint| joint.name.contains("lowerarm")).unwrap();
        let frame = |k: usize| {
            let bend = k as f64 / 19.0;
            let mut pose = skeleton.rest_pose();
            pose.joint_rotations[elbow] *= DQuat::from_rotation_x(bend);
            (pose, vec![DVec3::new(bend * 0.02, 0.0, 0.0); avatar.hanging.as_ref().unwrap().nodes.len()])
        };
        (elbow, (0..20).map(frame).collect())
    }

    fn learn(avatar: &Avatar, frames: &[(Pose, Vec<DVec3>)]) -> Option<Examples> {
        let frames = frames.iter().map(|(pose, nodes)| (pose, nodes.as_slice()));
        Examples::learn(avatar.hanging.as_ref().unwrap(), &avatar.skin, &avatar.template.skeleton, frames)
    }

    #[test]
    fn nodes_follow_the_joint_that_moves_them_and_no_other() {
        let avatar = small(4000, 60);
        let (elbow, frames) = take(&avatar);
        let examples = learn(&avatar, &frames).unwrap();
        assert!(examples.width_rad < 0.3, "{}", examples.width_rad);
        let weight = |node: usize| {
            examples.influences[node].iter().find(|(joint, _)| *joint == elbow).map_or(0.0, |(_, weight)| *weight)
        };
        let nodes = 0..examples.influences.len();
        let forearm = nodes.clone().max_by(|a, b| weight(*a).total_cmp(&weight(*b))).unwrap();
        let elsewhere = nodes.clone().find(|node| weight(*node) <= 0.0).unwrap();
        assert!(weight(forearm) > 0.3);
        for (frame, (pose, expected)) in frames.iter().enumerate().skip(3).take(14) {
            let found = examples.translations(pose);
            assert!((found[forearm] - expected[forearm]).length() < 3e-3, "{frame}: {}", found[forearm]);
            assert!((found[elsewhere].x - 0.01).abs() < 1e-6, "nothing that moves it tells the frames apart");
        }
        // A blend over all nodes by the plain sums.
        let pose = &frames[7].0;
        for (node, influences) in examples.influences.iter().enumerate().step_by(7) {
            let (mut sum, mut total) = (DVec3::new(0.01, 0.0, 0.0) * MEAN_WEIGHT, MEAN_WEIGHT);
            for (other, translations) in &frames {
                let mut squared = 0.0;
                for (joint, weight) in influences.iter().filter(|(joint, _)| *joint > 0) {
                    let between = pose.joint_rotations[*joint].inverse() * other.joint_rotations[*joint];
                    squared += weight * (2.0 * between.w.abs().min(1.0).acos()).powi(2);
                }
                let weight = (-squared / (2.0 * examples.width_rad.powi(2))).exp();
                sum += translations[node] * weight;
                total += weight;
            }
            assert!((examples.translations(pose)[node] - sum / total).length() < 1e-9);
        }
    }

    #[test]
    fn far_poses_get_the_mean_and_are_named() {
        let avatar = small(4000, 60);
        let (elbow, frames) = take(&avatar);
        let examples = learn(&avatar, &frames).unwrap();
        assert!(examples.far_share(&frames[4].0) <= 0.0);
        let mut far = frames[0].0.clone();
        far.joint_rotations.iter_mut().for_each(|rotation| *rotation *= DQuat::from_rotation_z(2.0));
        assert!(examples.far_share(&far) > 0.9);
        for found in examples.translations(&far) {
            assert!((found.x - 0.01).abs() < 1e-6, "{found}");
        }
        // Poison counts as no difference; a short pose as well.
        far.joint_rotations[elbow] = DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0);
        assert!(examples.translations(&far).iter().all(|found| found.is_finite()));
        far.joint_rotations.truncate(1);
        assert!(examples.translations(&far).iter().all(|found| found.is_finite()));
    }

    #[test]
    fn noise_gives_the_mean_and_too_few_frames_nothing() {
        let avatar = small(2000, 20);
        let (_, mut frames) = take(&avatar);
        for (k, (_, nodes)) in frames.iter_mut().enumerate() {
            nodes.fill(DVec3::new(if k % 2 == 0 { 0.01 } else { -0.01 }, 0.0, 0.0));
        }
        let examples = learn(&avatar, &frames).unwrap();
        assert!(examples.width_rad > 0.3, "{}", examples.width_rad);
        assert!(learn(&avatar, &frames[..1]).is_none() && learn(&avatar, &[]).is_none());
        frames.iter_mut().for_each(|(_, nodes)| nodes.truncate(3));
        assert!(learn(&avatar, &frames).is_none(), "frames of another graph");
    }
}
