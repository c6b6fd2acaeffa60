//! Template and motion against a plain f64 reference, and damaged ones.

#![allow(clippy::unwrap_used)] // helpers of tests

use std::{string::ToString as _, vec::Vec};

use crate::{
    CODEC_VERSION, Motion, MotionEncoder, Posed, StreamError, StreamTemplate, TemplateSource,
    testing::{Person, damaged},
};

/// Computes LBS(x + sum of w t) in f64, by matrices of 4 x 4.
fn reference(person: &Person, motion: &Motion) -> Vec<[f64; 3]> {
    type Matrix = [[f64; 4]; 4];
    let product = |a: &Matrix, b: &Matrix| -> Matrix {
        core::array::from_fn(|i| core::array::from_fn(|j| (0..4).map(|k| a[i][k] * b[k][j]).sum()))
    };
    let rigid = |q: [f32; 4], t: [f32; 3]| -> Matrix {
        let [x, y, z, w] = q.map(f64::from);
        let t = t.map(f64::from);
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w), t[0]],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w), t[1]],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y), t[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    };
    let mut world: Vec<Matrix> = Vec::new();
    for (i, joint) in person.joints.iter().enumerate() {
        let own = rigid(motion.joint_rotations[i], if i == 0 { motion.root_translation } else { joint.translation });
        world.push(joint.parent.map_or(own, |parent| product(&world[usize::from(parent)], &own)));
    }
    let skinning: Vec<Matrix> = world
        .iter()
        .zip(&person.joints)
        .map(|(world, joint)| {
            let mut bind = [[0.0, 0.0, 0.0, 1.0]; 4];
            for (row, from) in bind.iter_mut().zip(joint.joint_from_canonical) {
                *row = from.map(f64::from);
            }
            product(world, &bind)
        })
        .collect();
    let normalised = |weights: [f32; 4]| {
        let sum: f64 = weights.iter().map(|w| f64::from(*w)).sum();
        weights.map(|w| f64::from(w) / sum)
    };
    (0..person.center_scale.len())
        .map(|i| {
            let mut point: [f64; 4] = person.center_scale[i].map(f64::from);
            point[3] = 1.0;
            if let Some((nodes, weights)) = person.node_weights.get(i) {
                for (node, weight) in nodes.iter().zip(normalised(*weights)) {
                    for (value, by) in point.iter_mut().zip(motion.nodes[*node as usize]) {
                        *value += weight * f64::from(by);
                    }
                }
            }
            let (joints, weights) = person.skin[i];
            let mut found = [0.0; 3];
            for (joint, weight) in joints.iter().zip(normalised(weights)) {
                for (k, row) in skinning[*joint as usize][..3].iter().enumerate() {
                    found[k] += weight * row.iter().zip(point).map(|(a, b)| a * b).sum::<f64>();
                }
            }
            found
        })
        .collect()
}

/// Returns the growth of a Gaussian in f64: distances between its nodes over those at rest, as roots of the mean square.
fn growth(template: &StreamTemplate, motion: &Motion, gaussian: usize) -> f64 {
    let Some(nodes) = template.node_weights.get(gaussian) else { return 1.0 };
    let mut squares = [0.0; 2];
    let weighs = |i: &usize| nodes.weight[*i] > 0;
    for (i, j) in (0..4).filter(weighs).flat_map(|i| (0..4).filter(weighs).map(move |j| (i, j))) {
        let (a, b) = (nodes.index[i] as usize, nodes.index[j] as usize);
        for k in 0..3 {
            let place = |node: usize| f64::from(template.node_places[node][k]);
            let moved = |node: usize| place(node) + f64::from(motion.nodes[node][k]);
            squares[0] += (place(a) - place(b)).powi(2);
            squares[1] += (moved(a) - moved(b)).powi(2);
        }
    }
    if squares[0] > 0.0 { ((squares[1] / squares[0]).sqrt() / 1.25).clamp(1.0, 4.0) } else { 1.0 }
}

#[test]
fn posed_gaussians_stay_near_the_reference() {
    for nodes in [0, 1, 200] {
        let person = Person::tube(3000, nodes);
        let encoded = person.encode();
        let decoded = StreamTemplate::decode(&encoded.bytes).unwrap();
        assert_eq!(decoded, encoded.template);
        let mut encoder = MotionEncoder::new(&encoded);
        for seed in 0..3 {
            let motion = person.motion(seed);
            let bytes = encoder.encode(&motion).unwrap();
            let received = Motion::decode(&bytes, &decoded).unwrap();
            assert_eq!((received.stamp.frame, received.stamp.person), (seed, 3));
            let mut posed = Posed::default();
            decoded.pose(&received, &mut posed);
            let expected = reference(&person, &motion);
            for (i, &from) in encoded.gaussian_order.iter().enumerate() {
                let [x, y, z, scale] = posed.center_scale[i];
                let expected = expected[from as usize];
                let apart =
                    [x, y, z].iter().zip(expected).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum::<f64>().sqrt();
                // Weights of 1/255 shift points between joints that lie 0.5 m apart and turn by 0.4.
                assert!(apart < 1e-3, "{nodes} {seed} {i}: {apart}");
                let grown = growth(&decoded, &received, i) * f64::from(person.center_scale[from as usize][3]);
                assert!((f64::from(scale) - grown).abs() < 2e-5, "{scale} {grown}");
                let length: f32 = posed.normal[i].iter().map(|v| v * v).sum();
                assert!((length - 1.0).abs() < 1e-4);
            }
        }
    }
}

#[test]
fn gaussians_grow_with_a_surface_that_is_stretched() {
    let mut person = Person::tube(3000, 200);
    // Influences without a weight stand between others.
    for (nodes, weights) in person.node_weights.iter_mut().step_by(3) {
        if nodes[1] != nodes[3] && weights[1].min(weights[3]) > 0.1 {
            (weights[0], weights[2]) = (0.0, 0.0);
        }
    }
    let template = person.encode().template;
    let mut motion = person.motion(1);
    let mut posed = Posed::default();
    for (by, growth) in [(0.0, 1.0), (0.2, 1.0), (1.0, 1.6), (49.0, 4.0), (f32::NAN, 1.0)] {
        motion.nodes = template.node_places.iter().map(|place| place.map(|v| by * v)).collect();
        template.pose(&motion, &mut posed);
        for (splat, rest) in posed.center_scale.iter().zip(&template.center_scale) {
            assert!((splat[3] - growth * rest[3]).abs() < 1e-5, "{by}: {} {}", splat[3], rest[3]);
        }
    }
    motion.nodes.clear();
    template.pose(&motion, &mut posed);
    assert!(posed.center_scale.iter().zip(&template.center_scale).all(|(a, b)| (a[3] - b[3]).abs() < 1e-9));
}

#[test]
fn every_motion_is_readable_by_itself() {
    let person = Person::tube(500, 50);
    let encoded = person.encode();
    let mut encoder = MotionEncoder::new(&encoded);
    let first = encoder.encode(&person.motion(1)).unwrap();
    encoder.encode(&person.motion(2)).unwrap();
    assert_eq!(encoder.encode(&person.motion(1)).unwrap(), first);
    assert_eq!(MotionEncoder::new(&encoded).encode(&person.motion(1)).unwrap(), first);
}

#[test]
fn poisoned_motions_are_refused_or_rest() {
    let person = Person::tube(100, 10);
    let encoded = person.encode();
    let mut encoder = MotionEncoder::new(&encoded);
    let mut bad = person.motion(1);
    bad.nodes[3] = [f32::NAN, 0.0, f32::INFINITY];
    bad.nodes.truncate(8);
    let motion = Motion::decode(&encoder.encode(&bad).unwrap(), &encoded.template).unwrap();
    let at_rest = encoded.node_order.iter().position(|&node| node == 3).unwrap();
    assert!(motion.nodes[at_rest].iter().all(|v| v.abs() < 1e-3));
    assert!(motion.nodes.iter().flatten().all(|v| v.is_finite()));
    for (poison, text) in [
        (
            Motion { joint_rotations: [[0.0, 0.0, 0.0, 1.0]; 2].to_vec(), ..person.motion(1) },
            "another number of joints",
        ),
        (Motion { joint_rotations: [[0.0; 4]; 3].to_vec(), ..person.motion(1) }, "not of unit length"),
        (Motion { root_translation: [f32::NAN; 3], ..person.motion(1) }, "not finite"),
        (Motion { root_translation: [1e9; 3], ..person.motion(1) }, "not finite"),
    ] {
        let error = encoder.encode(&poison).unwrap_err().to_string();
        assert!(error.contains(text), "{error}");
    }
}

#[test]
fn poisoned_templates_are_refused() {
    let good = Person::tube(50, 5);
    let refused = |source: TemplateSource<'_>, text: &str| {
        let error = source.encode().unwrap_err().to_string();
        assert!(error.contains(text), "{error}");
    };
    refused(
        TemplateSource { center_scale: &[], normals: &[], skin: &[], node_weights: &[], ..good.source() },
        "one Gaussian",
    );
    refused(TemplateSource { joints: &[], ..good.source() }, "one joint");
    refused(TemplateSource { normals: &good.normals[1..], ..good.source() }, "differ in length");
    refused(TemplateSource { nodes: &good.nodes[..1], ..good.source() }, "node that does not exist");
    refused(TemplateSource { nodes: &[[0.0; 3]; 51], ..good.source() }, "more nodes than Gaussians");
    refused(TemplateSource { joints: &good.joints[..1], ..good.source() }, "joint that does not exist");
    let mut bad = Person::tube(50, 5);
    bad.center_scale[3][1] = f32::NAN;
    refused(bad.source(), "centre is not finite");
    let mut bad = Person::tube(50, 5);
    bad.skin[3].1 = [-1.0; 4];
    refused(bad.source(), "weight is negative");
    let mut bad = Person::tube(50, 5);
    bad.joints[1].parent = Some(2);
    refused(bad.source(), "before its parent");
}

#[test]
fn a_template_claims_no_more_gaussians_than_its_bytes_hold() {
    // All Gaussians the same: a valid template, however few bytes they would take.
    let mut person = Person::tube(3000, 0);
    let first = (person.center_scale[0], person.normals[0], person.skin[0]);
    person.center_scale.fill(first.0);
    person.normals.fill(first.1);
    person.skin.fill(first.2);
    let encoded = person.encode();
    assert_eq!(StreamTemplate::decode(&encoded.bytes).unwrap().gaussians(), 3000);
    let mut bytes = encoded.bytes;
    for (claim, is_valid) in [(3000u32, true), (3001, false), (1 << 20, false)] {
        bytes[8..12].copy_from_slice(&claim.to_le_bytes());
        let error = StreamTemplate::decode(&bytes).err();
        let problem = "it claims more Gaussians than its bytes can hold";
        let refused = StreamError::Malformed { what: "template", problem };
        assert_eq!(error, (!is_valid).then_some(refused), "{claim}");
    }
}

#[test]
fn damaged_templates_and_motions_are_no_panic() {
    let person = Person::tube(300, 20);
    let encoded = person.encode();
    let mut refused = 0;
    damaged(&encoded.bytes, 3000, |bytes| match StreamTemplate::decode(bytes) {
        Ok(template) => {
            let mut posed = Posed::default();
            template.pose(&person.motion(1), &mut posed);
        }
        Err(_) => refused += 1,
    });
    assert!(refused > 500, "{refused}");
    let motion = MotionEncoder::new(&encoded).encode(&person.motion(1)).unwrap();
    damaged(&motion, 3000, |bytes| {
        if let Ok(motion) = Motion::decode(bytes, &encoded.template) {
            assert_eq!((motion.joint_rotations.len(), motion.nodes.len()), (3, 20));
            assert!(
                motion.nodes.iter().flatten().chain(motion.joint_rotations.iter().flatten()).all(|v| v.is_finite())
            );
        }
    });
    let mut older = motion.clone();
    older[3] = CODEC_VERSION - 1;
    let error = Motion::decode(&older, &encoded.template).unwrap_err();
    assert_eq!(error, StreamError::Version { what: "motion", found: CODEC_VERSION - 1 });
    assert!(error.to_string().contains("update the older of the two"), "{error}");
    let other = Person::tube(301, 20).encode();
    assert_eq!(Motion::decode(&motion, &other.template), Err(StreamError::OtherTemplate { what: "motion" }));
}
