//! BVH clips: what is read, where errors point, and how the motion arrives on the body.
// Helpers of tests may stop a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::path::Path;

use flyrig_body::{
    BodyError, BvhChannel, BvhClip, ShapeParams, Skeleton, Template, default_template, load_bvh, parse_bvh,
};
use flyrig_types::Pose;
use glam::{DQuat, DVec3};

/// Legs of 0.4 units each bone, arms along x, y up; the second frame moves the root and bends the left knee.
const CLIP: &str = "HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT LeftUpLeg
  {
    OFFSET 0.1 0 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    JOINT LeftLeg
    {
      OFFSET 0 -0.4 0
      CHANNELS 3 Zrotation Yrotation Xrotation
      JOINT LeftFoot
      {
        OFFSET 0 -0.4 0
        CHANNELS 3 Zrotation Yrotation Xrotation
        End Site
        {
          OFFSET 0 0 0.1
        }
      }
    }
  }
  JOINT RightUpLeg
  {
    OFFSET -0.1 0 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    JOINT RightLeg
    {
      OFFSET 0 -0.4 0
      CHANNELS 3 Zrotation Yrotation Xrotation
      JOINT RightFoot
      {
        OFFSET 0 -0.4 0
        CHANNELS 3 Zrotation Yrotation Xrotation
      }
    }
  }
  JOINT LeftArm
  {
    OFFSET 0.2 0.5 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    JOINT LeftForeArm
    {
      OFFSET 0.3 0 0
      CHANNELS 3 Zrotation Yrotation Xrotation
      JOINT LeftHand
      {
        OFFSET 0.3 0 0
        CHANNELS 3 Zrotation Yrotation Xrotation
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.5
0 0.8 0  0 0 0  0 0 0 0 0 0 0 0 0  0 0 0 0 0 0 0 0 0  0 0 0 0 0 0 0 0 0
0.4 0.8 1  0 0 0  0 0 0 0 0 90 0 0 0  0 0 0 0 0 0 0 0 0  90 0 0 0 0 0 0 0 0
";

fn parse(text: &str) -> Result<BvhClip, BodyError> {
    parse_bvh(text, Path::new("test.bvh"))
}

fn body() -> Template {
    default_template(&ShapeParams::man()).unwrap()
}

fn place(skeleton: &Skeleton, pose: &Pose, name: &str) -> DVec3 {
    skeleton.world_from_joint(pose)[skeleton.joint(name).unwrap()].w_axis.truncate()
}

#[test]
fn a_clip_is_read() {
    let clip = parse(CLIP).unwrap();
    assert_eq!(clip.joints.len(), 10);
    assert_eq!(clip.joints[2].parent, Some(1));
    assert_eq!(clip.joints[3].end_site, Some(DVec3::new(0.0, 0.0, 0.1)));
    assert_eq!(
        clip.joints[0].channels[1..4],
        [BvhChannel::Position(1), BvhChannel::Position(2), BvhChannel::Rotation(2)]
    );
    assert_eq!((clip.frames.len(), clip.frames[1].len()), (2, 33));
    assert!((clip.frame_secs - 0.5).abs() < 1e-12);
    // Line ends and capitals of other programs.
    assert_eq!(
        parse(&CLIP.replace('\n', "\r\n").replace("JOINT", "joint").replace("End Site", "END SITE")).unwrap(),
        clip
    );
}

#[test]
fn errors_name_the_line() {
    let line = |text: &str| match parse(text).unwrap_err() {
        BodyError::Bvh { line, message, .. } => (line, message),
        other => panic!("{other}"),
    };
    assert_eq!(line("").0, 1);
    assert_eq!(line("HIERARCHY\nJOINT Hips").0, 2);
    assert_eq!(
        line(&CLIP.replacen("OFFSET 0.1 0 0", "OFFSET 0.1 zero 0", 1)),
        (8, "'zero' where a finite number should stand".to_owned())
    );
    assert_eq!(line(&CLIP.replacen("OFFSET 0.1 0 0", "OFFSET 0.1 nan 0", 1)).0, 8);
    assert_eq!(line(&CLIP.replacen("Xposition", "Wposition", 1)).0, 5);
    assert_eq!(line(&CLIP.replacen("CHANNELS 6", "CHANNELS 7", 1)).0, 5);
    assert!(line(&CLIP.replacen("JOINT LeftLeg", "JOINT Hips", 1)).1.contains("second joint"));
    assert!(line(&CLIP.replacen("Frames: 2", "Frames: 0", 1)).1.contains("frames"));
    assert!(line(&CLIP.replacen("Frames: 2", "Frames: 1e30", 1)).1.contains("frames"));
    assert!(line(&CLIP.replacen("Time: 0.5", "Time: 0", 1)).1.contains("frame time"));
    assert_eq!(
        line(&CLIP.replacen("Frames: 2", "Frames: 3", 1)),
        (CLIP.lines().count(), "the file ends where a number should stand; it is cut off".to_owned())
    );
    // No cut of the file may panic.
    for end in 0..CLIP.len() - 4 {
        assert!(parse(&CLIP[..end]).is_err(), "cut at {end}");
    }
    assert!(matches!(load_bvh("/nowhere/clip.bvh"), Err(BodyError::Io { .. })));
}

#[test]
fn limbs_take_the_clips_directions_and_the_world_is_z_up() {
    let body = body();
    let skeleton = &body.skeleton;
    let track = parse(CLIP).unwrap().retarget(&body).unwrap();
    assert_eq!(track.span_nanos(), (0, 500_000_000));
    let (rest, moved) = (track.at(0), track.at(500_000_000));
    let bone =
        |pose: &Pose, from: &str, to: &str| (place(skeleton, pose, to) - place(skeleton, pose, from)).normalize();
    let near = |a: DVec3, b: DVec3| assert!((a - b).length() < 1e-6, "{a} is not {b}");
    // Our bind pose has the arms down; the clip's rest has them along x.
    near(bone(&rest, "LeftArm", "LeftForeArm"), DVec3::X);
    near(bone(&rest, "LeftForeArm", "LeftHand"), DVec3::X);
    near(bone(&rest, "LeftUpLeg", "LeftLeg"), -DVec3::Z);
    near(bone(&rest, "RightLeg", "RightFoot"), -DVec3::Z);
    // The knee turns by 90 degrees about x: the shin points back, +y of a body that faces -y.
    near(bone(&moved, "LeftLeg", "LeftFoot"), DVec3::Y);
    near(bone(&moved, "LeftUpLeg", "LeftLeg"), -DVec3::Z);
    near(bone(&moved, "RightLeg", "RightFoot"), -DVec3::Z);
    // The arm turns by 90 degrees about z of the file: up.
    near(bone(&moved, "LeftArm", "LeftForeArm"), DVec3::Z);
    // Toes stay in front and the trunk upright.
    assert!(bone(&rest, "LeftFoot", "LeftToeBase").y < -0.9);
    assert!(bone(&rest, "Hips", "Head").z > 0.9);
}

#[test]
fn the_way_is_scaled_by_the_legs_and_the_feet_are_on_the_floor() {
    let clip = parse(CLIP).unwrap();
    for shape in [ShapeParams::man(), ShapeParams::child()] {
        let body = default_template(&shape).unwrap();
        let skeleton = &body.skeleton;
        let track = clip.retarget(&body).unwrap();
        let origins = skeleton.canonical_origins();
        let at = |name: &str| origins[skeleton.joint(name).unwrap()];
        let leg = at("LeftUpLeg").distance(at("LeftLeg")) + at("LeftLeg").distance(at("LeftFoot"));
        let hips = |pose: &Pose| (place(skeleton, pose, "LeftUpLeg") + place(skeleton, pose, "RightUpLeg")) * 0.5;
        let way = hips(&track.at(500_000_000)) - hips(&track.at(0));
        assert!((way - DVec3::new(0.4, -1.0, 0.0) * (leg / 0.8)).length() < 1e-6, "{way}");
        let lowest =
            place(skeleton, &track.at(0), "LeftToeBase").z.min(place(skeleton, &track.at(0), "RightToeBase").z);
        assert!((lowest - at("LeftToeBase").y).abs() < 1e-3, "{lowest}");
    }
}

#[test]
fn a_clip_that_does_not_fit_says_what_is_missing() {
    let body = body();
    let error = parse(&CLIP.replace("LeftLeg", "limb_7")).unwrap().retarget(&body).unwrap_err().to_string();
    assert!(error.contains("test.bvh has no joint 'LeftLeg'"), "{error}");
    let flat = parse(&CLIP.replace("OFFSET 0 -0.4 0", "OFFSET 0 0 0")).unwrap();
    assert!(flat.retarget(&body).unwrap_err().to_string().contains("legs of no length"));
    // Case and prefixes do not matter.
    parse(&CLIP.replace("JOINT Left", "JOINT mixamorig:left")).unwrap().retarget(&body).unwrap();
}

#[test]
fn joints_that_the_clip_does_not_know_stay_at_rest() {
    let body = body();
    let skeleton = &body.skeleton;
    let pose = parse(CLIP).unwrap().retarget(&body).unwrap().at(500_000_000);
    for name in ["RightForeArm", "Head", "LThumb"] {
        let joint = skeleton.joint(name).unwrap();
        assert!(pose.joint_rotations[joint].angle_between(DQuat::IDENTITY) < 1e-9, "{name}");
    }
}
