//! Recorded motion of any skeleton, before retargeting.

use flyrig_types::{Pose, PoseTrack};
use glam::{DQuat, DVec3};

use crate::bvh::BvhLocal;
use crate::{BodyError, BvhClip, BvhJoint, GltfHuman, Skeleton};

/// Joint in a frame: position, and rotation away from the rest pose, both in the file's world (y up).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Moved {
    pub position: DVec3,
    pub turned: DQuat,
}

/// Motion with its skeleton, from a BVH clip ([`BvhClip::motion`]), a glTF file ([`GltfHuman::motion`]) or poses of a body;
/// [`MotionClip::retarget`] transfers it to a body.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionClip {
    /// Source, for messages.
    pub(crate) what: String,
    pub(crate) names: Vec<String>,
    pub(crate) parents: Vec<Option<usize>>,
    /// Whether the format fixes the axes: right-handed, y up, as glTF does. BVH does not.
    pub(crate) axes_are_stated: bool,
    /// Positions of the joints at rest, y up, in the file's units.
    pub(crate) origins: Vec<DVec3>,
    /// Time, nanoseconds, and joints of each frame.
    pub(crate) frames: Vec<(i64, Vec<Moved>)>,
}

impl BvhClip {
    /// Returns the clip as a motion for retargeting.
    #[must_use]
    pub fn motion(&self) -> MotionClip {
        // Joints below the root with positions of their own: some programs leave their offsets at zero, others write
        // the distance from the offset.
        let first = self.locals(0);
        let length = |at: fn(&BvhJoint, &BvhLocal) -> DVec3| -> f64 {
            self.joints.iter().zip(&first).skip(1).map(|(joint, local)| at(joint, local).length()).sum()
        };
        let (offsets, placed) = (length(|joint, _| joint.offset), length(|_, local| local.translation));
        let (no_offsets, is_relative) = (offsets < 0.1 * placed, placed < 0.1 * offsets);
        let mut origins: Vec<DVec3> = Vec::with_capacity(self.joints.len());
        for (joint, local) in self.joints.iter().zip(&first) {
            let offset = if no_offsets { local.translation } else { joint.offset };
            origins.push(joint.parent.map_or(DVec3::ZERO, |parent| origins[parent] + offset));
        }
        let frame = |index: usize| {
            let mut world: Vec<Moved> = Vec::with_capacity(self.joints.len());
            for (joint, local) in self.joints.iter().zip(self.locals(index)) {
                let BvhLocal { mut translation, rotation } = local;
                if is_relative && joint.parent.is_some() {
                    translation += joint.offset;
                }
                // At rest a BVH joint has the axes of the world.
                world.push(match joint.parent.map(|parent| world[parent]) {
                    None => Moved { position: translation, turned: rotation },
                    Some(parent) => Moved {
                        position: parent.position + parent.turned * translation,
                        turned: (parent.turned * rotation).normalize(),
                    },
                });
            }
            ((index as f64 * self.frame_secs * 1e9).round() as i64, world)
        };
        MotionClip {
            what: self.path.display().to_string(),
            names: self.joints.iter().map(|joint| joint.name.clone()).collect(),
            parents: self.joints.iter().map(|joint| joint.parent).collect(),
            axes_are_stated: false,
            origins,
            frames: (0..self.frames.len()).map(frame).collect(),
        }
    }
}

impl MotionClip {
    /// Returns the poses of a body in the world (z up) as a motion, whose rest pose is the bind pose. `what` names it in messages.
    #[must_use]
    pub fn from_poses(what: &str, skeleton: &Skeleton, track: &PoseTrack) -> Self {
        Self::from_track(what, skeleton, track, DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2))
    }

    /// Returns poses as a motion, turned by `turn` to y up.
    fn from_track(what: &str, skeleton: &Skeleton, track: &PoseTrack, turn: DQuat) -> Self {
        let joints = skeleton.joints();
        let rest: Vec<DQuat> = joints.iter().map(|joint| joint.bind_rotation().inverse()).collect();
        let frame = |(nanos, pose): &(i64, Pose)| {
            let world = skeleton.world_from_joint(pose);
            let moved = world.iter().zip(&rest).map(|(world, rest)| Moved {
                position: turn * world.w_axis.truncate(),
                turned: (turn * DQuat::from_mat4(world) * *rest).normalize(),
            });
            (*nanos, moved.collect())
        };
        Self {
            what: what.to_owned(),
            names: joints.iter().map(|joint| joint.name.clone()).collect(),
            parents: joints.iter().map(|joint| joint.parent).collect(),
            axes_are_stated: true,
            origins: skeleton.canonical_origins(),
            frames: track.keys().iter().map(frame).collect(),
        }
    }
}

impl GltfHuman {
    /// Returns the file's first animation as a motion for retargeting; its rest pose is the bind pose.
    ///
    /// # Errors
    /// [`BodyError::Skeleton`] when the file has no animation.
    pub fn motion(&self) -> Result<MotionClip, BodyError> {
        let what = format!("'{}'", self.template.name);
        let Some(track) = &self.track else {
            return Err(BodyError::Skeleton(format!("{what} has no animation; export one with the body")));
        };
        Ok(MotionClip::from_track(&what, &self.template.skeleton, track, DQuat::IDENTITY))
    }
}
