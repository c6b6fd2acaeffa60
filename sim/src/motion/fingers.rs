//! Motion of the fingers: sequences of gestures that depend on hand and seed.

use flyrig_body::{FingerAxes, Skeleton, finger_axes};
use flyrig_types::{Pose, PoseTrack};
use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use crate::error::SimError;
use crate::motion::curve::ease;

/// Duration of a gesture including the transition to the next one, seconds.
const GESTURE_SECS: f64 = 1.2;
/// Duration of a cycle where the body does not move, seconds, and its keys per second.
const STILL_SECS: f64 = 9.6;
const STILL_KEYS: f64 = 30.0;
/// Rotation from a stretched to a fully bent joint, radians, from the palm to the tip.
const BENT: [f64; 3] = [1.35, 1.55, 0.95];
const THUMB_BENT: [f64; 3] = [0.45, 0.65, 0.8];
/// Largest spread, radians: thumb to little finger.
const SPREAD: [f64; 5] = [0.45, 0.22, 0.05, -0.14, -0.28];
/// Largest deviation of a person's joint axes from those of the average hand, radians.
const AXIS_JITTER_RAD: f64 = 0.08;

/// Bend of each finger (0 stretched, 1 a fist), thumb first, and spread (0 together, 1 wide).
type Gesture = ([f64; 5], f64);

const GESTURES: [Gesture; 8] = [
    ([0.0, 0.0, 0.0, 0.0, 0.0], 0.0),
    ([0.0, 0.02, 0.0, 0.02, 0.03], 1.0),
    ([0.35, 0.30, 0.34, 0.38, 0.42], 0.2),
    ([0.9, 0.95, 1.0, 1.0, 1.0], 0.0),
    ([0.7, 0.03, 0.92, 0.95, 0.95], 0.2),
    ([0.8, 0.05, 0.06, 0.95, 0.92], 0.6),
    ([0.0, 0.9, 0.95, 0.95, 0.95], 0.5),
    ([0.75, 0.55, 0.25, 0.15, 0.10], 0.3),
];

/// Adds the motion of fingers to a body's. The joints that move all fingers of a hand at once rest instead. A skeleton
/// without fingers keeps its track.
///
/// # Errors
/// [`SimError::Pose`].
pub(crate) fn with_fingers(track: &PoseTrack, skeleton: &Skeleton, seed: u64) -> Result<PoseTrack, SimError> {
    let Some((joints, mut axes)) = finger_axes(skeleton) else { return Ok(track.clone()) };
    let mut dice = StdRng::seed_from_u64(seed ^ 0x6669_6e67_6572);
    let (first, last) = track.span_nanos();
    let span_secs = (last - first) as f64 * 1e-9;
    let keys: Vec<(i64, Pose)> = if span_secs > 0.0 {
        track.keys().to_vec()
    } else {
        let count = (STILL_SECS * STILL_KEYS) as i64;
        (0..=count).map(|k| (first + (k as f64 * 1e9 / STILL_KEYS) as i64, track.at(first))).collect()
    };
    let span_secs = if span_secs > 0.0 { span_secs } else { STILL_SECS };
    let count = (span_secs / GESTURE_SECS).round().max(2.0) as usize;
    for axes in axes.iter_mut().flatten() {
        let mut jitter = || dice.random_range(-AXIS_JITTER_RAD..AXIS_JITTER_RAD);
        let off = DQuat::from_scaled_axis(DVec3::new(jitter(), jitter(), jitter()));
        *axes = FingerAxes { flexion: off * axes.flexion, spread: off * axes.spread };
    }
    let gestures: [Vec<usize>; 2] =
        std::array::from_fn(|_| (0..count).map(|_| dice.random_range(0..GESTURES.len())).collect());
    let resting: Vec<usize> = ["LeftFingerBase", "LeftHandFinger1", "RightFingerBase", "RightHandFinger1"]
        .iter()
        .filter_map(|name| skeleton.joint(name))
        .collect();
    let rest = |joint: usize| skeleton.joints()[joint].rest_rotation;
    let moved = |(nanos, pose): (i64, Pose)| {
        let mut pose = pose;
        for &joint in &resting {
            pose.joint_rotations[joint] = rest(joint);
        }
        let at = ((nanos - first) as f64 * 1e-9 / span_secs).rem_euclid(1.0) * count as f64;
        for side in 0..2 {
            let (bends, spread) = gesture(&gestures[side], at);
            for finger in 0..5 {
                for k in 0..3 {
                    let most = if finger == 0 { THUMB_BENT[k] } else { BENT[k] };
                    let sideways = if k == 0 { spread * SPREAD[finger] } else { 0.0 };
                    let turn = axes[side][finger].turn(bends[finger] * most, sideways);
                    let joint = joints[side][finger][k];
                    pose.joint_rotations[joint] = (turn * rest(joint)).normalize();
                }
            }
        }
        (nanos, pose)
    };
    Ok(PoseTrack::new(keys.into_iter().map(moved).collect())?)
}

/// Returns the gesture at a position in a closed sequence: held for half of the time, then blended to the next one.
fn gesture(sequence: &[usize], at: f64) -> Gesture {
    let index = at.floor() as usize % sequence.len();
    let (from, to) = (&GESTURES[sequence[index]], &GESTURES[sequence[(index + 1) % sequence.len()]]);
    let t = ease((at.fract() - 0.5) / 0.5);
    let mix = |a: f64, b: f64| a + (b - a) * t;
    (std::array::from_fn(|i| mix(from.0[i], to.0[i])), mix(from.1, to.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flyrig_body::{ShapeParams, default_template};

    #[test]
    fn fingers_move_smoothly_and_the_body_as_before() {
        let skeleton = default_template(&ShapeParams::default()).unwrap().with_fingers().unwrap().skeleton;
        let still = PoseTrack::new(vec![(0, skeleton.rest_pose())]).unwrap();
        let track = with_fingers(&still, &skeleton, 3).unwrap();
        let keys = track.keys();
        let turned =
            |a: &Pose, b: &Pose, joint: usize| a.joint_rotations[joint].angle_between(b.joint_rotations[joint]);
        let (mut farthest, mut quickest) = (0.0f64, 0.0f64);
        for pair in keys.windows(2) {
            for joint in 0..31 {
                let same = pair[1].1.joint_rotations[joint].dot(keys[0].1.joint_rotations[joint]).abs();
                let name = &skeleton.joints()[joint].name;
                assert!(same > 1.0 - 1e-12 || name.contains("Thumb"), "{name}: {same}");
            }
            for joint in 31..59 {
                farthest = farthest.max(turned(&keys[0].1, &pair[1].1, joint));
                quickest = quickest.max(turned(&pair[0].1, &pair[1].1, joint));
            }
        }
        assert!(farthest > 0.8 && quickest < 0.25, "{farthest} {quickest}");
        assert!(turned(&keys[0].1, &keys[keys.len() - 1].1, 40) < 1e-6, "the round closes");
        assert_ne!(track, with_fingers(&still, &skeleton, 4).unwrap());
    }

    #[test]
    fn a_body_without_fingers_keeps_its_motion() {
        let skeleton = default_template(&ShapeParams::default()).unwrap().skeleton;
        let still = PoseTrack::new(vec![(0, skeleton.rest_pose())]).unwrap();
        assert_eq!(with_fingers(&still, &skeleton, 3).unwrap(), still);
    }
}
