//! Retargeting of a recorded motion to a body.

use flyrig_types::{Pose, PoseTrack};
use glam::{DQuat, DVec2, DVec3};

use crate::clip_axes::Landmarks;
use crate::foot_contacts::{FootSource, level_feet, plant_feet};
use crate::joint_names::{Named, match_joints};
use crate::motion_clip::{MotionClip, Moved};
use crate::part::part_of_joints;
use crate::rest_alignment::at_source_rest;
use crate::{BodyError, BvhClip, Part, Skeleton, Template};

/// Rotation about x from the files' y up to the z up of our pose tracks, radians.
const Z_UP_FROM_Y_UP: f64 = std::f64::consts::FRAC_PI_2;

/// Quantile of the lowest foot heights of a clip that is taken as floor.
const FLOOR_QUANTILE: f64 = 0.05;

/// Joints of the legs, which give the scale.
const LEGS: [[&str; 4]; 2] =
    [["LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"], ["RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"]];

/// Part of a motion to take, and its place in the world.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RetargetOptions {
    /// Seconds of the motion to skip.
    pub start_secs: f64,
    /// Largest distance from the origin, metres: the middle of the path is moved to the origin, and a longer path is scaled down
    /// together with its steps, so that feet do not slide. `None` leaves the motion in place.
    pub reach_m: Option<f64>,
    /// Thickness of soles between the body's own feet ([`Template::floor_y`]) and the floor, metres.
    pub sole_m: f64,
}

impl BvhClip {
    /// Retargets the whole clip in place, see [`MotionClip::retarget`].
    ///
    /// # Errors
    /// As [`MotionClip::retarget`].
    pub fn retarget(&self, body: &Template) -> Result<PoseTrack, BodyError> {
        self.motion().retarget(body, &RetargetOptions::default())
    }
}

impl MotionClip {
    /// Transfers the motion to another body, by the joints' names in the usual rigs (case, separators and a `prefix:` do not
    /// matter). World: z up, the floor at z = 0; a motion that faces +z of the file faces -y.
    ///
    /// A joint rotates in the world as the source's does from its rest pose. The source may rest in another pose than our bind pose:
    /// `rest_alignment.rs` says how trunk and limbs are turned to it first. A format that states no axes (BVH) is checked against the
    /// person: other axes than y up, right-handed, are turned, with a warning. Joints that the source lacks stay at rest; a
    /// warning names them. The path of the hips is scaled by the length of the legs, and lifted so that the feet are on the
    /// floor when they are lowest (5 % of the frames); [`Template::floor_y`] is the floor of the bind pose. Feet are turned so that they are level where the source's stand (heel and ball low and slow).
    /// There, ours are held in place and on the floor by two-bone inverse kinematics, and hips too high for that are lowered smoothly.
    ///
    /// # Errors
    /// [`BodyError::Skeleton`] lists the legs' joints that are missing on either side, [`BodyError::Track`].
    pub fn retarget(&self, body: &Template, options: &RetargetOptions) -> Result<PoseTrack, BodyError> {
        let skeleton = &body.skeleton;
        let named: Vec<Named<'_>> =
            self.names.iter().zip(&self.parents).map(|(name, &parent)| Named { name, parent }).collect();
        let source = match_joints(skeleton, &named, &self.what)?;
        let turned = self.with_usual_axes(&landmarks(skeleton, &source)?);
        turned.as_ref().unwrap_or(self).retarget_matched(body, source, options)
    }

    /// Transfers the motion with the source joint of each joint of `body`.
    fn retarget_matched(
        &self,
        body: &Template,
        source: Vec<Option<usize>>,
        options: &RetargetOptions,
    ) -> Result<PoseTrack, BodyError> {
        let (skeleton, floor_y) = (&body.skeleton, body.floor_y());
        let map = Map::new(self, skeleton, source)?;
        let start_nanos =
            self.frames.first().map_or(0, |frame| frame.0).saturating_add((options.start_secs * 1e9) as i64);
        let last = self.frames.len().saturating_sub(1);
        let start = self.frames.partition_point(|frame| frame.0 < start_nanos).min(last);
        let mut poses: Vec<Pose> = self.frames.iter().map(|(_, moved)| map.pose(moved)).collect();
        let nanos: Vec<i64> = self.frames.iter().map(|frame| frame.0).collect();
        let mut feet = map.legs.map(|leg| {
            let track = |joint: usize| -> Vec<DVec3> {
                self.frames.iter().map(|(_, moved)| moved[joint].position * map.scale).collect()
            };
            FootSource { ankle: track(leg.theirs[2]), toe: leg.their_toe.map(track) }
        });
        let legs = map.legs.map(|leg| leg.ours);
        level_feet(skeleton, &legs, &nanos, &feet, &mut poses);
        let mut lowest: Vec<f64> = poses.iter().map(|pose| map.lowest_foot(pose)).collect();
        lowest.sort_by(f64::total_cmp);
        let lowest_foot_y = lowest.get((lowest.len() as f64 * FLOOR_QUANTILE) as usize).copied().unwrap_or(0.0);
        poses.drain(..start);
        for foot in &mut feet {
            foot.ankle.drain(..start);
            foot.toe.iter_mut().for_each(|toe| drop(toe.drain(..start)));
        }
        let z_up = DQuat::from_rotation_x(Z_UP_FROM_Y_UP);
        for pose in &mut poses {
            pose.root_translation.y += map.lowest_foot_y - floor_y + options.sole_m - lowest_foot_y;
            pose.root_translation = z_up * pose.root_translation;
            pose.joint_rotations[0] = (z_up * pose.joint_rotations[0]).normalize();
        }
        if let Some(reach_m) = options.reach_m {
            shrink_way(&mut poses, reach_m);
        }
        let nanos: Vec<i64> = nanos[start..].iter().map(|at| at - nanos[start]).collect();
        plant_feet(skeleton, &legs, (floor_y, options.sole_m), &nanos, &feet, &mut poses);
        let keys = nanos.into_iter().zip(poses).collect();
        PoseTrack::new(keys).map_err(|source| BodyError::Track { what: self.what.clone(), source })
    }
}

/// Returns the joints of the source that show its axes.
fn landmarks(skeleton: &Skeleton, source: &[Option<usize>]) -> Result<Landmarks, BodyError> {
    let theirs = |name: &str| skeleton.joint(name).and_then(|joint| source[joint]);
    let leg = |[hip, knee, ankle, toe]: [&str; 4]| Some(([theirs(hip)?, theirs(knee)?, theirs(ankle)?], theirs(toe)));
    // `match_joints` has found both legs.
    let missing = || BodyError::Skeleton("the motion has no legs".to_owned());
    let legs = [leg(LEGS[0]).ok_or_else(missing)?, leg(LEGS[1]).ok_or_else(missing)?];
    let top = ["Head", "Neck", "Spine1", "Spine"].into_iter().find_map(theirs);
    Ok(Landmarks { top, legs })
}

/// Moves the middle of the path to the origin and scales it down to `reach_m`.
fn shrink_way(poses: &mut [Pose], reach_m: f64) {
    let way = || poses.iter().map(|pose| pose.root_translation.truncate());
    let low = way().fold(DVec2::INFINITY, DVec2::min);
    let high = way().fold(DVec2::NEG_INFINITY, DVec2::max);
    let middle = (low + high) * 0.5;
    let farthest = way().map(|at| at.distance(middle)).fold(0.0, f64::max);
    let scale = if farthest > reach_m { reach_m / farthest } else { 1.0 };
    for pose in poses {
        let at = pose.root_translation;
        pose.root_translation = ((at.truncate() - middle) * scale).extend(at.z);
    }
}

/// Leg of both skeletons: hip, knee, ankle, and our toe joint.
#[derive(Debug, Clone, Copy)]
struct LegMap {
    ours: [usize; 4],
    theirs: [usize; 3],
    their_toe: Option<usize>,
}

/// Mapping from a motion's joints to a skeleton's.
struct Map<'a> {
    skeleton: &'a Skeleton,
    /// Source joint of each of our joints.
    source: Vec<Option<usize>>,
    /// Rotation of each of our joints, canonical axes, when the source is at rest.
    at_source_rest: Vec<DQuat>,
    /// Metres per unit of the source.
    scale: f64,
    legs: [LegMap; 2],
    feet: Vec<usize>,
    /// Height of the lowest joint of the feet in the bind pose, canonical metres.
    lowest_foot_y: f64,
}

impl<'a> Map<'a> {
    fn new(clip: &MotionClip, skeleton: &'a Skeleton, source: Vec<Option<usize>>) -> Result<Self, BodyError> {
        let joints = skeleton.joints();
        let origins = skeleton.canonical_origins();
        let (mut ours, mut theirs) = (0.0, 0.0);
        let mut legs = Vec::new();
        for names in LEGS {
            let our = |name: &str| skeleton.joint(name);
            let [Some(hip), Some(knee), Some(ankle), toe] = names.map(our) else { continue };
            let [Some(their_hip), Some(their_knee), Some(their_ankle)] = [hip, knee, ankle].map(|joint| source[joint])
            else {
                continue;
            };
            let leg = LegMap {
                ours: [hip, knee, ankle, toe.unwrap_or(ankle)],
                theirs: [their_hip, their_knee, their_ankle],
                their_toe: toe.and_then(|toe| source[toe]),
            };
            for bone in 0..2 {
                ours += origins[leg.ours[bone + 1]].distance(origins[leg.ours[bone]]);
                theirs += clip.origins[leg.theirs[bone + 1]].distance(clip.origins[leg.theirs[bone]]);
            }
            legs.push(leg);
        }
        // `match_joints` has found both legs on both sides.
        let &[left, right] = legs.as_slice() else {
            return Err(BodyError::Skeleton(format!("{} has no legs", clip.what)));
        };
        if !(ours > 1e-6 && theirs > 1e-6) {
            return Err(BodyError::Skeleton(format!("{} or the body has legs of no length", clip.what)));
        }

        let at_source_rest = at_source_rest(clip, skeleton, &source);
        let parts = part_of_joints(skeleton);
        let is_foot = |part: &Part| matches!(part, Part::LeftFoot | Part::RightFoot);
        let feet: Vec<usize> = (0..joints.len()).filter(|&index| is_foot(&parts[index])).collect();
        let lowest = feet.iter().map(|&foot| origins[foot].y).fold(f64::INFINITY, f64::min);
        Ok(Self {
            skeleton,
            source,
            at_source_rest,
            scale: ours / theirs,
            legs: [left, right],
            feet,
            lowest_foot_y: lowest,
        })
    }

    /// Returns the pose of one frame, y up, with the hips at the source's position.
    fn pose(&self, moved: &[Moved]) -> Pose {
        let joints = self.skeleton.joints();
        let mut world: Vec<DQuat> = Vec::with_capacity(joints.len());
        let mut joint_rotations = Vec::with_capacity(joints.len());
        for (index, joint) in joints.iter().enumerate() {
            let parent = joint.parent.map_or(DQuat::IDENTITY, |parent| world[parent]);
            let local = match self.source[index] {
                Some(source) => (parent.inverse() * moved[source].turned * self.at_source_rest[index]).normalize(),
                None => joint.rest_rotation,
            };
            joint_rotations.push(local);
            world.push((parent * local).normalize());
        }
        let mut pose = Pose { root_translation: DVec3::ZERO, joint_rotations };
        let ours = self.skeleton.world_from_joint(&pose);
        let [left, right] = self.legs;
        let between = |a: DVec3, b: DVec3| (a + b) * 0.5;
        let wanted = between(moved[left.theirs[0]].position, moved[right.theirs[0]].position) * self.scale;
        let origin = |joint: usize| ours[joint].w_axis.truncate();
        pose.root_translation = wanted - between(origin(left.ours[0]), origin(right.ours[0]));
        pose
    }

    fn lowest_foot(&self, pose: &Pose) -> f64 {
        let world = self.skeleton.world_from_joint(pose);
        self.feet.iter().map(|&foot| world[foot].w_axis.y).fold(f64::INFINITY, f64::min)
    }
}
