//! Motion of a BVH skeleton on a body.

use flyrig_types::{Pose, PoseTrack};
use glam::{DQuat, DVec3};

use crate::bvh::BvhLocal;
use crate::part::part_of_joints;
use crate::{BodyError, BvhClip, Part, Skeleton};

/// BVH is y up, our pose tracks are z up.
const Z_UP_FROM_Y_UP: f64 = std::f64::consts::FRAC_PI_2;

/// Where feet that touch the floor lie among the heights of a clip.
const FLOOR_QUANTILE: f64 = 0.05;

/// Height of the toe joint above the sole when the bind pose does not tell.
const USUAL_TOE_HEIGHT_M: f64 = 0.03;

/// Root, hips and legs: without these there is no scale.
const LEGS: [[&str; 3]; 2] = [["LeftUpLeg", "LeftLeg", "LeftFoot"], ["RightUpLeg", "RightLeg", "RightFoot"]];

impl BvhClip {
    /// The clip's motion on another skeleton, by equal joint names (case and a `prefix:` do not matter). World: z
    /// up, the floor at z = 0, a clip that faces +z of the file faces -y.
    ///
    /// A joint turns in the world as the clip's does from its rest. The clip rests in another pose than our bind
    /// pose, so arms and legs are first turned to the clip's rest directions; hands go along with the arms; the
    /// trunk and the feet keep their own shape. Joints that the clip does not know stay at rest. The way of the
    /// hips is scaled by the length of the legs, and lifted such that the feet are on the floor when they are
    /// lowest (5 % of the frames).
    ///
    /// # Errors
    /// [`BodyError::Skeleton`] when the legs' joints are missing on either side, [`BodyError::Track`].
    pub fn retarget(&self, skeleton: &Skeleton) -> Result<PoseTrack, BodyError> {
        let map = Map::new(self, skeleton)?;
        let mut poses: Vec<Pose> = (0..self.frames.len()).map(|frame| map.pose(&self.locals(frame))).collect();
        let mut lowest: Vec<f64> = poses.iter().map(|pose| map.lowest_foot(pose)).collect();
        lowest.sort_by(f64::total_cmp);
        let floor = lowest.get((lowest.len() as f64 * FLOOR_QUANTILE) as usize).copied().unwrap_or(0.0);
        let z_up = DQuat::from_rotation_x(Z_UP_FROM_Y_UP);
        for pose in &mut poses {
            pose.root_translation.y += map.toe_height - floor;
            pose.root_translation = z_up * pose.root_translation;
            pose.joint_rotations[0] = (z_up * pose.joint_rotations[0]).normalize();
        }
        let nanos = |frame: usize| (frame as f64 * self.frame_secs * 1e9).round() as i64;
        let keys = poses.into_iter().enumerate().map(|(frame, pose)| (nanos(frame), pose)).collect();
        PoseTrack::new(keys).map_err(|source| BodyError::Track { what: self.path.display().to_string(), source })
    }
}

/// How a clip's joints drive a skeleton's.
struct Map<'a> {
    clip: &'a BvhClip,
    skeleton: &'a Skeleton,
    /// Clip joint of each of our joints.
    source: Vec<Option<usize>>,
    /// Rotation of each of our joints, canonical axes, when the clip is at rest.
    at_clip_rest: Vec<DQuat>,
    /// Metres per unit of the clip.
    scale: f64,
    /// Joints at the top of both legs, ours and the clip's.
    hips: [(usize, usize); 2],
    feet: Vec<usize>,
    /// Height of the lowest foot joint above the floor in the bind pose, metres.
    toe_height: f64,
}

impl<'a> Map<'a> {
    fn new(clip: &'a BvhClip, skeleton: &'a Skeleton) -> Result<Self, BodyError> {
        let joints = skeleton.joints();
        let clip_joint = |name: &str| clip.joints.iter().position(|joint| plain(&joint.name) == plain(name));
        let our_joint = |name: &str| joints.iter().position(|joint| plain(&joint.name) == plain(name));
        let source: Vec<Option<usize>> = joints
            .iter()
            .enumerate()
            .map(|(index, joint)| if index == 0 { Some(0) } else { clip_joint(&joint.name) })
            .collect();

        let origins = skeleton.canonical_origins();
        let clip_origins = clip_origins(clip);
        let (mut ours, mut clips) = (0.0, 0.0);
        let mut hips = Vec::new();
        for leg in LEGS {
            let mut chain = Vec::new();
            for name in leg {
                let missing = |place: &str| BodyError::Skeleton(format!("{place} has no joint '{name}'"));
                let theirs = clip_joint(name).ok_or_else(|| missing(&clip.path.display().to_string()))?;
                chain.push((our_joint(name).ok_or_else(|| missing("the body"))?, theirs));
            }
            hips.push(chain[0]);
            for bone in chain.windows(2) {
                ours += origins[bone[1].0].distance(origins[bone[0].0]);
                clips += clip_origins[bone[1].1].distance(clip_origins[bone[0].1]);
            }
        }
        if !(ours > 1e-6 && clips > 1e-6) {
            return Err(BodyError::Skeleton(format!("{} or the body has legs of no length", clip.path.display())));
        }

        let parts = part_of_joints(skeleton);
        let mut turned: Vec<DQuat> = Vec::with_capacity(joints.len());
        for (index, joint) in joints.iter().enumerate() {
            let parent = joint.parent.map_or(DQuat::IDENTITY, |parent| turned[parent]);
            turned.push(match parts[index] {
                Part::LeftArm | Part::RightArm | Part::LeftLeg | Part::RightLeg => {
                    // Along the limb: the nearest joint below that both sides know.
                    let next = (index + 1..joints.len())
                        .find(|&below| joints[below].parent == Some(index) && source[below].is_some());
                    let direction = next.zip(source[index]).and_then(|(next, theirs)| {
                        let ours = (origins[next] - origins[index]).try_normalize()?;
                        let clips = (clip_origins[source[next]?] - clip_origins[theirs]).try_normalize()?;
                        Some(DQuat::from_rotation_arc(ours, clips))
                    });
                    direction.unwrap_or(parent)
                }
                Part::LeftHand | Part::RightHand => parent,
                _ => DQuat::IDENTITY,
            });
        }
        let at_clip_rest = joints.iter().zip(&turned).map(|(joint, turned)| *turned * bind_rotation(joint)).collect();
        let is_foot = |part: &Part| matches!(part, Part::LeftFoot | Part::RightFoot);
        let feet: Vec<usize> = (0..joints.len()).filter(|&index| is_foot(&parts[index])).collect();
        let lowest = feet.iter().map(|&foot| origins[foot].y).fold(f64::INFINITY, f64::min);
        Ok(Self {
            clip,
            skeleton,
            source,
            at_clip_rest,
            scale: ours / clips,
            hips: [hips[0], hips[1]],
            feet,
            toe_height: if (0.0..0.15).contains(&lowest) { lowest } else { USUAL_TOE_HEIGHT_M },
        })
    }

    /// One frame, y up, hips where the clip has them.
    fn pose(&self, locals: &[BvhLocal]) -> Pose {
        let mut clip_world: Vec<BvhLocal> = Vec::with_capacity(locals.len());
        for (joint, local) in self.clip.joints.iter().zip(locals) {
            clip_world.push(match joint.parent.map(|parent| clip_world[parent]) {
                None => *local,
                Some(parent) => BvhLocal {
                    translation: parent.translation + parent.rotation * local.translation,
                    rotation: (parent.rotation * local.rotation).normalize(),
                },
            });
        }
        let joints = self.skeleton.joints();
        let mut world: Vec<DQuat> = Vec::with_capacity(joints.len());
        let mut joint_rotations = Vec::with_capacity(joints.len());
        for (index, joint) in joints.iter().enumerate() {
            let parent = joint.parent.map_or(DQuat::IDENTITY, |parent| world[parent]);
            let local = match self.source[index] {
                Some(source) => (parent.inverse() * clip_world[source].rotation * self.at_clip_rest[index]).normalize(),
                None => joint.rest_rotation,
            };
            joint_rotations.push(local);
            world.push((parent * local).normalize());
        }
        let mut pose = Pose { root_translation: DVec3::ZERO, joint_rotations };
        let ours = self.skeleton.world_from_joint(&pose);
        let between = |a: DVec3, b: DVec3| (a + b) * 0.5;
        let [(our_left, left), (our_right, right)] = self.hips;
        let wanted = between(clip_world[left].translation, clip_world[right].translation) * self.scale;
        let origin = |joint: usize| ours[joint].w_axis.truncate();
        pose.root_translation = wanted - between(origin(our_left), origin(our_right));
        pose
    }

    fn lowest_foot(&self, pose: &Pose) -> f64 {
        let world = self.skeleton.world_from_joint(pose);
        self.feet.iter().map(|&foot| world[foot].w_axis.y).fold(f64::INFINITY, f64::min)
    }
}

fn plain(name: &str) -> String {
    name.rsplit(':').next().unwrap_or(name).to_lowercase()
}

/// Places of the clip's joints when nothing is turned, the clip's units.
fn clip_origins(clip: &BvhClip) -> Vec<DVec3> {
    let mut origins: Vec<DVec3> = Vec::with_capacity(clip.joints.len());
    for joint in &clip.joints {
        origins.push(joint.parent.map_or(DVec3::ZERO, |parent| origins[parent] + joint.offset));
    }
    origins
}

/// `canonical_from_joint` rotation in the bind pose.
fn bind_rotation(joint: &crate::Joint) -> DQuat {
    let (_, rotation, _) = joint.joint_from_canonical.inverse().to_scale_rotation_translation();
    rotation.normalize()
}
