//! Conversion of postures to poses, with two-bone inverse kinematics for the legs.

use std::f64::consts::PI;

use flyrig_body::{Skeleton, Template};
use flyrig_types::Pose;
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::error::SimError;
use crate::motion::curve::ease;
use crate::motion::posture::{Arm, Foot, Posture};
use crate::person::shoes::SOLE_M;

/// Height of a shoe's sole below the bare foot, metres.
const SOLE: f64 = SOLE_M as f64;
/// Length of the average body's leg, hip to ankle, metres: unit of a posture's lengths.
const AVERAGE_LEG_M: f64 = 0.80;
/// Largest extension of the legs relative to their length: knees stay soft, feet stay reachable.
const STRETCH: f64 = 0.995;

/// Returns the rotation to world axes (z up) from canonical ones (y up, facing +z); the body then faces -y.
pub(crate) fn world_from_canonical_axes() -> DQuat {
    DQuat::from_rotation_x(PI / 2.0)
}

struct Leg {
    hip: usize,
    knee: usize,
    ankle: usize,
    toe: usize,
}

struct ArmJoints {
    clavicle: usize,
    shoulder: usize,
    elbow: usize,
    hand: usize,
    fingers: [usize; 2],
    thumb: usize,
}

/// Skeleton with the joints that the clips move, and measures of its owner.
pub(crate) struct Puppet<'a> {
    skeleton: &'a Skeleton,
    origins: Vec<DVec3>,
    legs: [Leg; 2],
    spine: [usize; 3],
    neck: [usize; 2],
    head: usize,
    arms: [ArmJoints; 2],
    /// Metres of this body per metre of the average body.
    scale: f64,
    leg_m: f64,
    hang_out: f64,
    chest_m: f64,
    /// Distance of the sole's end behind the ankle, metres.
    heel_m: f64,
}

impl<'a> Puppet<'a> {
    /// Creates the puppet of a skeleton whose owner's surface is `clothed` (at rest).
    pub(crate) fn new(skeleton: &'a Skeleton, clothed: &Template) -> Result<Self, SimError> {
        let find = |name: &'static str| skeleton.joint(name).ok_or(SimError::NoJoint(name));
        let origins = skeleton.canonical_origins();
        let legs = [
            ["LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"],
            ["RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"],
        ];
        let leg = |[hip, knee, ankle, toe]: [&'static str; 4]| -> Result<Leg, SimError> {
            Ok(Leg { hip: find(hip)?, knee: find(knee)?, ankle: find(ankle)?, toe: find(toe)? })
        };
        let arm = |[clavicle, shoulder, elbow, hand, base, finger, thumb]: [&'static str; 7]| {
            Ok::<_, SimError>(ArmJoints {
                clavicle: find(clavicle)?,
                shoulder: find(shoulder)?,
                elbow: find(elbow)?,
                hand: find(hand)?,
                fingers: [find(base)?, find(finger)?],
                thumb: find(thumb)?,
            })
        };
        let left =
            ["LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "LeftFingerBase", "LeftHandFinger1", "LThumb"];
        let right =
            ["RightShoulder", "RightArm", "RightForeArm", "RightHand", "RightFingerBase", "RightHandFinger1", "RThumb"];
        let legs = [leg(legs[0])?, leg(legs[1])?];
        let arms = [arm(left)?, arm(right)?];
        let [hip, knee, ankle] = [legs[0].hip, legs[0].knee, legs[0].ankle].map(|joint| origins[joint]);
        let leg_m = hip.distance(knee) + knee.distance(ankle);
        let hang_out = hanging_angle(&origins, &arms[0], clothed);
        Ok(Self {
            skeleton,
            spine: [find("LowerBack")?, find("Spine")?, find("Spine1")?],
            neck: [find("Neck")?, find("Neck1")?],
            head: find("Head")?,
            scale: leg_m / AVERAGE_LEG_M,
            leg_m,
            hang_out,
            chest_m: chest_depth(&origins, &arms[0], clothed) * AVERAGE_LEG_M / leg_m,
            heel_m: heel_depth(origins[legs[0].ankle], clothed),
            legs,
            arms,
            origins,
        })
    }

    /// Returns the metres of this body per metre of the average body.
    pub(crate) fn scale(&self) -> f64 {
        self.scale
    }

    /// Returns an upright posture with the arms hanging free of hips and clothes.
    pub(crate) fn standing(&self) -> Posture {
        Posture::standing(self.hang_out)
    }

    /// Returns the angle of hanging arms to the side, radians.
    pub(crate) fn hang_out(&self) -> f64 {
        self.hang_out
    }

    /// Returns the distance of the clothed chest in front of the shoulders, metres of the average body.
    pub(crate) fn chest_m(&self) -> f64 {
        self.chest_m
    }

    /// Returns an arm with its wrist at a position of the chest's frame (metres of the average body from the middle
    /// between the shoulders, x away from the body's middle) and its elbow towards `elbow`.
    pub(crate) fn reach(&self, wrist: DVec3, elbow: DVec3) -> Arm {
        let [shoulder, fore, hand] =
            [self.arms[0].shoulder, self.arms[0].elbow, self.arms[0].hand].map(|joint| self.origins[joint]);
        let (a, b) = (shoulder.distance(fore), fore.distance(hand));
        let target = wrist * self.scale - DVec3::new(shoulder.x, 0.0, 0.0);
        let (along, bend, cos, sin) = two_bones(a, b, target, elbow);
        let upper = along * cos + bend * sin;
        let wrist_at = along * target.length().clamp((a - b).abs() + 1e-3, (a + b) * STRETCH);
        Arm { upper, fore: (wrist_at - upper * a).normalize_or(upper), hand: [0.0; 2], curl: 0.35 }
    }

    /// Returns the pose, with hips lowered by `lower_m` (see [`Self::too_high_m`]).
    pub(crate) fn pose(&self, posture: &Posture, lower_m: f64) -> Pose {
        let root = root_turn(posture);
        let ankles = [0, 1].map(|i| self.ankle(i, &posture.feet[i]));
        let root_at = self.root_at(posture) - DVec3::Y * lower_m;

        // Rotations away from rest, in canonical axes, accumulated from the root.
        let mut delta: Vec<Option<DQuat>> = vec![None; self.origins.len()];
        delta[0] = Some(root);
        let mut trunk = root;
        for (joint, share) in self.spine.into_iter().zip([0.36, 0.34, 0.30]) {
            trunk *= bend(posture.trunk * share);
            delta[joint] = Some(trunk);
        }
        let mut head = trunk;
        for (joint, share) in self.neck.into_iter().zip([0.25, 0.25]) {
            head *= bend(posture.head * share);
            delta[joint] = Some(head);
        }
        delta[self.head] = Some(head * bend(posture.head * 0.5));
        for (i, arm) in self.arms.iter().enumerate() {
            self.place_arm(arm, &posture.arms[i], [1.0, -1.0][i], trunk, &mut delta);
        }
        for (i, leg) in self.legs.iter().enumerate() {
            let foot = &posture.feet[i];
            let forward = DQuat::from_rotation_y(foot.yaw + [1.0, -1.0][i] * posture.knees_out) * DVec3::Z
                + 0.4 * (root * DVec3::Z);
            self.place_leg(leg, root, root_at, ankles[i], forward, &mut delta);
            let turn = DQuat::from_rotation_y(foot.yaw);
            delta[leg.ankle] = Some(turn * DQuat::from_rotation_x(foot.roll));
            // Toes stay flat while the heel rises over them.
            delta[leg.toe] = Some(turn * DQuat::from_rotation_x(foot.roll - foot.roll.max(0.0) * foot.pivot));
        }
        self.assemble(root_at, &delta)
    }

    /// Returns the position of the ankle, canonical axes on the ground, metres.
    fn ankle(&self, side: usize, foot: &Foot) -> DVec3 {
        let leg = &self.legs[side];
        let (ankle, toe) = (self.origins[leg.ankle], self.origins[leg.toe]);
        let flat = DVec3::new(0.0, ankle.y + SOLE, 0.0);
        let ball = DVec3::new(toe.x - ankle.x, toe.y + SOLE, toe.z - ankle.z);
        let heel = DVec3::new(0.0, 0.0, -self.heel_m);
        let pivot = heel.lerp(ball, foot.pivot);
        let rolled = pivot + DQuat::from_rotation_x(foot.roll) * (flat - pivot);
        let at = foot.at * self.scale;
        DVec3::new(at.x, foot.lift * self.scale, at.y) + DQuat::from_rotation_y(foot.yaw) * rolled
    }

    /// Returns the distance by which the hips must be lowered for both feet to be reached, metres.
    pub(crate) fn too_high_m(&self, posture: &Posture) -> f64 {
        let root = root_turn(posture);
        let wanted = self.root_at(posture);
        let reach = STRETCH * self.leg_m;
        let limit = |(i, leg): (usize, &Leg)| {
            let hip = root * (self.origins[leg.hip] - self.origins[0]);
            let away = self.ankle(i, &posture.feet[i]) - wanted - hip;
            let flat = DVec2::new(away.x, away.z).length_squared();
            // A foot too far to be reached at any height lets the hips sink no farther than this.
            let above = (reach * reach - flat).max(0.04 * reach * reach).sqrt();
            wanted.y + away.y + above
        };
        let limits = self.legs.iter().enumerate().map(limit);
        (wanted.y - limits.fold(f64::INFINITY, f64::min)).max(0.0)
    }

    /// Returns the position of the hips, canonical axes on the ground, metres.
    fn root_at(&self, posture: &Posture) -> DVec3 {
        let hip_y = self.origins[self.legs[0].hip].y - self.origins[0].y;
        let straight = self.origins[self.legs[0].ankle].y + SOLE + STRETCH * self.leg_m - hip_y;
        posture.hips * self.scale + DVec3::Y * straight
    }

    /// Places the ankle by rotating the leg, with the knee forward.
    fn place_leg(
        &self,
        leg: &Leg,
        root: DQuat,
        root_at: DVec3,
        ankle_at: DVec3,
        forward: DVec3,
        delta: &mut [Option<DQuat>],
    ) {
        let [hip, knee, ankle] = [leg.hip, leg.knee, leg.ankle].map(|joint| self.origins[joint]);
        let hip_at = root_at + root * (hip - self.origins[0]);
        let (thigh, shank) = ((knee - hip).length(), (ankle - knee).length());
        let (along, bend, cos, sin) = two_bones(thigh, shank, ankle_at - hip_at, forward);
        let knee_at = hip_at + thigh * (along * cos + bend * sin);
        let hinge = bend.cross(along);
        delta[leg.hip] = Some(bone_rotation(knee - hip, knee_at - hip_at, hinge));
        delta[leg.knee] = Some(bone_rotation(ankle - knee, ankle_at - knee_at, hinge));
    }

    fn place_arm(&self, joints: &ArmJoints, arm: &Arm, side: f64, trunk: DQuat, delta: &mut [Option<DQuat>]) {
        let mirror = DVec3::new(side, 1.0, 1.0);
        let rest = |from: usize, to: usize| (self.origins[to] - self.origins[from]).normalize_or(DVec3::NEG_Y);
        let (rest_upper, rest_fore) = (rest(joints.shoulder, joints.elbow), rest(joints.elbow, joints.hand));
        let upper = (arm.upper * mirror).normalize_or(DVec3::NEG_Y);
        let fore = (arm.fore * mirror).normalize_or(upper);
        // Shoulders go up with raised arms and to the front with arms in front.
        let raised = ease((arm.upper.y + 0.45) / 1.45);
        let clavicle = trunk
            * DQuat::from_rotation_z(side * (0.50 * raised - 0.04))
            * DQuat::from_rotation_y(-side * 0.22 * arm.upper.z.clamp(-0.6, 1.0));
        let mut turned = DQuat::from_rotation_arc(rest_upper, upper);
        // The elbow's hinge turns with the forearm, as far as cloth and skin follow.
        let (rest_hinge, hinge) = (turned * rest_upper.cross(rest_fore), upper.cross(fore));
        let twist = upper.dot(rest_hinge.cross(hinge)).atan2(rest_hinge.dot(hinge));
        turned = DQuat::from_axis_angle(upper, 0.7 * twist * ease((hinge.length() - 0.1) / 0.5)) * turned;
        let straight = turned * rest_fore;
        let mut below = DQuat::from_rotation_arc(straight, fore) * turned;
        below = DQuat::from_axis_angle(fore, -side * 0.5 * arm.hand[1]) * below;
        // The wrist bends about the line of the knuckles, which runs from the thumb's side.
        let hand = joints.hand;
        let pointing = rest(hand, joints.fingers[1]);
        let thumb = rest(hand, joints.thumb);
        let knuckles = (thumb - pointing * thumb.dot(pointing)).normalize_or(DVec3::Z);
        let palm = DQuat::from_axis_angle(fore, -side * 0.5 * arm.hand[1]) * below;
        let bent = |angle: f64| DQuat::from_axis_angle(knuckles, -side * angle);
        delta[joints.clavicle] = Some(clavicle);
        delta[joints.shoulder] = Some(trunk * turned);
        delta[joints.elbow] = Some(trunk * below);
        delta[hand] = Some(trunk * palm * bent(arm.hand[0]));
        let curl = arm.curl.clamp(0.0, 1.0);
        delta[joints.fingers[0]] = Some(trunk * palm * bent(arm.hand[0] + 0.5 * curl));
        delta[joints.fingers[1]] = Some(trunk * palm * bent(arm.hand[0] + 1.6 * curl));
    }

    /// Returns the pose of rotations away from rest; a joint without one follows its parent.
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

/// Returns the rotation that bends forward, tilts to the left and turns to the left, in this order.
fn bend(angles: DVec3) -> DQuat {
    DQuat::from_rotation_y(angles.z) * DQuat::from_rotation_z(-angles.y) * DQuat::from_rotation_x(angles.x)
}

fn root_turn(posture: &Posture) -> DQuat {
    DQuat::from_rotation_y(posture.yaw) * bend(posture.pelvis)
}

/// Returns the angle to the side at which an arm hangs free of hips and clothes, radians.
fn hanging_angle(origins: &[DVec3], arm: &ArmJoints, clothed: &Template) -> f64 {
    use flyrig_body::Part::{LeftLeg, RightLeg, Torso};
    let [shoulder, elbow, hand] = [arm.shoulder, arm.elbow, arm.hand].map(|joint| origins[joint]);
    let long = shoulder.distance(elbow) + elbow.distance(hand);
    let wrist_y = shoulder.y - long;
    let clear = |p: &glam::Vec3| {
        let down = shoulder.y - f64::from(p.y);
        ((f64::from(p.x.abs()) + 0.045 - shoulder.x) / down).atan()
    };
    let beside = |(p, part): &(&glam::Vec3, &flyrig_body::Part)| {
        let y = f64::from(p.y);
        matches!(part, Torso | LeftLeg | RightLeg)
            && (wrist_y - 0.12..shoulder.y - 0.35 * long).contains(&y)
            && p.z.abs() < 0.13
    };
    let widest = clothed.positions.iter().zip(&clothed.parts).filter(beside).map(|(p, _)| clear(p));
    widest.fold(0.10, f64::max).min(0.55)
}

/// Returns the distance of the sole's end behind the ankle of the left foot, metres.
fn heel_depth(ankle: DVec3, clothed: &Template) -> f64 {
    let behind = |(p, part): (&glam::Vec3, &flyrig_body::Part)| {
        let here = *part == flyrig_body::Part::LeftFoot && f64::from(p.y) < 0.004 - SOLE;
        here.then_some(ankle.z - f64::from(p.z))
    };
    clothed.positions.iter().zip(&clothed.parts).filter_map(behind).fold(0.03, f64::max).min(0.12)
}

/// Returns the distance of the clothed chest in front of the shoulders, metres.
fn chest_depth(origins: &[DVec3], arm: &ArmJoints, clothed: &Template) -> f64 {
    let [shoulder, elbow] = [arm.shoulder, arm.elbow].map(|joint| origins[joint]);
    let long = shoulder.distance(elbow);
    let front = |(p, part): (&glam::Vec3, &flyrig_body::Part)| {
        let down = shoulder.y - f64::from(p.y);
        let here = *part == flyrig_body::Part::Torso && (0.3 * long..1.2 * long).contains(&down) && p.x.abs() < 0.12;
        here.then_some(f64::from(p.z) - shoulder.z)
    };
    clothed.positions.iter().zip(&clothed.parts).filter_map(front).fold(0.05, f64::max).min(0.35)
}

/// Solves two-bone inverse kinematics: direction to a target within reach, direction of the bend (towards `pole`), and
/// cosine and sine of the first bone's angle to the line.
fn two_bones(first: f64, second: f64, target: DVec3, pole: DVec3) -> (DVec3, DVec3, f64, f64) {
    let distance = target.length().clamp((first - second).abs() + 1e-3, (first + second) * 0.9995);
    let along = target.normalize_or(DVec3::NEG_Y);
    let bend = (pole - along * pole.dot(along)).normalize_or(along.any_orthonormal_vector());
    let cos = ((first * first + distance * distance - second * second) / (2.0 * first * distance)).clamp(-1.0, 1.0);
    (along, bend, cos, (1.0 - cos * cos).sqrt())
}

/// Returns the rotation that takes the resting direction of a leg's bone to a new one, and its hinge (canonical +x at
/// rest) with it.
fn bone_rotation(rest: DVec3, now: DVec3, hinge: DVec3) -> DQuat {
    let frame = |bone: DVec3, hinge: DVec3| {
        let down = bone.normalize_or(DVec3::NEG_Y);
        let side = (hinge - down * hinge.dot(down)).normalize_or(down.any_orthonormal_vector());
        DMat3::from_cols(side, down, side.cross(down))
    };
    DQuat::from_mat3(&(frame(now, hinge) * frame(rest, DVec3::X).transpose())).normalize()
}
