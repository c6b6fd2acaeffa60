//! Derivatives of linear blend skinning (FlyHuman Eq. 1 and 2) with respect to the motion of the bones.
//!
//! A position `c` is the weighted mean of the positions `p` given by its bones. A bone that rotates by a small world
//! vector `w` around the world's origin moves its `p` by `w x p`, and its quaternion `q` by `(w, 0) q / 2`. Summing a
//! force and a torque for each bone is therefore enough, regardless of the joints that move it.

use glam::{DQuat, DVec3, DVec4, Quat, Vec3, Vec4};
use rayon::prelude::*;

use crate::model::avatar::Avatar;
use crate::model::posing::{Bones, PosedAvatar};
use flyrig_fit::Element;

/// Gaussians per task.
const CHUNK: usize = 4096;

/// Derivatives with respect to small motions of one bone in the world.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct BoneSlope {
    /// Derivative by a shift, per metre.
    pub shift: DVec3,
    /// Derivative by a rotation around the world's origin, per radian.
    pub turn: DVec3,
}

impl std::ops::AddAssign for BoneSlope {
    fn add_assign(&mut self, other: Self) {
        self.shift += other.shift;
        self.turn += other.turn;
    }
}

/// Derivatives of one Gaussian.
struct Slopes {
    /// Derivative by the world position.
    center: DVec3,
    /// Derivative by the blended quaternion before normalisation.
    blend: DVec4,
    /// Sum of the weights.
    sum: f64,
}

impl Slopes {
    /// Computes the derivatives; `None` for a Gaussian that no bone moves.
    fn new(bones: &Bones, avatar: &Avatar, i: usize, center: Element, rotation: Element) -> Option<Self> {
        let (mut blended, mut sum) = (Vec4::ZERO, 0.0f32);
        for bone in bones.influences(&avatar.skin[i]) {
            blended += bone.turn * bone.weight;
            sum += bone.weight;
        }
        let length = f64::from(blended.length());
        if sum <= 0.0 || length <= 0.0 {
            return None;
        }
        // The world's rotation is the normalised blend times the Gaussian's own.
        let own = Quat::from_array(avatar.parameters.rotation[i]).as_dquat();
        let by_turn = DVec4::from(Quat::from_array(rotation).as_dquat() * own.conjugate());
        let turn = blended.as_dvec4() / length;
        let blend = (by_turn - turn * turn.dot(by_turn)) / length;
        Some(Self { center: Vec4::from(center).truncate().as_dvec3(), blend, sum: f64::from(sum) })
    }
}

impl Avatar {
    /// Returns dL/d motion of each bone (world) from dL/d world positions and quaternions of the Gaussians, before
    /// [`PosedAvatar::to_parameters`] has changed these. Non-finite values are dropped. Light is ignored: poses must
    /// not explain shading.
    pub(crate) fn bone_slopes(
        &self,
        bones: &Bones,
        posed: &PosedAvatar,
        centers: &[Element],
        rotations: &[Element],
    ) -> Vec<BoneSlope> {
        let canonical: Vec<Vec3> = posed.canonical().collect();
        let joints = self.template.skeleton.joints().len();
        let chunk = |(chunk, canonical): (usize, &[Vec3])| {
            let mut sums = vec![BoneSlope::default(); joints];
            for (k, place) in canonical.iter().enumerate() {
                let i = chunk * CHUNK + k;
                let Some(slopes) = Slopes::new(bones, self, i, centers[i], rotations[i]) else { continue };
                for bone in bones.influences(&self.skin[i]) {
                    let weight = f64::from(bone.weight);
                    let force = slopes.center * (weight / slopes.sum);
                    let place = bone.matrix.transform_point3(*place).as_dvec3();
                    let turn =
                        DQuat::from_vec4(slopes.blend * weight) * DQuat::from_vec4(bone.turn.as_dvec4()).conjugate();
                    let slope = BoneSlope { shift: force, turn: place.cross(force) + turn.xyz() / 2.0 };
                    if let Some(sum) =
                        sums.get_mut(bone.joint).filter(|_| slope.shift.is_finite() && slope.turn.is_finite())
                    {
                        *sum += slope;
                    }
                }
            }
            sums
        };
        let count = canonical.len().min(centers.len()).min(rotations.len());
        // Summed in order: the same input gives the same bytes.
        let parts: Vec<_> = canonical[..count].par_chunks(CHUNK).enumerate().map(chunk).collect();
        let mut all = vec![BoneSlope::default(); joints];
        for part in parts {
            all.iter_mut().zip(part).for_each(|(sum, slope)| *sum += slope);
        }
        all
    }

    /// Returns dL/d logarithms of the skin weights under the constraint of the sum 1, from dL/d world positions and
    /// quaternions of the Gaussians; see [`Self::bone_slopes`]. They are zero for Gaussians with a single bone.
    pub(crate) fn weight_slopes(
        &self,
        bones: &Bones,
        posed: &PosedAvatar,
        centers: &[Element],
        rotations: &[Element],
    ) -> Vec<Element> {
        let count = centers.len().min(rotations.len());
        let canonical: Vec<Vec3> = posed.canonical().take(count).collect();
        let of = |(i, canonical): (usize, &Vec3)| {
            let mut found = [0.0; 4];
            let skin = &self.skin[i];
            let Some(slopes) = Slopes::new(bones, self, i, centers[i], rotations[i]) else { return found };
            if bones.influences(skin).nth(1).is_none() {
                return found;
            }
            let center = Vec4::from(posed.center[i]).truncate();
            for bone in bones.influences(skin) {
                let away = (bone.matrix.transform_point3(*canonical) - center).as_dvec3();
                let by_weight = away.dot(slopes.center) / slopes.sum + bone.turn.as_dvec4().dot(slopes.blend);
                let slope = (f64::from(bone.weight) * by_weight) as f32;
                found[bone.slot] = if slope.is_finite() { slope } else { 0.0 };
            }
            found
        };
        canonical.par_iter().enumerate().with_min_len(1024).map(of).collect()
    }
}

/// Reference of skinning by its formulas, in f64.
#[cfg(test)]
pub(crate) mod reference {
    use flyrig_body::SkinWeights;
    use flyrig_types::Pose;
    use glam::DMat4;

    use super::*;

    /// Computes a loss that weights every number of the world positions and quaternions of the Gaussians from `first`
    /// on.
    pub(crate) fn loss(
        avatar: &Avatar,
        skin: &[SkinWeights],
        pose: &Pose,
        (first, canonical): (usize, &[Vec3]),
        weights: &[[Element; 2]],
    ) -> f64 {
        let bones = avatar.template.skeleton.world_from_canonical(pose);
        let dot = |a: [f64; 4], b: Element| a.iter().zip(b).map(|(a, b)| a * f64::from(b)).sum::<f64>();
        let mut total = 0.0;
        for (i, (skin, weights)) in skin.iter().zip(weights).enumerate() {
            let (mut matrix, mut turn, mut sum) = (DMat4::ZERO, DVec4::ZERO, 0.0);
            for (joint, weight) in skin.joints.iter().zip(skin.weights).filter(|(_, weight)| *weight > 0.0) {
                let bone = bones[usize::from(*joint)];
                let own = DVec4::from(DQuat::from_mat4(&bone));
                let weight = f64::from(weight);
                matrix += bone * weight;
                turn += own * if turn.dot(own) < 0.0 { -weight } else { weight };
                sum += weight;
            }
            let place = (matrix * canonical[i].as_dvec3().extend(1.0)).truncate() / sum;
            let own = Quat::from_array(avatar.parameters.rotation[first + i]).as_dquat();
            let turned = DQuat::from_vec4(turn.normalize()) * own;
            total += dot(place.extend(0.0).to_array(), weights[0]);
            total += dot(turned.to_array(), weights[1]);
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use super::{reference::loss, *};
    use crate::model::avatar::tests::{random_pose, small};

    #[test]
    fn derivatives_of_weights_are_those_of_finite_differences() {
        let avatar = small(400, 7);
        let (pose, translations) = random_pose(&avatar, 3);
        let bones = Bones::new(&avatar.template.skeleton, &pose);
        let weights: Vec<[Element; 2]> = (0..avatar.places.len())
            .map(|i| [0, 1].map(|list| [0, 1, 2, 3].map(|k| ((i * 8 + list * 4 + k) as f32 * 1.3).cos())))
            .collect();
        let mut posed = PosedAvatar::default();
        avatar.pose(&bones, Some(&translations), &mut posed);
        let [centers, rotations]: [Vec<Element>; 2] = [0, 1].map(|list| weights.iter().map(|row| row[list]).collect());
        let found = avatar.weight_slopes(&bones, &posed, &centers, &rotations);
        let canonical: Vec<_> = posed.canonical().collect();
        let mut blended = 0;
        for i in 0..avatar.places.len() {
            let several = avatar.skin[i].weights.iter().filter(|weight| **weight > 0.0).count() > 1;
            blended += u32::from(several);
            for (k, found) in found[i].iter().enumerate() {
                let at = |by: f32| {
                    let mut skin = avatar.skin[i];
                    skin.weights[k] *= by.exp();
                    loss(&avatar, &[skin], &pose, (i, &canonical[i..=i]), &weights[i..=i])
                };
                let expected = (at(1e-2) - at(-1e-2)) / 2e-2;
                let error = (expected - f64::from(*found)).abs();
                assert!(error < 1e-3 * (expected.abs() + 0.02), "{i} {k}: {expected} {found}");
            }
        }
        assert!(blended > 50, "{blended}");
    }

    #[test]
    fn poison_and_missing_bones_are_left_out() {
        let mut avatar = small(40, 7);
        let (pose, translations) = random_pose(&avatar, 3);
        let bones = Bones::new(&avatar.template.skeleton, &pose);
        avatar.skin[3].weights = [0.0; 4];
        avatar.skin[4].joints = [u16::MAX; 4];
        avatar.skin[5].weights = [f32::NAN; 4];
        avatar.parameters.offset[6] = [f32::NAN; 4];
        avatar.parameters.rotation[7] = [f32::INFINITY; 4];
        let mut posed = PosedAvatar::default();
        avatar.pose(&bones, Some(&translations), &mut posed);
        let (mut centers, rotations) = (vec![[1.0; 4]; 40], vec![[0.5; 4]; 40]);
        centers[8] = [f32::NAN, 0.0, f32::INFINITY, 0.0];
        let slopes = avatar.bone_slopes(&bones, &posed, &centers, &rotations);
        assert!(slopes.iter().all(|slope| slope.shift.is_finite() && slope.turn.is_finite()));
        // 40 less the six poisoned ones pull the bones along.
        let force: DVec3 = slopes.iter().map(|slope| slope.shift).sum();
        assert!((force - DVec3::splat(34.0)).length() < 1e-3, "{force}");
        let found = avatar.weight_slopes(&bones, &posed, &centers, &rotations);
        assert!(found.iter().flatten().all(|slope| slope.is_finite()));
        assert!(found[3..6].iter().flatten().all(|slope| slope.abs() <= 0.0));
        // Nothing drawn.
        let nothing = avatar.bone_slopes(&bones, &PosedAvatar::default(), &[], &[]);
        assert!(nothing.iter().all(|slope| *slope == BoneSlope::default()));
        assert!(avatar.weight_slopes(&bones, &PosedAvatar::default(), &[], &[]).is_empty());
    }
}
