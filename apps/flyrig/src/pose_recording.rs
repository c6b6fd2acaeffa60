//! Poses in recordings, beside the images that they were estimated from.
//!
//! Topic `pose` holds foxglove `FrameTransforms` (protobuf, with its schema), one message for every tracked frame set,
//! at the frame set's time: for each joint the frame `person/<joint>` relative to its parent's, the root relative to `world`. The
//! translations are those of the person's own skeleton, which gives bones their lengths.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use flyrig_body::Skeleton;
use flyrig_capture::{MessageTap, Recorder, recorded_messages};
use flyrig_takes::recorded::schema;
use flyrig_types::Pose;
use foxglove::{
    Decode as _, Encode as _,
    messages::{FrameTransform, FrameTransforms, Quaternion, Timestamp, Vector3},
};
use glam::{DQuat, DVec3};

/// Topic of the poses.
const TOPIC: &str = "pose";
/// Frame of the cameras, and parent of the root joint.
const WORLD: &str = "world";
/// Prefix of the names of the joints' frames.
const PERSON: &str = "person/";
/// Largest number of joints in a message.
const MOST_JOINTS: usize = 4096;

/// Channel of poses in a recording.
pub struct PoseRecording(MessageTap);

impl PoseRecording {
    /// Opens the channel.
    pub fn new(recorder: &Recorder) -> Self {
        Self(recorder.messages(TOPIC, schema::<FrameTransforms>()))
    }

    /// Records the pose at a time in nanoseconds on the frames' clock; warns of a pose that does not fit the skeleton.
    pub fn record(&mut self, skeleton: &Skeleton, pose: &Pose, nanos: i64) {
        match encode(skeleton, pose, nanos) {
            Ok(payload) => self.0.record(nanos, payload),
            Err(error) => tracing::warn!("a pose was not recorded: {error:#}"),
        }
    }
}

fn encode(skeleton: &Skeleton, pose: &Pose, nanos: i64) -> Result<Vec<u8>> {
    skeleton.check_pose(pose)?;
    let positive = nanos.max(0);
    let seconds = u32::try_from(positive / 1_000_000_000).unwrap_or(u32::MAX);
    let timestamp = Timestamp::new(seconds, (positive % 1_000_000_000) as u32);
    let joints = skeleton.joints();
    let transform = |(joint, rotation): (&flyrig_body::Joint, &DQuat)| {
        let parent = joint.parent.and_then(|parent| joints.get(parent));
        let t = if parent.is_some() { joint.rest_translation } else { pose.root_translation };
        FrameTransform {
            timestamp: Some(timestamp),
            parent_frame_id: parent.map_or_else(|| WORLD.to_owned(), |parent| format!("{PERSON}{}", parent.name)),
            child_frame_id: format!("{PERSON}{}", joint.name),
            translation: Some(Vector3 { x: t.x, y: t.y, z: t.z }),
            rotation: Some(Quaternion { x: rotation.x, y: rotation.y, z: rotation.z, w: rotation.w }),
        }
    };
    let transforms = joints.iter().zip(&pose.joint_rotations).map(transform).collect();
    let mut bytes = Vec::new();
    FrameTransforms { transforms }.encode(&mut bytes)?;
    Ok(bytes)
}

/// Decodes joint names and pose.
fn decode(payload: &[u8]) -> Result<(Vec<String>, Pose)> {
    let message = FrameTransforms::decode(payload)?;
    let transforms = &message.transforms;
    ensure!(!transforms.is_empty() && transforms.len() <= MOST_JOINTS, "{} joints", transforms.len());
    let (mut names, mut joint_rotations) = (Vec::new(), Vec::new());
    let mut root_translation = DVec3::ZERO;
    for transform in transforms {
        let name = transform.child_frame_id.strip_prefix(PERSON);
        names.push(name.with_context(|| format!("{:?} is no joint", transform.child_frame_id))?.to_owned());
        let (t, r) = transform.translation.zip(transform.rotation).context("a joint has no place")?;
        joint_rotations.push(DQuat::from_xyzw(r.x, r.y, r.z, r.w));
        if transform.parent_frame_id == WORLD {
            root_translation = DVec3::new(t.x, t.y, t.z);
        }
    }
    let pose = Pose { root_translation, joint_rotations };
    ensure!(pose.is_valid(), "numbers that are not finite, or no rotations");
    Ok((names, pose))
}

/// Summarizes the poses of a recording in one line; `None` without any.
pub fn summarize(path: &Path) -> Result<Option<String>> {
    let (mut count, mut bad, mut joints) = (0u64, 0u64, 0);
    let mut times: Option<(i64, i64)> = None;
    for (nanos, payload) in recorded_messages(path, TOPIC)? {
        match decode(&payload) {
            Ok((names, _)) => (count, joints) = (count + 1, names.len()),
            Err(_) => bad += 1,
        }
        times = Some((times.map_or(nanos, |(first, _)| first), nanos));
    }
    let seconds = times.map_or(0.0, |(first, last)| last.saturating_sub(first) as f64 * 1e-9);
    let unreadable = if bad > 0 { format!(", {bad} that cannot be read") } else { String::new() };
    Ok((count + bad > 0).then(|| format!("{count} of {joints} joints in {seconds:.2} s{unreadable}")))
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};

    use super::*;

    #[test]
    fn a_pose_comes_back_and_other_readers_find_bones_and_schema() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        let skeleton = default_template(&ShapeParams::default()).unwrap().skeleton;
        let mut pose = skeleton.rest_pose();
        pose.root_translation = DVec3::new(0.5, -0.25, 1.0);
        pose.joint_rotations[3] *= DQuat::from_rotation_x(0.7);
        let recorder = Recorder::create(&path, &[], None).unwrap();
        let mut poses = PoseRecording::new(&recorder);
        for n in 0..5 {
            poses.record(&skeleton, &pose, n * 500_000_000);
        }
        // A pose of another skeleton is skipped with a warning.
        poses.record(&skeleton, &Pose { joint_rotations: vec![DQuat::IDENTITY], ..pose.clone() }, 9);
        drop(poses);
        assert_eq!(recorder.finish().problem, None);
        let messages: Vec<_> = recorded_messages(&path, TOPIC).unwrap().collect();
        assert_eq!(messages.len(), 5);
        assert_eq!(messages[4].0, 2_000_000_000);
        let (names, found) = decode(&messages[4].1).unwrap();
        let joints = skeleton.joints();
        assert!(names.iter().zip(joints).all(|(name, joint)| *name == joint.name) && names.len() == joints.len());
        assert_eq!(found, pose);
        assert_eq!(summarize(&path).unwrap().unwrap(), format!("5 of {} joints in 2.00 s", joints.len()));
        // Other programs find a tree of links under "world", with bones as long as the skeleton's.
        let message = FrameTransforms::decode(messages[0].1.as_slice()).unwrap();
        for (transform, joint) in message.transforms.iter().zip(joints).skip(1) {
            let t = transform.translation.unwrap();
            assert_eq!(DVec3::new(t.x, t.y, t.z), joint.rest_translation);
            let parent = &joints[joint.parent.unwrap()].name;
            assert_eq!(transform.parent_frame_id, format!("person/{parent}"));
        }
        assert_eq!(message.transforms[0].parent_frame_id, "world");
    }

    #[test]
    fn what_is_no_pose_is_refused() {
        assert!(decode(b"\xff\xff").is_err() && decode(b"").is_err());
        let of = |child: &str, w: f64| {
            let transform = FrameTransform {
                parent_frame_id: "world".to_owned(),
                child_frame_id: child.to_owned(),
                translation: Some(Vector3 { x: 0.0, y: 0.0, z: 0.0 }),
                rotation: Some(Quaternion { x: 0.0, y: 0.0, z: 0.0, w }),
                ..FrameTransform::default()
            };
            let mut bytes = Vec::new();
            FrameTransforms { transforms: vec![transform] }.encode(&mut bytes).unwrap();
            decode(&bytes)
        };
        assert!(of("person/hips", 1.0).is_ok());
        assert!(of("camera", 1.0).is_err() && of("person/hips", f64::NAN).is_err());
    }
}
