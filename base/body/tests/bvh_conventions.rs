//! BVH clips of other programs: one motion in their rest poses, axes and names.
// Helpers of tests may stop a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use flyrig_body::{BodyError, ShapeParams, Skeleton, Template, default_template, load_bvh, parse_bvh};
use flyrig_types::PoseTrack;
use glam::{DMat3, DQuat, DVec3, EulerRot};

/// Joints with parent and position in a T pose, metres.
const PERSON: [(&str, &str, [f64; 3]); 21] = [
    ("Hips", "", [0.0, 0.95, 0.0]),
    ("Spine", "Hips", [0.0, 1.05, 0.0]),
    ("Spine1", "Spine", [0.0, 1.25, 0.0]),
    ("Neck", "Spine1", [0.0, 1.48, 0.0]),
    ("Head", "Neck", [0.0, 1.58, 0.02]),
    ("LeftShoulder", "Spine1", [0.05, 1.42, 0.0]),
    ("LeftArm", "LeftShoulder", [0.18, 1.42, 0.0]),
    ("LeftForeArm", "LeftArm", [0.45, 1.42, 0.0]),
    ("LeftHand", "LeftForeArm", [0.70, 1.42, 0.0]),
    ("RightShoulder", "Spine1", [-0.05, 1.42, 0.0]),
    ("RightArm", "RightShoulder", [-0.18, 1.42, 0.0]),
    ("RightForeArm", "RightArm", [-0.45, 1.42, 0.0]),
    ("RightHand", "RightForeArm", [-0.70, 1.42, 0.0]),
    ("LeftUpLeg", "Hips", [0.09, 0.90, 0.0]),
    ("LeftLeg", "LeftUpLeg", [0.09, 0.49, 0.0]),
    ("LeftFoot", "LeftLeg", [0.09, 0.09, 0.0]),
    ("LeftToeBase", "LeftFoot", [0.09, 0.02, 0.13]),
    ("RightUpLeg", "Hips", [-0.09, 0.90, 0.0]),
    ("RightLeg", "RightUpLeg", [-0.09, 0.49, 0.0]),
    ("RightFoot", "RightLeg", [-0.09, 0.09, 0.0]),
    ("RightToeBase", "RightFoot", [-0.09, 0.02, 0.13]),
];

/// Ends of the last bones.
const ENDS: [(&str, [f64; 3]); 5] = [
    ("Head", [0.0, 1.78, 0.02]),
    ("LeftHand", [0.88, 1.42, 0.0]),
    ("RightHand", [-0.88, 1.42, 0.0]),
    ("LeftToeBase", [0.09, 0.02, 0.20]),
    ("RightToeBase", [-0.09, 0.02, 0.20]),
];

/// Form in which the motion is written.
struct Form<'a> {
    /// Rest pose: `T`, or all bones along an axis of the joint.
    rest: Rest,
    /// From y up, facing +z, to the file's axes; its determinant may be -1.
    axes: DMat3,
    /// Whether each joint has positions.
    six: bool,
    /// Offsets below the root, as factor, and the positions' distance from them.
    offsets: [f64; 2],
    scale: f64,
    rename: &'a dyn Fn(&str) -> String,
    /// Rotation of a joint away from the T pose in a frame, y up.
    motion: fn(&str, f64) -> DQuat,
    /// Position of the hips away from the T pose, metres.
    way: fn(f64) -> DVec3,
    frames: usize,
}

#[derive(Clone, Copy, PartialEq)]
enum Rest {
    T,
    Along(DVec3),
    /// Bones along x, those of the right side backwards, and the spine turned against the hips: a rig that was mirrored.
    Mirrored,
    /// Feet pointing down, as at rest of some rigs.
    Ballet,
}

impl Default for Form<'_> {
    fn default() -> Self {
        Self {
            rest: Rest::T,
            axes: DMat3::IDENTITY,
            six: false,
            offsets: [1.0, 0.0],
            scale: 100.0,
            rename: &str::to_owned,
            motion: walk,
            way: |t| DVec3::new(0.6, 0.0, 0.9) * t,
            frames: 6,
        }
    }
}

fn walk(joint: &str, t: f64) -> DQuat {
    let wave = (0.5 + 12.0 * t).sin();
    let (x, y, z) = (
        |deg: f64| DQuat::from_rotation_x(deg.to_radians()),
        |deg: f64| DQuat::from_rotation_y(deg.to_radians()),
        |deg: f64| DQuat::from_rotation_z(deg.to_radians()),
    );
    match joint {
        "Hips" => y(20.0 + 120.0 * t),
        "Spine" => x(8.0 * wave),
        "Spine1" => x(7.0) * y(6.0 * wave),
        "Neck" => x(10.0),
        "Head" => y(15.0 * wave),
        "LeftArm" => z(-60.0 + 150.0 * t),
        "RightArm" => z(35.0) * x(20.0 * wave),
        "LeftForeArm" => y(-40.0),
        "RightForeArm" => y(30.0 + 90.0 * t),
        "LeftUpLeg" => x(-30.0 * wave),
        "LeftLeg" => x(35.0),
        "LeftFoot" => x(-6.0),
        "RightUpLeg" => x(14.0 * wave),
        "RightLeg" => x(10.0),
        _ => DQuat::IDENTITY,
    }
}

fn place(joint: &str) -> DVec3 {
    DVec3::from(PERSON.iter().find(|(name, ..)| *name == joint).unwrap().2)
}

fn parent(joint: &str) -> &'static str {
    PERSON.iter().find(|(name, ..)| *name == joint).unwrap().1
}

/// Returns the end of a joint's bone.
fn tip(joint: &str) -> DVec3 {
    let main = ["Spine", "Spine1", "Neck", "Head"].into_iter().find(|child| parent(child) == joint);
    let child = main.or_else(|| PERSON.iter().map(|(name, ..)| *name).find(|child| parent(child) == joint));
    child.map_or_else(|| DVec3::from(ENDS.iter().find(|(name, _)| *name == joint).unwrap().1), place)
}

impl Form<'_> {
    /// Returns the axes of a joint, T pose, in which its rotation is zero at rest.
    fn joint_axes(&self, joint: &str) -> DMat3 {
        match self.rest {
            Rest::Mirrored => {
                let along = Self { rest: Rest::Along(DVec3::X), ..Self::default() }.joint_axes(joint);
                let quarter = 90f64.to_radians();
                if joint.starts_with("Right") && joint != "RightShoulder" {
                    along * DMat3::from_rotation_z(2.0 * quarter)
                } else if joint == "Hips" || joint.contains("Leg") {
                    along
                } else {
                    along * DMat3::from_rotation_x(quarter)
                }
            }
            Rest::Along(axis) => {
                let bone = (tip(joint) - place(joint)).normalize();
                let up = if bone.z.abs() < 0.9 { DVec3::Z } else { DVec3::Y };
                let front = (up - bone * bone.dot(up)).normalize();
                let from_t = DMat3::from_cols(bone, front.cross(bone), front);
                // The same frame with the bone along another axis.
                from_t * DMat3::from_quat(DQuat::from_rotation_arc(axis, DVec3::X))
            }
            Rest::Ballet if joint.ends_with("Foot") => DMat3::from_rotation_x(-50f64.to_radians()),
            _ => DMat3::IDENTITY,
        }
    }

    /// Returns the file.
    fn text(&self) -> String {
        let mut text = "HIERARCHY\n".to_owned();
        let mut order = Vec::new();
        self.write_joint("Hips", 0, &mut text, &mut order);
        writeln!(text, "MOTION\nFrames: {}\nFrame Time: 0.0333333", self.frames).unwrap();
        let flip = |rotation: DMat3| self.axes * rotation * self.axes.inverse();
        for frame in 0..self.frames {
            let t = frame as f64 / 30.0;
            let mut numbers = Vec::new();
            for joint in &order {
                let turn = DMat3::from_quat((self.motion)(joint, t));
                let axes = self.joint_axes(joint);
                let (above, moved) = match parent(joint) {
                    "" => (DMat3::IDENTITY, Some(place(joint) + (self.way)(t))),
                    name => {
                        let above = self.joint_axes(name);
                        let offset = above.transpose() * (place(joint) - place(name));
                        (above, self.six.then(|| offset * (1.0 - self.offsets[1])))
                    }
                };
                numbers.extend(moved.iter().flat_map(|at| (self.axes * *at * self.scale).to_array()));
                let local = flip(above.transpose() * turn * axes);
                let (z, y, x) = DQuat::from_mat3(&local).to_euler(EulerRot::ZYX);
                numbers.extend([z, y, x].map(f64::to_degrees));
            }
            let numbers: Vec<String> = numbers.iter().map(|number| format!("{number:.6}")).collect();
            writeln!(text, "{}", numbers.join(" ")).unwrap();
        }
        text
    }

    fn write_joint(&self, joint: &'static str, depth: usize, text: &mut String, order: &mut Vec<&'static str>) {
        let pad = "\t".repeat(depth);
        let is_root = depth == 0;
        let vector = |at: DVec3, pad: &str, text: &mut String| {
            let at = self.axes * at * self.scale * self.offsets[0];
            writeln!(text, "{pad}\tOFFSET {:.6} {:.6} {:.6}", at.x, at.y, at.z).unwrap();
        };
        writeln!(text, "{pad}{} {}\n{pad}{{", if is_root { "ROOT" } else { "JOINT" }, (self.rename)(joint)).unwrap();
        let offset = match parent(joint) {
            "" => DVec3::ZERO,
            name => self.joint_axes(name).transpose() * (place(joint) - place(name)),
        };
        vector(offset, &pad, text);
        let places = if is_root || self.six { "Xposition Yposition Zposition " } else { "" };
        let count = if places.is_empty() { 3 } else { 6 };
        writeln!(text, "{pad}\tCHANNELS {count} {places}Zrotation Yrotation Xrotation").unwrap();
        order.push(joint);
        for (child, ..) in PERSON.iter().filter(|(child, ..)| parent(child) == joint) {
            self.write_joint(child, depth + 1, text, order);
        }
        if let Some((_, end)) = ENDS.iter().find(|(name, _)| *name == joint) {
            writeln!(text, "{pad}\tEnd Site\n{pad}\t{{").unwrap();
            vector(self.joint_axes(joint).transpose() * (DVec3::from(*end) - place(joint)), &format!("{pad}\t"), text);
            writeln!(text, "{pad}\t}}").unwrap();
        }
        writeln!(text, "{pad}}}").unwrap();
    }

    fn track(&self, body: &Template) -> PoseTrack {
        parse_bvh(&self.text(), Path::new("test.bvh")).unwrap().retarget(body).unwrap()
    }
}

fn body() -> Template {
    default_template(&ShapeParams::man()).unwrap()
}

/// Asserts that both tracks have the same joints in all frames, within `most_m`, the place of the root included.
fn assert_same(skeleton: &Skeleton, a: &PoseTrack, b: &PoseTrack, most_m: f64, what: &str) {
    assert_eq!(a.keys().len(), b.keys().len());
    let mut worst = (0.0, String::new());
    for ((at, a), (_, b)) in a.keys().iter().zip(b.keys()) {
        let (a, b) = (skeleton.world_from_joint(a), skeleton.world_from_joint(b));
        for (joint, (a, b)) in skeleton.joints().iter().zip(a.iter().zip(&b)) {
            let off = a.w_axis.truncate().distance(b.w_axis.truncate());
            if off > worst.0 {
                worst = (off, format!("{} at {at} ns", joint.name));
            }
        }
    }
    println!("{what}: {:.1} mm at {}", worst.0 * 1e3, worst.1);
    assert!(worst.0 < most_m, "{what}: {:.1} mm at {}", worst.0 * 1e3, worst.1);
}

#[test]
fn a_rest_pose_with_all_bones_along_an_axis_gives_the_same_motion() {
    let body = body();
    let skeleton = &body.skeleton;
    let usual = Form::default().track(&body);
    for axis in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X] {
        for six in [false, true] {
            let odd = Form { rest: Rest::Along(axis), six, ..Form::default() };
            assert_same(skeleton, &usual, &odd.track(&body), 0.015, &format!("along {axis}, six {six}"));
        }
    }
    let mirrored = Form { rest: Rest::Mirrored, ..Form::default() };
    assert_same(skeleton, &usual, &mirrored.track(&body), 0.015, "mirrored");
}

#[test]
fn bones_follow_the_source_at_trunk_neck_and_feet() {
    let body = body();
    let skeleton = &body.skeleton;
    for rest in [Rest::T, Rest::Along(DVec3::X), Rest::Ballet] {
        let form = Form { rest, ..Form::default() };
        let track = form.track(&body);
        let world = skeleton.world_from_joint(&track.keys()[0].1);
        let at = |joint: &str| world[skeleton.joint(joint).unwrap()].w_axis.truncate();
        // Forward kinematics of the motion itself.
        let mut theirs: BTreeMap<&str, (DQuat, DVec3)> = BTreeMap::new();
        for (joint, above, _) in PERSON {
            let turn = walk(joint, 0.0);
            let placed = theirs.get(above).map_or((turn, place(joint)), |(rotation, from)| {
                (*rotation * turn, *from + *rotation * (place(joint) - place(above)))
            });
            theirs.insert(joint, placed);
        }
        for (from, to) in [("Hips", "Neck"), ("Neck", "Head"), ("LeftFoot", "LeftToeBase"), ("LeftArm", "LeftForeArm")]
        {
            let bone = theirs[to].1 - theirs[from].1;
            // z up, facing -y.
            let off = (at(to) - at(from)).angle_between(DVec3::new(bone.x, -bone.z, bone.y)).to_degrees();
            assert!(off < 2.0, "{from} to {to}: {off:.1} degrees off");
        }
    }
}

#[test]
fn other_axes_are_read_off_the_person() {
    let body = body();
    let skeleton = &body.skeleton;
    let usual = Form::default().track(&body);
    let turns = [
        ("z up", DMat3::from_rotation_x(90f64.to_radians())),
        ("x up", DMat3::from_rotation_z(-90f64.to_radians())),
        ("y down", DMat3::from_rotation_x(180f64.to_radians())),
        ("left-handed", DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0))),
        ("left-handed, z up", DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::Y)),
    ];
    for rest in [Rest::T, Rest::Along(DVec3::X)] {
        for (what, axes) in turns {
            // A left-handed file and its mirror image differ by the side to which the person walks.
            let mut track = Form { axes, rest, ..Form::default() }.track(&body);
            if what == "left-handed, z up" {
                track = turned(&track, DQuat::from_rotation_z(std::f64::consts::PI));
            }
            assert_same(skeleton, &usual, &track, 0.016, what);
        }
    }
}

/// Turns a track about the z axis.
fn turned(track: &PoseTrack, turn: DQuat) -> PoseTrack {
    let keys = track.keys().iter().map(|(at, pose)| {
        let mut pose = pose.clone();
        pose.root_translation = turn * pose.root_translation;
        pose.joint_rotations[0] = (turn * pose.joint_rotations[0]).normalize();
        (*at, pose)
    });
    PoseTrack::new(keys.collect()).unwrap()
}

#[test]
fn a_person_who_lies_is_not_turned_upright() {
    let body = body();
    let skeleton = &body.skeleton;
    let motion = |joint: &str, _: f64| match joint {
        "Hips" => DQuat::from_rotation_x(-90f64.to_radians()),
        _ => DQuat::IDENTITY,
    };
    let track = Form { motion, ..Form::default() }.track(&body);
    let world = skeleton.world_from_joint(&track.keys()[2].1);
    let at = |joint: &str| world[skeleton.joint(joint).unwrap()].w_axis.truncate();
    let up = (at("Head") - at("Hips")).normalize();
    assert!(up.z.abs() < 0.2, "{up}");
}

#[test]
fn names_of_other_programs_give_the_same_motion() {
    let body = body();
    let skeleton = &body.skeleton;
    let usual = Form::default().track(&body);
    let ours = PERSON.map(|(name, ..)| name);
    let rigs: [(&str, [&str; 21]); 5] = [
        (
            "Poser",
            [
                "hip", "abdomen", "chest", "neck", "head", "lCollar", "lShldr", "lForeArm", "lHand", "rCollar",
                "rShldr", "rForeArm", "rHand", "lThigh", "lShin", "lFoot", "lToe", "rThigh", "rShin", "rFoot", "rToe",
            ],
        ),
        (
            "Second Life",
            [
                "mPelvis",
                "mTorso",
                "mChest",
                "mNeck",
                "mHead",
                "mCollarLeft",
                "mShoulderLeft",
                "mElbowLeft",
                "mWristLeft",
                "mCollarRight",
                "mShoulderRight",
                "mElbowRight",
                "mWristRight",
                "mHipLeft",
                "mKneeLeft",
                "mAnkleLeft",
                "mFootLeft",
                "mHipRight",
                "mKneeRight",
                "mAnkleRight",
                "mFootRight",
            ],
        ),
        (
            "3ds Max",
            [
                "Bip01",
                "Bip01 Spine",
                "Bip01 Spine1",
                "Bip01 Neck",
                "Bip01 Head",
                "Bip01 L Clavicle",
                "Bip01 L UpperArm",
                "Bip01 L Forearm",
                "Bip01 L Hand",
                "Bip01 R Clavicle",
                "Bip01 R UpperArm",
                "Bip01 R Forearm",
                "Bip01 R Hand",
                "Bip01 L Thigh",
                "Bip01 L Calf",
                "Bip01 L Foot",
                "Bip01 L Toe0",
                "Bip01 R Thigh",
                "Bip01 R Calf",
                "Bip01 R Foot",
                "Bip01 R Toe0",
            ],
        ),
        (
            "Bandai Namco",
            [
                "Hips",
                "Spine",
                "Chest",
                "Neck",
                "Head",
                "Shoulder_L",
                "UpperArm_L",
                "LowerArm_L",
                "Hand_L",
                "Shoulder_R",
                "UpperArm_R",
                "LowerArm_R",
                "Hand_R",
                "UpperLeg_L",
                "LowerLeg_L",
                "Foot_L",
                "Toes_L",
                "UpperLeg_R",
                "LowerLeg_R",
                "Foot_R",
                "Toes_R",
            ],
        ),
        (
            "Acclaim",
            [
                "root",
                "lowerback",
                "thorax",
                "lowerneck",
                "head",
                "lclavicle",
                "lhumerus",
                "lradius",
                "lwrist",
                "rclavicle",
                "rhumerus",
                "rradius",
                "rwrist",
                "lfemur",
                "ltibia",
                "lfoot",
                "ltoes",
                "rfemur",
                "rtibia",
                "rfoot",
                "rtoes",
            ],
        ),
    ];
    for (what, names) in rigs {
        let rename = |name: &str| names[ours.iter().position(|own| *own == name).unwrap()].to_owned();
        let track = Form { rename: &rename, ..Form::default() }.track(&body);
        // One more or one less joint of the spine shares the bend differently.
        let most_m = if what == "Acclaim" { 0.02 } else { 1e-6 };
        assert_same(skeleton, &usual, &track, most_m, what);
    }
}

#[test]
fn positions_of_joints_may_replace_or_add_to_their_offsets_in_any_unit() {
    let body = body();
    let skeleton = &body.skeleton;
    let usual = Form::default().track(&body);
    for (what, offsets, scale) in [
        ("no offsets", [0.0, 0.0], 100.0),
        ("positions relative to the offsets", [1.0, 1.0], 100.0),
        ("metres", [1.0, 0.0], 1.0),
        ("inches", [1.0, 0.0], 39.37),
    ] {
        let track = Form { six: true, offsets, scale, ..Form::default() }.track(&body);
        assert_same(skeleton, &usual, &track, 1e-3, what);
    }
}

#[test]
fn feet_are_level_where_the_source_stands() {
    let body = body();
    let skeleton = &body.skeleton;
    // Twenty frames of standing, with the ankle of the source lower above the toes than ours.
    let motion = |_: &str, _: f64| DQuat::IDENTITY;
    for rest in [Rest::T, Rest::Along(DVec3::X)] {
        let track = Form { rest, motion, way: |_| DVec3::ZERO, frames: 20, ..Form::default() }.track(&body);
        let world = skeleton.world_from_joint(&track.keys()[10].1);
        for name in ["LeftFoot", "RightFoot"] {
            let joint = skeleton.joint(name).unwrap();
            let up = DQuat::from_mat4(&world[joint]) * skeleton.joints()[joint].rest_rotation.inverse() * DVec3::Y;
            let off = up.angle_between(DVec3::Z).to_degrees();
            assert!(off < 0.5, "{name} is tilted by {off:.1} degrees");
        }
    }
}

#[test]
fn text_of_other_editors_is_read() {
    let text = Form::default().text();
    let usual = parse_bvh(&text, Path::new("test.bvh")).unwrap();
    let same = |text: &str, what: &str| assert_eq!(parse_bvh(text, Path::new("test.bvh")).unwrap(), usual, "{what}");
    same(&format!("\u{feff}{text}"), "byte order mark");
    same(&text.replace('\n', "\r"), "carriage returns");
    same(&text.replace("Frames: 6", "Frames:6").replace("Time: ", "Time:"), "no space behind the colon");
    same(&text.replace("Frames: 6", "Frames :\t6"), "a space before the colon");
    same(&text.replace("Frames: 6", "Frames 6"), "no colon");
    same(&text.replace("LeftUpLeg\n\t{", "LeftUpLeg {"), "a brace on the name's line");
    same(&text.replace("End Site", "End Site_of_hand"), "a named end");
    same(&text.replace("End Site", "EndSite"), "an end in one word");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("test.bvh");
    let wide = |mark: [u8; 2], bytes: fn(u16) -> [u8; 2]| -> Vec<u8> {
        mark.into_iter().chain(text.encode_utf16().flat_map(bytes)).collect()
    };
    for bytes in [wide([0xff, 0xfe], u16::to_le_bytes), wide([0xfe, 0xff], u16::to_be_bytes)] {
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(load_bvh(&path).unwrap().frames, usual.frames);
    }
}

#[test]
fn numbers_that_do_not_fit_the_skeleton_are_refused() {
    let text = Form::default().text();
    let refused = |text: &str| match parse_bvh(text, Path::new("test.bvh")).unwrap_err() {
        BodyError::Bvh { message, .. } => message,
        other => panic!("{other}"),
    };
    // One number too many in each line would shift all that follows.
    let (head, lines) = text.split_at(text.find("0.0333333\n").unwrap() + 10);
    let wide = lines.lines().map(|line| format!("{line} 0\n")).collect::<String>();
    assert!(refused(&format!("{head}{wide}")).contains("6 numbers are left after 6 frames of 66 channels"));
    // Whole frames beyond the header's number are left out.
    let more = text.replace("Frames: 6", "Frames: 4");
    assert_eq!(parse_bvh(&more, Path::new("test.bvh")).unwrap().frames.len(), 4);
    assert!(refused(&text.replace("JOINT Spine\n", "JOINT\n")).contains("a joint without a name"));
}
