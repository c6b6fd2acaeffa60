//! Model of a template's hand: the network's 21 landmarks as a function of the fingers' angles, and the ranges of these.

use flyrig_body::{FingerAxes, Template, finger_axes};
use glam::{DQuat, DVec3};

use crate::error::{TrackError, TrackErrorKind};
use crate::hands::hand_net::HAND_LANDMARKS;
use crate::pose::anatomy::Roles;

/// Angles of a finger, radians: flexion and spread of the first joint, flexion of the second and of the third.
pub(crate) type Bend = [f64; 4];
/// Angles of a hand, thumb first.
pub(crate) type Bends = [Bend; 5];

/// Range of each angle of a finger, radians: smallest, largest, relaxed, and standard deviation about the relaxed one.
pub(crate) const FINGER_RANGE: [[f64; 4]; 4] =
    [[-0.35, 1.6, 0.30, 0.6], [-0.4, 0.4, 0.0, 0.15], [-0.05, 1.9, 0.40, 0.6], [-0.1, 1.3, 0.25, 0.4]];
/// Range of each angle of the thumb; see [`FINGER_RANGE`].
pub(crate) const THUMB_RANGE: [[f64; 4]; 4] =
    [[-0.6, 0.9, 0.15, 0.35], [-0.7, 0.7, 0.05, 0.3], [-0.4, 1.1, 0.15, 0.35], [-0.4, 1.4, 0.15, 0.45]];

/// Returns the range of one angle of one finger; see [`FINGER_RANGE`].
pub(crate) fn range(finger: usize, angle: usize) -> [f64; 4] {
    if finger == 0 { THUMB_RANGE[angle] } else { FINGER_RANGE[angle] }
}

/// Returns the angles of a relaxed hand.
pub(crate) fn relaxed() -> Bends {
    std::array::from_fn(|finger| std::array::from_fn(|angle| range(finger, angle)[2]))
}

/// Hand of a template.
#[derive(Debug, Clone)]
pub(crate) struct HandModel {
    /// Joint of the wrist.
    pub hand: usize,
    /// Joints of each finger.
    pub joints: [[usize; 3]; 5],
    /// Wrist in canonical space, metres.
    origin: DVec3,
    axes: [FingerAxes; 5],
    /// Offsets from the wrist to the first joint, and on to the second, the third and the tip; canonical axes, metres.
    offsets: [[DVec3; 4]; 5],
    /// Length from the wrist to the tip of the stretched middle finger, metres.
    pub length_m: f64,
}

/// Hand with bent fingers, canonical axes relative to the wrist, metres.
#[derive(Debug, Clone)]
pub(crate) struct BentHand {
    /// Landmarks in the network's order.
    pub points: [DVec3; HAND_LANDMARKS],
    /// Axes of each finger's angles, and points on them.
    pub axes: [[(DVec3, DVec3); 4]; 5],
}

/// Returns the angles of a finger that move its landmark `place` (0 to 3): none, those of the first joint, and so on.
pub(crate) fn moving(place: usize) -> std::ops::Range<usize> {
    0..[0, 2, 3, 4][place]
}

impl HandModel {
    /// Returns the left and the right hand of a template with fingers.
    ///
    /// # Errors
    /// Kind `Template` when it has no fingers, or fingers without vertices.
    pub fn pair(template: &Template) -> Result<[Self; 2], TrackError> {
        let error = |message: &str| {
            TrackError::new(TrackErrorKind::Template, format!("template '{}' {message}", template.name))
        };
        let roles = Roles::find(&template.skeleton, &template.name)?;
        let (joints, axes) = finger_axes(&template.skeleton)
            .ok_or_else(|| error("has no finger joints; turn hands off or give it three joints a finger"))?;
        let origins = template.skeleton.canonical_origins();
        let of_side = |side: usize| -> Option<Self> {
            let hand = roles.hand[side];
            let mut offsets = [[DVec3::ZERO; 4]; 5];
            for (finger, offsets) in offsets.iter_mut().enumerate() {
                let [a, b, c] = joints[side][finger].map(|joint| origins[joint]);
                let tip = tip(template, joints[side][finger][2], c, (c - b).try_normalize()?)?;
                *offsets = [a - origins[hand], b - a, c - b, tip - c];
            }
            let length_m = offsets[2].iter().map(|offset| offset.length()).sum();
            let finite = offsets.iter().flatten().all(|offset| offset.is_finite());
            finite.then_some(Self {
                hand,
                origin: origins[hand],
                joints: joints[side],
                axes: axes[side],
                offsets,
                length_m,
            })
        };
        match (of_side(0), of_side(1)) {
            (Some(left), Some(right)) => Ok([left, right]),
            _ => Err(error("has a finger without vertices; give its last joint skin weights")),
        }
    }

    /// Returns joint and canonical place at rest of each landmark, metres.
    pub fn marks(&self) -> [(usize, DVec3); HAND_LANDMARKS] {
        let mut marks = [(self.hand, self.origin); HAND_LANDMARKS];
        for finger in 0..5 {
            let mut at = self.origin;
            for place in 0..4 {
                at += self.offsets[finger][place];
                marks[1 + 4 * finger + place] = (self.joints[finger][place.min(2)], at);
            }
        }
        marks
    }

    /// Bends the fingers by angles in radians.
    pub fn bend(&self, bends: &Bends) -> BentHand {
        let mut bent = BentHand { points: [DVec3::ZERO; HAND_LANDMARKS], axes: [[(DVec3::ZERO, DVec3::ZERO); 4]; 5] };
        for (finger, &[first, spread, second, third]) in bends.iter().enumerate() {
            let FingerAxes { flexion, spread: aside } = self.axes[finger];
            let [to_first, to_second, to_third, to_tip] = self.offsets[finger];
            let spreading = DQuat::from_axis_angle(aside, spread);
            let turn1 = spreading * DQuat::from_axis_angle(flexion, first);
            let turn2 = turn1 * DQuat::from_axis_angle(flexion, second);
            let turn3 = turn2 * DQuat::from_axis_angle(flexion, third);
            let at1 = to_first;
            let at2 = at1 + turn1 * to_second;
            let at3 = at2 + turn2 * to_third;
            let tip = at3 + turn3 * to_tip;
            bent.points[1 + 4 * finger..5 + 4 * finger].copy_from_slice(&[at1, at2, at3, tip]);
            bent.axes[finger] =
                [(spreading * flexion, at1), (aside, at1), (turn1 * flexion, at2), (turn2 * flexion, at3)];
        }
        bent
    }

    /// Returns the rotations of a finger's joints away from rest, canonical axes.
    pub fn turns(&self, finger: usize, [first, spread, second, third]: Bend) -> [DQuat; 3] {
        let axes = &self.axes[finger];
        [axes.turn(first, spread), axes.turn(second, 0.0), axes.turn(third, 0.0)]
    }
}

/// Returns the middle of the fingertip: the mean of the flesh on the last joint within 6 mm of its end; `None` without
/// vertices.
fn tip(template: &Template, joint: usize, origin: DVec3, along: DVec3) -> Option<DVec3> {
    const END_M: f64 = 0.006;
    let own = |(_, skin): &(&glam::Vec3, &flyrig_body::SkinWeights)| usize::from(skin.joints[0]) == joint;
    let points: Vec<DVec3> =
        template.positions.iter().zip(&template.skin).filter(own).map(|(p, _)| p.as_dvec3()).collect();
    let extent = |p: &DVec3| (*p - origin).dot(along);
    let end = points.iter().map(extent).fold(f64::NEG_INFINITY, f64::max);
    let last: Vec<DVec3> = points.into_iter().filter(|p| extent(p) > end - END_M).collect();
    (!last.is_empty()).then(|| last.iter().copied().sum::<DVec3>() / last.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::body;

    #[test]
    fn landmarks_agree_with_the_skeletons_kinematics() {
        let template = body().with_fingers().unwrap();
        let bends: Bends = std::array::from_fn(|f| [0.3 + 0.1 * f as f64, 0.1 - 0.05 * f as f64, 0.7, 0.4]);
        for model in HandModel::pair(&template).unwrap() {
            let mut pose = template.skeleton.rest_pose();
            for (finger, bend) in bends.into_iter().enumerate() {
                for (joint, turn) in model.joints[finger].into_iter().zip(model.turns(finger, bend)) {
                    pose.joint_rotations[joint] = turn;
                }
            }
            let world = template.skeleton.world_from_joint(&pose);
            let bent = model.bend(&bends);
            let wrist = world[model.hand].w_axis.truncate();
            for finger in 0..5 {
                for k in 0..3 {
                    let expected = world[model.joints[finger][k]].w_axis.truncate() - wrist;
                    assert!((bent.points[1 + 4 * finger + k] - expected).length() < 1e-9);
                }
            }
            assert!((0.14..0.22).contains(&model.length_m), "{}", model.length_m);
        }
    }

    #[test]
    fn a_template_without_fingers_is_refused_with_the_fix() {
        let error = HandModel::pair(&body()).unwrap_err();
        assert_eq!(error.kind, TrackErrorKind::Template);
        assert!(error.to_string().contains("turn hands off"));
    }
}
