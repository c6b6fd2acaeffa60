//! Invariants of all clips.

use flyrig_body::skin_mesh;
use flyrig_types::PoseTrack;
use glam::{DVec3, Vec3};

use super::*;
use crate::config::{Build, SimConfig};
use crate::motion::choice::pass_by;
use crate::person::assembly::Person;
use crate::person::look::PersonLook;

const ALL: [MotionKind; 10] = [
    MotionKind::Turn,
    MotionKind::Walk,
    MotionKind::Wave,
    MotionKind::Squat,
    MotionKind::Reach,
    MotionKind::Sit,
    MotionKind::Lie,
    MotionKind::Jump,
    MotionKind::CrossArms,
    MotionKind::Dance,
];

fn person(seed: u64, build: Build) -> Person {
    let mut config = SimConfig { seed, texture_px: 64, ..SimConfig::default() };
    config.person.build = build;
    Person::new(&PersonLook::new(&config), seed, 64, false).unwrap()
}

/// Returns the person's soles without the crease between foot and toes, where they bend.
fn soles(person: &Person) -> flyrig_body::Template {
    let mut soles = person.clothed.clone();
    let shoes = person.shoe_vertices.clone();
    let ground = soles.positions[shoes.clone()].iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    let toes = person.body.skeleton.joint("LeftToeBase").unwrap();
    let crease = person.body.skeleton.canonical_origins()[toes].z as f32;
    let kept: Vec<usize> = shoes
        .filter(|&v| soles.positions[v].y < ground + 0.002 && (soles.positions[v].z - crease).abs() > 0.045)
        .collect();
    soles.positions = kept.iter().map(|&v| soles.positions[v]).collect();
    soles.normals = kept.iter().map(|&v| soles.normals[v]).collect();
    soles.skin = kept.iter().map(|&v| soles.skin[v]).collect();
    soles
}

/// Returns the farthest that a foot slides over the floor while it rests flat and slow (from frame to frame by its ball
/// or its heel, whichever moves less: a foot may turn about either), and the deepest that any point of its sole goes
/// below.
fn slide_and_depth_of_rests(person: &Person, track: &PoseTrack) -> (f32, f32) {
    const FPS: f32 = 60.0;
    let soles = soles(person);
    let skeleton = &person.body.skeleton;
    let origins = skeleton.canonical_origins();
    let ground = soles.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    let end = track.span_nanos().1;
    let steps = (end as f64 * 1e-9 * f64::from(FPS)).ceil() as i64;
    let (mut slide, mut depth, mut rests) = (0.0f32, 0.0f32, 0);
    let mut slid = [0.0f32; 2];
    let mut before = [[Vec3::ZERO; 2]; 2];
    for step in 0..=steps {
        let pose = track.at(end / steps * step);
        let positions = skin_mesh(&soles, &pose).0;
        let world = skeleton.world_from_joint(&pose);
        for (foot, (left, toe)) in [(true, "LeftToeBase"), (false, "RightToeBase")].into_iter().enumerate() {
            let points = || positions.iter().zip(&soles.positions).filter(|(_, c)| (c.x > 0.0) == left);
            // On the sole, below the toe joint and behind the ankle, carried by the foot.
            let ankle = skeleton.joints()[skeleton.joint(toe).unwrap()].parent.unwrap();
            let toe = origins[skeleton.joint(toe).unwrap()];
            let matrix = world[ankle] * skeleton.joints()[ankle].joint_from_canonical;
            let on_sole = |x: f64, z: f64| matrix.transform_point3(DVec3::new(x, f64::from(ground), z)).as_vec3();
            let ball = on_sole(toe.x, toe.z);
            let heel = on_sole(origins[ankle].x, origins[ankle].z - 0.55 * (toe.z - origins[ankle].z) - 0.01);
            depth = points().map(|(p, _)| -p.z).fold(depth, f32::max);
            let moved = |a: Vec3, b: Vec3| a.truncate().distance(b.truncate());
            let [was_ball, was_heel] = before[foot];
            if moved(ball, was_ball) * FPS < 0.12 && points().all(|(p, _)| p.z < 0.03) {
                rests += 1;
                slid[foot] += moved(ball, was_ball).min(moved(heel, was_heel));
                slide = slide.max(slid[foot]);
            } else {
                slid[foot] = 0.0;
            }
            before[foot] = [ball, heel];
        }
    }
    assert!(rests > 0);
    (slide, depth)
}

/// Returns the farthest that a point of the soles moves over the floor while touching it, and the deepest it goes
/// below.
fn slide_and_depth(person: &Person, track: &PoseTrack) -> (f32, f32) {
    const TOUCHES_M: f32 = 0.002;
    let soles = soles(person);
    let end = track.span_nanos().1;
    let steps = (end as f64 * 1e-9 * 60.0).ceil() as i64;
    let mut touched: Vec<Option<Vec3>> = vec![None; soles.positions.len()];
    let (mut slide, mut depth) = (0.0f32, 0.0f32);
    for step in 0..=steps {
        let (positions, _) = skin_mesh(&soles, &track.at(end / steps * step));
        for (point, at) in touched.iter_mut().zip(positions) {
            depth = depth.max(-at.z);
            *point = (at.z < TOUCHES_M).then(|| point.unwrap_or(at));
            slide = slide.max(point.map_or(0.0, |start| start.truncate().distance(at.truncate())));
        }
    }
    (slide, depth)
}

fn assert_closed(what: &str, track: &PoseTrack) {
    let keys = track.keys();
    let turn = |a: &flyrig_types::Pose, b: &flyrig_types::Pose| {
        (a.joint_rotations.iter().zip(&b.joint_rotations)).map(|(a, b)| a.angle_between(*b)).fold(0.0, f64::max)
    };
    let (first, last) = (&keys[0].1, &keys[keys.len() - 1].1);
    assert!(first.root_translation.distance(last.root_translation) < 1e-9 && turn(first, last) < 1e-6, "{what}");
    // Over the seam nothing happens that does not happen elsewhere: no jump of pose or speed.
    let speed = |i: usize| {
        let (a, b) = (&keys[i % (keys.len() - 1)].1, &keys[i % (keys.len() - 1) + 1].1);
        (b.root_translation - a.root_translation, turn(a, b))
    };
    let change = |i: usize| {
        let ((m0, t0), (m1, t1)) = (speed(i), speed(i + 1));
        (m1.distance(m0), (t1 - t0).abs())
    };
    let all: Vec<(f64, f64)> = (0..keys.len() - 2).map(change).collect();
    let seam = change(keys.len() - 2);
    let most = all.iter().fold((0.0f64, 0.0f64), |most, c| (most.0.max(c.0), most.1.max(c.1)));
    assert!(seam.0 <= most.0 + 1e-9 && seam.1 <= most.1 + 1e-6, "{what}: {seam:?} of at most {most:?}");
    // Most of a turn in two keys: the feet at take-off.
    assert!(most.0 < 0.012 && most.1 < 0.5, "{what}: the motion jerks by {most:?} from key to key");
}

#[test]
fn clips_close_feet_stay_where_they_stand_and_above_the_floor() {
    let mut bad = Vec::new();
    for (seed, build) in [(5, Build::BySeed), (7, Build::BySeed), (3, Build::HeavyMan)] {
        let person = person(seed, build);
        let puppet = Puppet::new(&person.body.skeleton, &person.clothed).unwrap();
        for kind in ALL {
            for speed in [0.5, 1.0, 1.7] {
                let what = format!("{kind:?} of {seed} at {speed}");
                let track = clip(kind, &puppet, seed, 10.0, speed).track(&puppet, 0.0).unwrap();
                let (slide, depth) = slide_and_depth(&person, &track);
                if slide > 2e-3 || depth > 4e-3 {
                    bad.push(format!("{what}: slides {:.2} mm, sinks {:.2} mm", slide * 1e3, depth * 1e3));
                }
                assert_closed(&what, &track);
            }
        }
    }
    assert!(bad.is_empty(), "planted feet slide or soles sink: {bad:?}");
}

#[test]
fn a_passer_by_walks_in_from_afar_beside_the_centre_and_comes_back() {
    let person = person(11, Build::BySeed);
    for seed in 0..3 {
        let track = pass_by(&person, seed, 4.0).unwrap();
        assert_closed("pass by", &track);
        let distance = |pose: &flyrig_types::Pose| pose.root_translation.truncate().length();
        let nearest = track.keys().iter().map(|(_, pose)| distance(pose)).fold(f64::INFINITY, f64::min);
        let farthest = track.keys().iter().map(|(_, pose)| distance(pose)).fold(0.0, f64::max);
        assert!((0.62..1.25).contains(&nearest) && (3.8..4.7).contains(&farthest), "{nearest} to {farthest} m");
        let (slide, depth) = slide_and_depth(&person, &track);
        assert!(slide < 2e-3 && depth < 4e-3, "slides {slide} m, sinks {depth} m");
    }
}

#[test]
fn debians_clip_keeps_its_feet_on_the_floor_when_it_is_installed() {
    if crate::find_debian_clip().is_err() {
        return;
    }
    for (seed, build) in [(5, Build::BySeed), (7, Build::BySeed), (3, Build::HeavyMan)] {
        let person = person(seed, build);
        for reach_m in [0.2, 10.0] {
            let mut config = SimConfig::default();
            (config.motion.kind, config.motion.start_secs, config.motion.reach_m) = (MotionKind::Bvh, 1.0, reach_m);
            let track = crate::motion::choice::track(&config, &person).unwrap();
            let (slide, depth) = slide_and_depth_of_rests(&person, &track);
            println!("within {reach_m} m: slides {:.1} mm, sinks {:.1} mm", slide * 1e3, depth * 1e3);
            assert!(slide < 5e-3 && depth < 5e-3, "slides {slide} m, sinks {depth} m");
        }
    }
}

#[test]
fn a_seed_chooses_kind_speed_and_phase_and_speed_0_stands_still() {
    let person = person(5, Build::BySeed);
    let mut lengths = std::collections::BTreeSet::new();
    for seed in 0..12 {
        let mut config = SimConfig { seed, ..SimConfig::default() };
        config.motion.kind = MotionKind::BySeed;
        let track = crate::motion::choice::track(&config, &person).unwrap();
        lengths.insert(track.span_nanos().1);
        assert_eq!(track, crate::motion::choice::track(&config, &person).unwrap());
    }
    assert!(lengths.len() > 9, "{lengths:?}");
    for kind in ALL {
        let mut config = SimConfig::default();
        (config.motion.kind, config.motion.speed, config.motion.phase) = (kind, 0.0, 0.3);
        let track = crate::motion::choice::track(&config, &person).unwrap();
        assert_eq!(track.at_repeated(0), track.at_repeated(3_456_789_012));
    }
}
