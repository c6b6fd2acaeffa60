//! Retargeted feet stand where those of the source stand.
#![allow(clippy::unwrap_used)]

use std::fmt::Write;
use std::path::Path;

use flyrig_body::{MotionClip, RetargetOptions, ShapeParams, Skeleton, default_template, parse_bvh};
use glam::DVec3;

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
fn slide_and_depth(skeleton: &Skeleton, options: &RetargetOptions) -> (f64, f64) {
    let track = walker(4.0).retarget(skeleton, options).unwrap();
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
        let skeleton = default_template(&shape).unwrap().skeleton;
        let (slide, depth) = slide_and_depth(&skeleton, &RetargetOptions::default());
        println!("slides {:.2} mm, sinks {:.2} mm", slide * 1e3, depth * 1e3);
        assert!(slide < 5e-3 && depth < 5e-3, "slides {slide} m, sinks {depth} m");
    }
}

#[test]
fn a_way_shrunk_to_the_room_is_walked_in_shorter_steps() {
    let skeleton = default_template(&ShapeParams::woman()).unwrap().skeleton;
    let options = RetargetOptions { reach_m: Some(0.4), start_secs: 0.3, ..RetargetOptions::default() };
    let (slide, depth) = slide_and_depth(&skeleton, &options);
    println!("slides {:.2} mm, sinks {:.2} mm", slide * 1e3, depth * 1e3);
    assert!(slide < 5e-3 && depth < 5e-3, "slides {slide} m, sinks {depth} m");
    let track = walker(4.0).retarget(&skeleton, &options).unwrap();
    assert_eq!(track.span_nanos().0, 0);
    let farthest = track.keys().iter().map(|(_, pose)| pose.root_translation.truncate().length()).fold(0.0, f64::max);
    assert!((farthest - 0.4).abs() < 1e-6, "{farthest}");
}
