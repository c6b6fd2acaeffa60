//! Correspondence of two rest poses: how a skeleton stands when the source of a motion rests.

use glam::{DMat3, DQuat, DVec3};

use crate::motion_clip::MotionClip;
use crate::part::part_of_joints;
use crate::{Part, Skeleton};

/// Frames that decide how a joint is turned about its bone.
const FRAMES: usize = 64;

/// Largest angle between the bones of two rest poses, radians. At a larger one the source does not rest in a pose of a person: all
/// bones along one axis, for example.
const FARTHEST: f64 = 75.0 * std::f64::consts::PI / 180.0;

/// Weight of the bend of the elbow against the twist of the upper arm, which turns far.
const BEND: f64 = 2.0;

/// Joint of a limb or of the spine, in canonical axes.
struct Bone {
    /// Direction of the bone in a T pose.
    along: DVec3,
    /// Direction across the bone that is preserved where bones run along the axes.
    across: DVec3,
    /// Whether our bone takes the direction of the source's; spine, head, collars and toes keep their own shape.
    follows: bool,
}

/// Rotations of the trunk at rest, from the axes of a T pose.
#[derive(Clone, Copy)]
struct Trunk {
    ours: DQuat,
    theirs: DQuat,
}

/// Rotation of a joint, canonical axes, when the source rests.
#[derive(Clone, Copy)]
struct Aligned {
    /// From our bind pose.
    turned: DQuat,
    /// From a T pose.
    from_t_pose: DQuat,
    /// Nearest joint of the source at or above this one.
    source: usize,
    /// Direction of the source's bone at rest where the source does not rest in a pose of a person.
    odd_bone: Option<DVec3>,
}

/// Returns the rotation of each joint, canonical axes, when the source is at rest.
///
/// The trunk is turned as a block, by the directions from hips to neck and from hip to hip; neck, arms, legs and feet
/// take the source's bone directions, hands follow the forearms, collars, head and toes keep their own shape. A source that does not
/// rest in the pose of a person (all bones along one axis, as in LAFAN1 and the Bandai-Namco dataset) is taken to have axes that
/// differ from those of a T pose by quarter turns about each bone: the ones at which the joints are least twisted over the clip.
pub(crate) fn at_source_rest(clip: &MotionClip, skeleton: &Skeleton, source: &[Option<usize>]) -> Vec<DQuat> {
    let alignment = Alignment { clip, skeleton, source, origins: skeleton.canonical_origins() };
    let trunk = alignment.trunk().unwrap_or(Trunk { ours: DQuat::IDENTITY, theirs: DQuat::IDENTITY });
    let turned = (trunk.theirs * trunk.ours.inverse()).normalize();
    let root = Aligned { turned, from_t_pose: trunk.theirs, source: source[0].unwrap_or(0), odd_bone: None };
    let legs = ["LeftUpLeg", "LeftLeg", "RightUpLeg", "RightLeg"].map(|name| skeleton.joint(name));
    let is_odd = legs.into_iter().flatten().any(|joint| alignment.is_far(joint, turned));
    let parts = part_of_joints(skeleton);
    let joints = skeleton.joints();
    let mut aligned: Vec<Aligned> = Vec::with_capacity(joints.len());
    for (index, joint) in joints.iter().enumerate() {
        let parent = joint.parent.map_or(root, |parent| aligned[parent]);
        let here = Aligned { source: source[index].unwrap_or(parent.source), ..root };
        aligned.push(match alignment.bone(&joint.name, index) {
            Some(bone) if source[index].is_some() && (is_odd || alignment.is_odd(index, &bone, &parent, turned)) => {
                alignment.align_by_motion(index, &bone, &parent, here, trunk)
            }
            Some(bone) => alignment.align(index, &bone, &parent, here),
            None if parts[index] == Part::Torso && !is_odd => here,
            None => Aligned { source: here.source, ..parent },
        });
    }
    joints.iter().zip(&aligned).map(|(joint, aligned)| aligned.turned * joint.bind_rotation()).collect()
}

struct Alignment<'a> {
    clip: &'a MotionClip,
    skeleton: &'a Skeleton,
    source: &'a [Option<usize>],
    origins: Vec<DVec3>,
}

impl Alignment<'_> {
    /// Returns our and the source's position of a joint at rest, if both know it.
    fn places(&self, name: &str) -> Option<[DVec3; 2]> {
        let joint = self.skeleton.joint(name)?;
        Some([self.origins[joint], self.clip.origins[self.source[joint]?]])
    }

    /// Returns the rotations of both trunks at rest; `None` where joints are missing or coincide.
    fn trunk(&self) -> Option<Trunk> {
        let between = |from: &str, to: &str| {
            let (from, to) = (self.places(from)?, self.places(to)?);
            Some([to[0] - from[0], to[1] - from[1]])
        };
        let up = between("Hips", "Neck").or_else(|| between("Hips", "Head")).or_else(|| {
            let (hips, left, right) = (self.places("Hips")?, self.places("LeftArm")?, self.places("RightArm")?);
            Some([0, 1].map(|side| (left[side] + right[side]) * 0.5 - hips[side]))
        })?;
        let frames = |across: [DVec3; 2]| {
            let frame = |side: usize| {
                let y = up[side].try_normalize()?;
                let x = across[side].try_normalize()?;
                let x = (x - y * y.dot(x)).try_normalize().filter(|_| x.cross(y).length() > 0.3)?;
                Some(DQuat::from_mat3(&DMat3::from_cols(x, y, x.cross(y))).normalize())
            };
            Some(Trunk { ours: frame(0)?, theirs: frame(1)? })
        };
        let hips = between("RightUpLeg", "LeftUpLeg").and_then(frames);
        hips.or_else(|| between("RightArm", "LeftArm").and_then(frames))
    }

    /// Describes a joint by its name in our skeleton; `None` for hips, hands and others.
    fn bone(&self, name: &str, index: usize) -> Option<Bone> {
        let (side, name) = match (name.strip_prefix("Left"), name.strip_prefix("Right")) {
            (Some(name), _) => (DVec3::X, name),
            (_, Some(name)) => (DVec3::NEG_X, name),
            _ => (DVec3::ZERO, name),
        };
        let (along, across, follows) = match name {
            "LowerBack" | "Spine" | "Spine1" | "Head" => (DVec3::Y, DVec3::X, false),
            "Neck" | "Neck1" => (DVec3::Y, DVec3::X, true),
            "Shoulder" => (side, DVec3::Z, false),
            "Arm" | "ForeArm" => (side, DVec3::Z, true),
            "UpLeg" | "Leg" => (DVec3::NEG_Y, DVec3::X, true),
            // Rigs differ in the slope of the foot's bone; ours stands for theirs.
            "Foot" => (self.direction(index).unwrap_or(DVec3::Z), DVec3::X, true),
            "ToeBase" => (DVec3::Z, DVec3::X, false),
            _ => return None,
        };
        Some(Bone { along, across, follows })
    }

    /// Returns the next joint below that drives another joint than this one.
    fn next(&self, index: usize) -> Option<usize> {
        let (joints, own) = (self.skeleton.joints(), self.source[index]?);
        (index + 1..joints.len()).find(|&below| {
            let up = std::iter::successors(joints[below].parent, |&joint| {
                joints[joint].parent.filter(|_| self.source[joint].is_none_or(|theirs| theirs == own))
            });
            self.source[below].is_some_and(|theirs| theirs != own) && up.take(joints.len()).any(|joint| joint == index)
        })
    }

    fn direction(&self, index: usize) -> Option<DVec3> {
        let below = self.next(index).or_else(|| self.skeleton.children(index).next())?;
        (self.origins[below] - self.origins[index]).try_normalize()
    }

    /// Returns the direction of a joint's bone at rest, ours and the source's.
    fn bones(&self, index: usize) -> Option<(DVec3, DVec3)> {
        let (next, own) = (self.next(index)?, self.source[index]?);
        let theirs = self.clip.origins[self.source[next]?] - self.clip.origins[own];
        Some(((self.origins[next] - self.origins[index]).try_normalize()?, theirs.try_normalize()?))
    }

    /// Returns whether the bones of both rest poses point apart.
    fn is_far(&self, index: usize, trunk: DQuat) -> bool {
        self.bones(index).is_some_and(|(ours, theirs)| (trunk * ours).angle_between(theirs) > FARTHEST)
    }

    /// Returns whether a joint of a limb does not rest as a person's.
    fn is_odd(&self, index: usize, bone: &Bone, parent: &Aligned, trunk: DQuat) -> bool {
        let is_end = self.bones(index).is_none();
        bone.along != DVec3::Y && (self.is_far(index, trunk) || is_end && parent.odd_bone.is_some())
    }

    /// Aligns a joint to the source's rest pose; `here` has the trunk's rotations.
    fn align(&self, index: usize, bone: &Bone, parent: &Aligned, here: Aligned) -> Aligned {
        match self.bones(index) {
            _ if !bone.follows => here,
            Some((ours, theirs)) => {
                let trunk = here.turned;
                Aligned { turned: DQuat::from_rotation_arc(trunk * ours, theirs) * trunk, ..here }
            }
            // Feet without toes, and a neck without a head.
            None if bone.across == DVec3::X && bone.along != DVec3::NEG_Y => here,
            None => Aligned { source: here.source, ..*parent },
        }
    }

    /// Aligns a joint whose source does not rest in the pose of a person.
    fn align_by_motion(&self, index: usize, bone: &Bone, parent: &Aligned, here: Aligned, trunk: Trunk) -> Aligned {
        let bones = self.bones(index);
        // A joint at the end of a straight limb goes on in its direction.
        let theirs = bones.map(|(_, theirs)| theirs).or(parent.odd_bone).unwrap_or(trunk.theirs * DVec3::Y);
        let from_t_pose = self.quarter_turn(index, bone, theirs, parent);
        let turned = match bones {
            Some((ours, _)) if bone.follows => from_t_pose * DQuat::from_rotation_arc(ours, bone.along),
            _ if bone.along == DVec3::Y => from_t_pose * trunk.ours.inverse(),
            _ => from_t_pose,
        };
        Aligned { turned: turned.normalize(), from_t_pose, odd_bone: Some(theirs), ..here }
    }

    /// Returns the rotation from a T pose to the source's rest that maps the bone to `theirs` and an axis to an axis, and twists
    /// the joint least against its parent over the clip. An elbow bends to the front of a T pose.
    fn quarter_turn(&self, index: usize, bone: &Bone, theirs: DVec3, parent: &Aligned) -> DQuat {
        let across = (bone.across - bone.along * bone.along.dot(bone.across)).normalize_or(bone.across);
        let ours = DMat3::from_cols(bone.along, across, bone.along.cross(across));
        let axes = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y, DVec3::NEG_Z];
        let upright = axes.into_iter().filter_map(|axis| {
            let axis = axis - theirs * theirs.dot(axis);
            (axis.length() > 0.7).then(|| axis.normalize())
        });
        let source = self.source[index].unwrap_or(parent.source);
        let is_arm = ["LeftArm", "RightArm"].contains(&self.skeleton.joints()[index].name.as_str());
        let below = self.next(index).filter(|_| is_arm);
        let below = below.and_then(|below| Some((self.source[below]?, self.bones(below)?.1)));
        let agreement = |axis: DVec3| -> f64 {
            let frames = self.clip.spread_frames(FRAMES).map(|joints| {
                let above = joints[parent.source].turned * parent.from_t_pose;
                let (limb, axis) = (joints[source].turned * theirs, joints[source].turned * axis);
                let least = DQuat::from_rotation_arc(above * bone.along, limb) * above * across;
                let bend = below.map_or(0.0, |(below, theirs)| axis.dot(joints[below].turned * theirs));
                least.dot(axis) + BEND * bend
            });
            frames.sum()
        };
        let best = upright.map(|axis| (agreement(axis), axis)).max_by(|a, b| a.0.total_cmp(&b.0));
        let axis = best.map_or_else(|| theirs.any_orthonormal_vector(), |(_, axis)| axis);
        let rest = DMat3::from_cols(theirs, axis, theirs.cross(axis));
        DQuat::from_mat3(&(rest * ours.transpose())).normalize()
    }
}
