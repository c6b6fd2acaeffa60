//! Retargeted feet stand where those of the source stand.
#![allow(clippy::unwrap_used)]

use std::fmt::Write;
use std::path::Path;

use flyrig_body::{
    Joint, MotionClip, Part, RetargetOptions, ShapeParams, Shoes, Skeleton, Template, default_template, parse_bvh,
    skin_mesh,
};
use flyrig_types::PoseTrack;
use glam::{DMat4, DVec3, Vec3};

const FPS: f64 = 60.0;
const STRIDE_SECS: f64 = 1.2;
const STEP: f64 = 9.0;
const STANCE: f64 = 0.62;

/// Returns the phase in the stride of a foot of the walker, and its ankle's position along the path and above the floor.
fn foot(secs: f64, right: bool) -> (f64, f64, f64) {
    let strides = secs / STRIDE_SECS + if right { 0.5 } else { 0.0 };
    let (index, phase) = (strides.floor(), strides.fract());
    let planted = 2.0 * STEP * (index - if right { 0.5 } else { 0.0 } + 0.5 * STANCE);
    let swing = ((phase - STANCE) / (1.0 - STANCE)).max(0.0);
    let moved = swing * swing * (3.0 - 2.0 * swing);
    (phase, planted + 2.0 * STEP * moved, 1.6 + 2.2 * (std::f64::consts::PI * swing).sin().powi(2))
}

/// Returns a walk along +z, in inches, with flat feet that stand for the first 62 % of each stride.
fn walker(secs: f64) -> MotionClip {
    let mut text = "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation\n".to_owned();
    for (side, x) in [("Left", 3.6), ("Right", -3.6)] {
        let leg = |name: &str, offset: &str| {
            format!("JOINT {side}{name}\n{{\nOFFSET {offset}\nCHANNELS 3 Zrotation Yrotation Xrotation\n")
        };
        text += &leg("UpLeg", &format!("{x} -1 0"));
        text += &leg("Leg", "0 -17 0");
        text += &leg("Foot", "0 -15 0");
        text += &leg("ToeBase", "0 -1.2 5");
        text += "End Site\n{\nOFFSET 0 0 2\n}\n}\n}\n}\n}\n";
    }
    let count = (secs * FPS) as usize;
    write!(text, "}}\nMOTION\nFrames: {count}\nFrame Time: {}\n", 1.0 / FPS).unwrap();
    for frame in 0..count {
        let secs = frame as f64 / FPS;
        let hips = DVec3::new(0.0, 33.0, 2.0 * STEP * secs / STRIDE_SECS);
        write!(text, "{} {} {} 0 0 0 ", hips.x, hips.y, hips.z).unwrap();
        for right in [false, true] {
            let (_, along, above) = foot(secs, right);
            let (down, forth) = (hips.y - 1.0 - above, along - hips.z);
            let distance = down.hypot(forth).min(31.99);
            let to_foot = forth.atan2(down);
            let hip = ((17.0f64.powi(2) + distance.powi(2) - 15.0f64.powi(2)) / (34.0 * distance)).acos();
            let knee = ((17.0f64.powi(2) + 15.0f64.powi(2) - distance.powi(2)) / (2.0 * 17.0 * 15.0)).acos();
            // Positive turns about x lift the shin backwards.
            let (thigh, shin) = (-(to_foot + hip), std::f64::consts::PI - knee);
            let foot = -(thigh + shin);
            write!(text, "0 0 {} 0 0 {} 0 0 {} 0 0 0 ", thigh.to_degrees(), shin.to_degrees(), foot.to_degrees())
                .unwrap();
        }
        text.push('\n');
    }
    parse_bvh(&text, Path::new("walker.bvh")).unwrap().motion()
}

/// Returns the largest movement of a standing foot's joints over the floor, and the largest depth of its sole below it, metres.
fn slide_and_depth(body: &Template, options: &RetargetOptions) -> (f64, f64) {
    let skeleton = &body.skeleton;
    let track = walker(4.0).retarget(body, options).unwrap();
    let origins = skeleton.canonical_origins();
    let (mut slide, mut depth) = (0.0f64, 0.0f64);
    for (right, ankle, toe) in [(false, "LeftFoot", "LeftToeBase"), (true, "RightFoot", "RightToeBase")] {
        let joints = [ankle, toe].map(|name| skeleton.joint(name).unwrap());
        let mut stood: Option<[DVec3; 2]> = None;
        for (nanos, pose) in track.keys() {
            let phase = foot(*nanos as f64 * 1e-9 + options.start_secs, right).0;
            let world = skeleton.world_from_joint(pose);
            let places = joints.map(|joint| world[joint].w_axis.truncate());
            for (place, joint) in places.iter().zip(joints) {
                depth = depth.max(origins[joint].y - place.z);
            }
            // The ends of a stand are slow parts of a swing for a detector.
            stood = (0.08..STANCE - 0.08).contains(&phase).then(|| stood.unwrap_or(places));
            for (start, now) in stood.unwrap_or(places).iter().zip(&places) {
                slide = slide.max(start.truncate().distance(now.truncate()));
            }
        }
    }
    (slide, depth)
}

#[test]
fn standing_feet_do_not_slide_or_sink_on_bodies_of_other_proportions() {
    for shape in [ShapeParams::man(), ShapeParams::child(), ShapeParams::heavy_man(), ShapeParams::petite_woman()] {
        let body = default_template(&shape).unwrap();
        let (slide, depth) = slide_and_depth(&body, &RetargetOptions::default());
        println!("slides {:.2} mm, sinks {:.2} mm", slide * 1e3, depth * 1e3);
        assert!(slide < 5e-3 && depth < 5e-3, "slides {slide} m, sinks {depth} m");
    }
}

#[test]
fn a_way_shrunk_to_the_room_is_walked_in_shorter_steps() {
    let body = default_template(&ShapeParams::woman()).unwrap();
    let options = RetargetOptions { reach_m: Some(0.4), start_secs: 0.3, ..RetargetOptions::default() };
    let (slide, depth) = slide_and_depth(&body, &options);
    println!("slides {:.2} mm, sinks {:.2} mm", slide * 1e3, depth * 1e3);
    assert!(slide < 5e-3 && depth < 5e-3, "slides {slide} m, sinks {depth} m");
    let track = walker(4.0).retarget(&body, &options).unwrap();
    assert_eq!(track.span_nanos().0, 0);
    let farthest = track.keys().iter().map(|(_, pose)| pose.root_translation.truncate().length()).fold(0.0, f64::max);
    assert!((farthest - 0.4).abs() < 1e-6, "{farthest}");
}

/// Returns the body with its bind pose moved up, so that its origin lies lower in it.
fn raised(body: &Template, up_m: f64) -> Template {
    let up = DVec3::Y * up_m;
    let joint = |joint: &Joint| Joint {
        rest_translation: joint.rest_translation + if joint.parent.is_none() { up } else { DVec3::ZERO },
        joint_from_canonical: joint.joint_from_canonical * DMat4::from_translation(-up),
        ..joint.clone()
    };
    Template {
        positions: body.positions.iter().map(|place| *place + up.as_vec3()).collect(),
        skeleton: Skeleton::new(body.skeleton.joints().iter().map(joint).collect()).unwrap(),
        ..body.clone()
    }
}

/// Returns the largest distance between joints in two tracks of the same times, metres.
fn apart(a: (&Template, &PoseTrack), b: (&Template, &PoseTrack)) -> f64 {
    assert_eq!(a.1.keys().len(), b.1.keys().len());
    let mut worst = 0.0f64;
    for ((at, pose), (_, other)) in a.1.keys().iter().zip(b.1.keys()) {
        let worlds = [a.0.skeleton.world_from_joint(pose), b.0.skeleton.world_from_joint(other)];
        for (joint, other) in worlds[0].iter().zip(&worlds[1]) {
            let off = joint.w_axis.distance(other.w_axis);
            assert!(off.is_finite(), "at {at} ns");
            worst = worst.max(off);
        }
    }
    worst
}

#[test]
fn the_height_of_the_bind_pose_does_not_matter() {
    let bare = default_template(&ShapeParams::man()).unwrap();
    let shod = Shoes { sole_m: 0.03 }.on(&bare).unwrap();
    for (body, sole_m) in [(&bare, 0.0), (&bare, 0.02), (&shod, 0.0)] {
        let options = RetargetOptions { sole_m, ..RetargetOptions::default() };
        let track = |body: &Template| walker(2.5).retarget(body, &options).unwrap();
        let usual = track(body);
        for up_m in [-1.7, -0.95, -0.3, -0.004, 0.02, 0.16, 0.8, 5.0] {
            let raised = raised(body, up_m);
            assert!((raised.floor_y() - body.floor_y() - up_m).abs() < 1e-5, "{up_m}");
            let off = apart((body, &usual), (&raised, &track(&raised)));
            assert!(off < 2e-5, "a bind pose {up_m} m higher, soles of {sole_m} m: {off} m off");
        }
    }
}

#[test]
fn the_lowest_vertex_is_on_the_floor_in_every_frame_of_a_walk() {
    let bare = default_template(&ShapeParams::woman()).unwrap();
    let shod = Shoes { sole_m: 0.04 }.on(&bare).unwrap();
    for (what, body) in [("bare", raised(&bare, -0.9)), ("shod", raised(&shod, -0.9)), ("at the floor", shod)] {
        let track = walker(4.0).retarget(&body, &RetargetOptions::default()).unwrap();
        let lowest = |pose| skin_mesh(&body, pose).0.iter().map(|place| place.z).fold(f32::INFINITY, f32::min);
        let heights = track.keys().iter().step_by(5).map(|(_, pose)| lowest(pose));
        let (low, high) = heights.fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), z| (a.min(z), b.max(z)));
        println!("{what}: {:.1} to {:.1} mm", 1e3 * low, 1e3 * high);
        assert!(low > -0.02 && high < 0.02, "{what}: the lowest vertex is at {low} to {high} m");
    }
}

#[test]
fn vertices_that_belong_to_no_sole_do_not_move_the_floor() {
    let body = default_template(&ShapeParams::man()).unwrap();
    let usual = walker(2.5).retarget(&body, &RetargetOptions::default()).unwrap();
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1e30, -0.6, 3e38];
    let mut poisoned = body.clone();
    let feet = |part: &Part| matches!(part, Part::LeftFoot | Part::RightFoot);
    // One in fifty vertices of the feet; below the hands and the hips anything may hang.
    let of_feet = (0..body.positions.len()).filter(|&i| feet(&body.parts[i])).step_by(50);
    for (i, bad) in of_feet.zip(bad.iter().cycle()) {
        poisoned.positions[i].y = *bad;
    }
    let others = (0..body.positions.len()).filter(|&i| !feet(&body.parts[i])).step_by(90);
    others.for_each(|i| poisoned.positions[i] = Vec3::NEG_Y * 0.1);
    assert!((poisoned.floor_y() - body.floor_y()).abs() < 2e-3, "{}", poisoned.floor_y());
    let track = retargeted(&poisoned);
    let off = apart((&body, &usual), (&poisoned, &track));
    assert!(off < 5e-3, "{off} m off");

    // Without a mesh, or with none that can be used, the joints of the feet show the floor.
    let mut lost = body.clone();
    lost.positions.iter_mut().for_each(|place| *place = Vec3::NAN);
    for bodiless in [Template::empty("joints", body.skeleton.clone()), lost] {
        assert!(bodiless.floor_y().abs() < 0.03, "{}", bodiless.floor_y());
        let raised = raised(&bodiless, -0.9);
        let (own, other) = (retargeted(&bodiless), retargeted(&raised));
        let off = apart((&bodiless, &own), (&raised, &other));
        assert!(off < 1e-6, "{off} m off");
    }
}

fn retargeted(body: &Template) -> PoseTrack {
    walker(2.5).retarget(body, &RetargetOptions::default()).unwrap()
}
