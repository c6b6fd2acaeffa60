//! A motion without a file: the person turns around on the spot in small steps, shifts weight from foot to
//! foot, looks ahead of the turn and moves the arms.

use std::f64::consts::{PI, TAU};

use flyrig_body::Skeleton;
use flyrig_types::{Pose, PoseTrack};
use glam::{DMat3, DQuat, DVec3};

use crate::SimError;
use crate::shoes::SOLE_M;

/// Steps of a full turn; even, so that the clip closes.
const STEPS: f64 = 12.0;
const KEYS_A_SECOND: f64 = 60.0;

/// World (z up) from canonical (y up, facing +z) axes; the body then faces -y.
pub(crate) fn world_from_canonical_axes() -> DQuat {
    DQuat::from_rotation_x(PI / 2.0)
}

/// One full turn of `secs` seconds, whose end meets its start.
pub(crate) fn turn_track(skeleton: &Skeleton, secs: f64) -> Result<PoseTrack, SimError> {
    let rig = Puppet::new(skeleton)?;
    let count = (secs * KEYS_A_SECOND).ceil().max(2.0) as i64;
    let keys = (0..=count)
        .map(|key| {
            let turn = key as f64 / count as f64;
            ((turn * secs * 1e9) as i64, rig.pose(turn, turn * secs))
        })
        .collect();
    Ok(PoseTrack::new(keys)?)
}

struct Leg {
    hip: usize,
    knee: usize,
    ankle: usize,
    side: f64,
}

/// The skeleton with the joints that the motion moves.
struct Puppet<'a> {
    skeleton: &'a Skeleton,
    origins: Vec<DVec3>,
    legs: [Leg; 2],
    spine: [usize; 3],
    neck: usize,
    head: usize,
    arms: [[usize; 3]; 2],
}

fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Where a foot points (radians) and how high it is lifted (0..=1) after `steps` steps since the start.
fn foot_state(steps: f64, left: bool) -> (f64, f64) {
    const STEP_ANGLE: f64 = TAU / STEPS;
    let index = steps.floor();
    let swings = (index.rem_euclid(2.0) < 0.5) == left;
    let planted = |step: f64| (step + 1.5) * STEP_ANGLE;
    if !swings {
        return (planted(index - 1.0), 0.0);
    }
    // Both feet stand for part of each step.
    let swing = ((steps - index - 0.15) / 0.7).clamp(0.0, 1.0);
    let angle = planted(index - 2.0) + 2.0 * STEP_ANGLE * smooth(swing);
    (angle, (PI * swing).sin().powi(2))
}

impl<'a> Puppet<'a> {
    fn new(skeleton: &'a Skeleton) -> Result<Self, SimError> {
        let find = |name: &'static str| skeleton.joint(name).ok_or(SimError::NoJoint(name));
        let leg = |hip, knee, ankle, side| -> Result<Leg, SimError> {
            Ok(Leg { hip: find(hip)?, knee: find(knee)?, ankle: find(ankle)?, side })
        };
        Ok(Self {
            skeleton,
            origins: skeleton.canonical_origins(),
            legs: [leg("LeftUpLeg", "LeftLeg", "LeftFoot", 1.0)?, leg("RightUpLeg", "RightLeg", "RightFoot", -1.0)?],
            spine: [find("LowerBack")?, find("Spine")?, find("Spine1")?],
            neck: find("Neck")?,
            head: find("Head")?,
            arms: [
                [find("LeftArm")?, find("LeftForeArm")?, find("LeftHand")?],
                [find("RightArm")?, find("RightForeArm")?, find("RightHand")?],
            ],
        })
    }

    /// Pose at `turn` (0..=1 of the full turn).
    fn pose(&self, turn: f64, _secs: f64) -> Pose {
        let steps = turn * STEPS;
        let yaw = turn * TAU;
        let wave = |cycles: f64, phase: f64| (TAU * (cycles * turn + phase)).sin();
        // Weight goes to the standing foot: right while the left swings in even steps.
        let shift = -(PI * steps).sin();
        let facing = DQuat::from_rotation_y(yaw);
        let root = facing * DQuat::from_rotation_z(0.030 * shift) * DQuat::from_rotation_x(0.015 * wave(3.0, 0.1));
        let hips = self.origins[0];
        // Legs all but straight: the hips hang at the height that the leg bones allow.
        let [hip, knee, ankle] = [self.legs[0].hip, self.legs[0].knee, self.legs[0].ankle].map(|j| self.origins[j]);
        let leg_m = hip.distance(knee) + knee.distance(ankle);
        let height = ankle.y + SOLE + 0.988 * leg_m + (hips.y - hip.y) - 0.004 * (1.0 + (TAU * steps).cos());
        let root_at = DVec3::new(0.0, height, 0.0) + facing * DVec3::new(0.022 * shift, 0.0, -0.01);

        // Rotations away from rest, in canonical axes, accumulated from the root.
        let mut delta: Vec<Option<DQuat>> = vec![None; self.origins.len()];
        delta[0] = Some(root);
        let look = 0.10 + 0.10 * wave(2.0, 0.0);
        let mut trunk = root;
        for (i, joint) in self.spine.into_iter().enumerate() {
            trunk *= DQuat::from_rotation_y(look * 0.4)
                * DQuat::from_rotation_z(-0.022 * shift)
                * DQuat::from_rotation_x(0.015 + 0.02 * wave(4.0, 0.07 * i as f64));
            delta[joint] = Some(trunk);
        }
        let neck = trunk * DQuat::from_rotation_y(look * 0.5) * DQuat::from_rotation_x(-0.03);
        delta[self.neck] = Some(neck);
        delta[self.head] =
            Some(neck * DQuat::from_rotation_y(look * 0.8) * DQuat::from_rotation_x(0.05 * wave(3.0, 0.3)));
        for (arm, side) in self.arms.iter().zip([1.0, -1.0]) {
            let phase = if side > 0.0 { 0.0 } else { 0.21 };
            // From the A pose down to the body, then gestures: out, forward, bent.
            let raise = 0.5 + 0.5 * wave(2.0, 0.75 + phase);
            let out = -0.50 + 0.62 * raise * raise;
            let forward = 0.10 + 0.30 * wave(3.0, phase) + 0.25 * raise;
            let upper = trunk * DQuat::from_rotation_x(-forward) * DQuat::from_rotation_z(side * out);
            let bend = 0.05 + 0.45 * (0.5 + 0.5 * wave(3.0, phase + 0.4));
            let fore = upper * DQuat::from_rotation_y(-side * bend * 0.7) * DQuat::from_rotation_x(-bend * 0.6 + 0.35);
            delta[arm[0]] = Some(upper);
            delta[arm[1]] = Some(fore);
            delta[arm[2]] = Some(fore * DQuat::from_rotation_x(0.15 * wave(4.0, phase)));
        }
        for leg in &self.legs {
            let (angle, lift) = foot_state(steps, leg.side > 0.0);
            self.place_leg(leg, root, root_at, angle, lift, &mut delta);
        }
        self.assemble(root_at, &delta)
    }

    /// Two-bone inverse kinematics: the ankle to its place, the knee forward.
    fn place_leg(&self, leg: &Leg, root: DQuat, root_at: DVec3, angle: f64, lift: f64, delta: &mut [Option<DQuat>]) {
        let [hip, knee, ankle] = [leg.hip, leg.knee, leg.ankle].map(|joint| self.origins[joint]);
        let facing = DQuat::from_rotation_y(angle + leg.side * 0.12);
        let stance = DQuat::from_rotation_y(angle) * DVec3::new(leg.side * (hip.x.abs() + 0.022), 0.0, 0.0);
        let target = stance + DVec3::Y * (ankle.y + SOLE + 0.055 * lift);
        let hip_at = root_at + root * (hip - self.origins[0]);
        let (thigh, shank) = ((knee - hip).length(), (ankle - knee).length());
        let reach = target - hip_at;
        let distance = reach.length().clamp(0.3 * (thigh + shank), 0.9995 * (thigh + shank));
        let along = reach.normalize_or(DVec3::NEG_Y);
        let forward = facing * DVec3::Z;
        let bend = (forward - along * forward.dot(along)).normalize_or(DVec3::Z);
        let cos = ((thigh * thigh + distance * distance - shank * shank) / (2.0 * thigh * distance)).clamp(-1.0, 1.0);
        let knee_at = hip_at + thigh * (along * cos + bend * (1.0 - cos * cos).sqrt());
        let ankle_at = hip_at + along * distance;
        delta[leg.hip] = Some(bone_rotation(knee - hip, knee_at - hip_at, forward));
        delta[leg.knee] = Some(bone_rotation(ankle - knee, ankle_at - knee_at, forward));
        delta[leg.ankle] = Some(facing * DQuat::from_rotation_x(0.35 * lift));
    }

    /// Local rotations from rotations away from rest; a joint without one follows its parent.
    fn assemble(&self, root_at: DVec3, delta: &[Option<DQuat>]) -> Pose {
        let world = world_from_canonical_axes();
        let joints = self.skeleton.joints();
        let mut whole: Vec<DQuat> = Vec::with_capacity(joints.len());
        let mut at_rest: Vec<DQuat> = Vec::with_capacity(joints.len());
        let mut turned: Vec<DQuat> = Vec::with_capacity(joints.len());
        let mut rotations = Vec::with_capacity(joints.len());
        for (joint, own) in joints.iter().zip(delta) {
            let parent = joint.parent;
            let rest = parent.map_or(DQuat::IDENTITY, |p| at_rest[p]) * joint.rest_rotation;
            let turn = own.unwrap_or_else(|| parent.map_or(DQuat::IDENTITY, |p| turned[p]));
            let world_from_joint = world * turn * rest;
            let parent_from_world = parent.map_or(DQuat::IDENTITY, |p| whole[p].inverse());
            rotations.push((parent_from_world * world_from_joint).normalize());
            whole.push(world_from_joint);
            at_rest.push(rest);
            turned.push(turn);
        }
        Pose { root_translation: world * root_at, joint_rotations: rotations }
    }
}

const SOLE: f64 = SOLE_M as f64;

/// Rotation that takes the resting direction of a bone to a new one, and the front of the body to `forward`.
fn bone_rotation(rest: DVec3, now: DVec3, forward: DVec3) -> DQuat {
    let frame = |bone: DVec3, forward: DVec3| {
        let down = bone.normalize_or(DVec3::NEG_Y);
        let side = down.cross(forward).normalize_or(down.any_orthonormal_vector());
        DMat3::from_cols(side, down, side.cross(down))
    };
    DQuat::from_mat3(&(frame(now, forward) * frame(rest, DVec3::Z).transpose())).normalize()
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};

    use super::*;

    #[test]
    fn the_clip_turns_all_the_way_round_with_feet_that_stay_where_they_stand() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let track = turn_track(&template.skeleton, 8.0).unwrap();
        let root = template.skeleton.joint("Hips").unwrap();
        let mut seen = [false; 8];
        for (_, pose) in track.keys() {
            let front = template.skeleton.world_from_joint(pose)[root].transform_vector3(DVec3::Z);
            seen[((front.y.atan2(front.x) + PI) / TAU * 8.0) as usize % 8] = true;
        }
        assert_eq!(seen, [true; 8]);
        let front = template.skeleton.world_from_joint(&track.at(0))[root].transform_vector3(DVec3::Z);
        assert!(front.y < -0.95, "faces camera 0 at the start: {front}");
        // The clip closes.
        let (first, last) = (&track.keys()[0].1, &track.keys()[track.keys().len() - 1].1);
        assert!((first.root_translation - last.root_translation).length() < 1e-6);
        for (a, b) in first.joint_rotations.iter().zip(&last.joint_rotations) {
            assert!(a.dot(*b).abs() > 1.0 - 1e-9);
        }
        // The right foot stands still through the first step.
        let foot = template.skeleton.joint("RightFoot").unwrap();
        let at = |nanos| template.skeleton.world_from_joint(&track.at(nanos))[foot].w_axis.truncate();
        let step_nanos = 8_000_000_000 / 12;
        for i in 0..10 {
            let moved = (at(step_nanos * i / 10) - at(0)).length();
            assert!(moved < 2e-3, "the standing foot slid {moved} m");
        }
    }
}
