//! The built-in body is complete, in metres, in any shape, with a skeleton that follows the shape.
// Helpers of tests may stop a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::collections::HashMap;

use flyrig_body::{BodyError, Part, ShapeParams, Template, default_template, shape_targets};
use glam::Vec3;

fn extent(template: &Template) -> (Vec3, Vec3) {
    let all = || template.positions.iter().copied();
    (all().reduce(Vec3::min).unwrap(), all().reduce(Vec3::max).unwrap())
}

fn height(shape: &ShapeParams) -> f32 {
    extent(&default_template(shape).unwrap()).1.y
}

#[test]
fn it_is_a_closed_surface_with_outward_normals() {
    let body = default_template(&ShapeParams::default()).unwrap();
    body.check().unwrap();
    assert_eq!((body.positions.len(), body.triangles.len(), body.skeleton.joints().len()), (14_517, 26_756, 31));
    let class = body.welded();
    let mut edges = HashMap::new();
    let mut volume = 0.0;
    for triangle in &body.triangles {
        let [a, b, c] = triangle.map(|i| body.positions[i as usize]);
        volume += a.dot(b.cross(c)) / 6.0;
        for (from, to) in [(0, 1), (1, 2), (2, 0)] {
            let [from, to] = [from, to].map(|i| class[triangle[i] as usize]);
            *edges.entry((from, to)).or_insert(0) += 1;
        }
    }
    // Every edge is walked once in each direction.
    assert!(edges.iter().all(|((from, to), count)| *count == 1 && edges.contains_key(&(*to, *from))));
    assert!((0.045..0.07).contains(&volume), "{volume} cubic metres");
    let outward = body.triangles.iter().filter(|triangle| {
        let [a, b, c] = triangle.map(|i| body.positions[i as usize]);
        let normal: Vec3 = triangle.iter().map(|&i| body.normals[i as usize]).sum();
        (b - a).cross(c - a).dot(normal) > 0.0
    });
    assert!(outward.count() as f32 > 0.995 * body.triangles.len() as f32);
    assert!(body.normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-4));
}

#[test]
fn it_stands_on_the_floor_and_faces_z_with_its_left_at_x() {
    let body = default_template(&ShapeParams::default()).unwrap();
    let (low, high) = extent(&body);
    assert!(low.y.abs() < 1e-6 && (1.55..1.8).contains(&high.y), "{low} {high}");
    let origin = |name: &str| body.skeleton.canonical_origins()[body.skeleton.joint(name).unwrap()];
    assert!(origin("LeftHand").x > 0.3 && origin("RightHand").x < -0.3);
    assert!(origin("LeftToeBase").z > origin("LeftFoot").z + 0.1);
    for (part, name) in [(Part::Head, "Head"), (Part::LeftHand, "LThumb"), (Part::RightFoot, "RightToeBase")] {
        let joint = origin(name).as_vec3();
        let nearest = (0..body.positions.len())
            .min_by(|&a, &b| body.positions[a].distance(joint).total_cmp(&body.positions[b].distance(joint)));
        assert_eq!(body.parts[nearest.unwrap()], part, "{name}");
    }
}

#[test]
fn weights_are_the_strongest_four_and_add_up_to_one() {
    let body = default_template(&ShapeParams::woman()).unwrap();
    for skin in &body.skin {
        assert!((skin.weights.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        assert!(skin.weights.windows(2).all(|pair| pair[0] >= pair[1] && pair[1] >= 0.0), "{skin:?}");
    }
}

#[test]
fn shapes_differ_as_people_do() {
    let man = height(&ShapeParams::man());
    let woman = height(&ShapeParams::woman());
    let child = height(&ShapeParams::child());
    assert!((1.65..1.85).contains(&man) && (1.52..1.7).contains(&woman) && (1.1..1.45).contains(&child));
    assert!(height(&ShapeParams::athlete()) > man + 0.05);
    assert!(height(&ShapeParams::petite_woman()) < woman);
    let waist = |shape: &ShapeParams| {
        let body = default_template(shape).unwrap();
        let spine = body.skeleton.canonical_origins()[body.skeleton.joint("Spine").unwrap()].y as f32;
        let at_waist = body
            .positions
            .iter()
            .zip(&body.parts)
            .filter(|(p, part)| **part == Part::Torso && (p.y - spine).abs() < 0.05);
        at_waist.map(|(p, _)| p.z).fold(f32::MIN, f32::max)
    };
    assert!(waist(&ShapeParams::heavy_man()) > waist(&ShapeParams::man()) + 0.02);
}

#[test]
fn the_average_lies_between_the_corners_and_axes_are_continuous() {
    let [woman, average, man] = [0.0, 0.5, 1.0].map(|gender| height(&ShapeParams::default().with("gender", gender)));
    assert!((average - 0.5 * (woman + man)).abs() < 0.02);
    for axis in ["age", "muscle", "weight", "height", "proportions"] {
        let at = |value| default_template(&ShapeParams::default().with(axis, value)).unwrap();
        let (below, above) = (at(0.4999), at(0.5001));
        let jump = below.positions.iter().zip(&above.positions).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(jump < 1e-3, "{axis} jumps by {jump} m");
    }
}

#[test]
fn the_skeleton_is_refitted_to_the_shape() {
    let femur = |shape: &ShapeParams| {
        let skeleton = default_template(shape).unwrap().skeleton;
        let knee = skeleton.joint("LeftLeg").unwrap();
        skeleton.joints()[knee].rest_translation.length()
    };
    let usual = femur(&ShapeParams::man());
    assert!((0.35..0.55).contains(&usual));
    assert!(femur(&ShapeParams::man().with("upperlegs-height", 1.0)) > usual + 0.01);
    assert!(femur(&ShapeParams::man().with("upperlegs-height", -1.0)) < usual - 0.01);
    // Joints lie inside the body: the knee between front and back of the leg.
    let body = default_template(&ShapeParams::child()).unwrap();
    let knee = body.skeleton.canonical_origins()[body.skeleton.joint("LeftLeg").unwrap()].as_vec3();
    let ring = body.positions.iter().filter(|p| p.x > 0.0 && (p.y - knee.y).abs() < 0.02);
    let (low, high) = ring.fold((Vec3::MAX, Vec3::MIN), |(low, high), p| (low.min(*p), high.max(*p)));
    assert!(knee.x > low.x && knee.x < high.x && knee.z > low.z && knee.z < high.z, "{knee} in {low} {high}");
}

#[test]
fn every_target_moves_something_and_stays_finite() {
    for target in shape_targets().unwrap() {
        let low = default_template(&ShapeParams::default().with(&target.name, target.min)).unwrap();
        let high = default_template(&ShapeParams::default().with(&target.name, target.max)).unwrap();
        low.check().unwrap();
        let moved = low.positions.iter().zip(&high.positions).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!((0.001..1.2).contains(&moved), "{} moves {moved} m", target.name);
    }
}

#[test]
fn wrong_shapes_are_refused_with_advice() {
    let error = default_template(&ShapeParams::default().with("waist-circ", 0.5)).unwrap_err().to_string();
    assert!(error.contains("'waist-circ'") && error.contains("measure-waist-circ"), "{error}");
    let error = default_template(&ShapeParams::default().with("gendr", 0.5)).unwrap_err().to_string();
    assert!(error.contains("did you mean gender"), "{error}");
    for weight in [1.5, -0.1, f32::NAN, f32::INFINITY] {
        let error = default_template(&ShapeParams::default().with("muscle", weight)).unwrap_err();
        assert!(matches!(error, BodyError::TargetWeight { .. }), "{weight}");
    }
}
