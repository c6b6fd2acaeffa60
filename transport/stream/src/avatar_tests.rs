//! Avatars against plain f64 references, and damaged ones.
#![allow(clippy::unwrap_used)] // helpers of tests

use std::{string::ToString as _, vec, vec::Vec};

use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

use super::*;
use crate::{
    LIGHT_TERMS, MotionEncoder,
    testing::{Person, damaged},
};

/// Light that is darker from the left and red from above.
const LIGHT: [[f32; 3]; LIGHT_TERMS] = {
    let mut light = [[0.0; 3]; LIGHT_TERMS];
    light[0] = [1.0; 3];
    light[1] = [0.5; 3];
    light[3][0] = 0.25;
    light[6] = [0.1; 3];
    light
};

fn gaussians(count: usize) -> Vec<AvatarGaussian> {
    let mut random = StdRng::seed_from_u64(7);
    let mut gaussian = || AvatarGaussian {
        scale_m: [0; 3].map(|_| 3e-4 * 200.0f32.powf(random.random())),
        opacity: random.random(),
        rotation: [0; 4].map(|_| random.random_range(-1.0f32..1.0)),
        color: [0; 3].map(|_| random.random()),
    };
    (0..count).map(|_| gaussian()).collect()
}

fn encoded(person: &Person, gaussians: &[AvatarGaussian]) -> EncodedTemplate {
    AvatarSource { template: person.source(), gaussians, light: Some(LIGHT) }.encode().unwrap()
}

/// Returns the rows of a unit quaternion's matrix in f64.
fn matrix(q: [f64; 4]) -> [[f64; 3]; 3] {
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [x, y, z, w] = q.map(|v| v / length);
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

fn times(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let cross = |i: usize, j: usize| a[i] * b[j] - a[j] * b[i];
    [
        a[3] * b[0] + a[0] * b[3] + cross(1, 2),
        a[3] * b[1] + a[1] * b[3] + cross(2, 0),
        a[3] * b[2] + a[2] * b[3] + cross(0, 1),
        a[3] * b[3] - dot,
    ]
}

/// Returns the largest difference between two rotations' matrices.
fn apart(a: [f64; 4], b: [f64; 4]) -> f64 {
    let rows = matrix(a).into_iter().flatten().zip(matrix(b).into_iter().flatten());
    rows.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn shapes_and_colors_come_back_and_turn_as_the_reference() {
    let person = Person::tube(2000, 0);
    let source = gaussians(2000);
    let encoded = encoded(&person, &source);
    let decoded = StreamTemplate::decode(&encoded.bytes).unwrap();
    assert_eq!(decoded, encoded.template);
    assert_eq!(decoded.hash, template_hash(&encoded.bytes));
    let motion = person.motion(4);
    // Joints are turned one after the other along the chain.
    let mut turns: Vec<[f64; 4]> = Vec::new();
    for rotation in &motion.joint_rotations {
        let own = rotation.map(f64::from);
        turns.push(turns.last().map_or(own, |parent| times(*parent, own)));
    }
    let (mut axes, mut posed) = (PosedAxes::default(), Posed::default());
    decoded.pose(&motion, &mut posed);
    assert!(decoded.pose_axes(&motion, &posed, &mut axes));
    let mut colors = Vec::new();
    assert!(decoded.avatar_colors(&posed, &mut colors));
    assert_eq!((axes.rotation.len(), axes.scale_opacity.len(), posed.center_scale.len()), (2000, 2000, 2000));
    let srgb = |linear: f64| if linear <= 0.0031308 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    for (i, &from) in encoded.gaussian_order.iter().enumerate() {
        let AvatarGaussian { scale_m, opacity, rotation, color } = source[from as usize];
        for k in 0..3 {
            let off = f64::from(axes.scale_opacity[i][k] / scale_m[k]).ln().abs();
            assert!(off < 0.0125, "{i}: {off}");
            let [x, _, z] = [0, 1, 2].map(|axis| f64::from(posed.normal[i][axis]));
            let lit = 1.0 + 0.5 * x + if k == 0 { 0.25 * z } else { 0.0 } + 0.1 * (3.0 * z * z - 1.0);
            let found = f64::from(colors[i][k]) / lit;
            assert!((srgb(found) - srgb(f64::from(color[k]))).abs() < 0.75 / 255.0, "{i}: {found} {}", color[k]);
        }
        assert!((axes.scale_opacity[i][3] - opacity).abs() < 0.51 / 255.0);
        let (joints, weights) = person.skin[from as usize];
        let mut sum = [0.0; 4];
        for (joint, weight) in joints.iter().zip(weights) {
            let turn = turns[*joint as usize];
            let sign = if sum.iter().zip(turn).map(|(a, b)| a * b).sum::<f64>() < 0.0 { -1.0 } else { 1.0 };
            (0..4).for_each(|k| sum[k] += sign * f64::from(weight) * turn[k]);
        }
        let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
        let expected = times(sum.map(|v| v / length), rotation.map(f64::from));
        let off = apart(axes.rotation[i].map(f64::from), expected);
        // Steps of 0.0014 in three components, and weights of 1/255 between joints that are turned by 0.8.
        assert!(off < 8e-3, "{i}: {off}");
    }
    // Other templates have no axes, and a pose is a few dozen bytes.
    let plain = person.encode();
    assert!(
        !plain.template.pose_axes(&motion, &posed, &mut axes) && !plain.template.avatar_colors(&posed, &mut colors)
    );
    let bytes = MotionEncoder::new(&encoded).encode(&motion).unwrap();
    assert!(bytes.len() < 100, "{}", bytes.len());
    assert_eq!(Motion::decode(&bytes, &decoded).unwrap().stamp.template, decoded.hash);
}

#[test]
fn every_rotation_survives_its_code() {
    let mut random = StdRng::seed_from_u64(3);
    let edges = [[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, -1.0], [1.0, -1.0, 0.0, 0.0], [-3.0, 1e-9, 0.0, 0.0]];
    let all = (0..2000).map(|_| [0; 4].map(|_| random.random_range(-1.0f32..1.0))).chain(edges);
    for q in all {
        let off = apart(rotation_of(rotation_code(q)).map(f64::from), q.map(f64::from));
        assert!(off < 5e-3, "{q:?}: {off}");
    }
    // Codes that no rotation has are rotations all the same.
    for code in [0, u32::MAX, 0x3fff_ffff, 0xc000_0000] {
        let length: f32 = rotation_of(code).iter().map(|v| v * v).sum();
        assert!((length - 1.0).abs() < 1e-5, "{code}");
    }
    for scale in [0.0, 1e-9, 2e-4, 0.01, 0.1, 5.0, f32::INFINITY] {
        let found = scale_of(scale_code(scale));
        assert!((found / scale.clamp(2e-4, 0.1) - 1.0).abs() < 0.0126, "{scale} {found}");
    }
}

#[test]
fn poisoned_avatars_are_refused() {
    let person = Person::tube(60, 0);
    let refused = |person: &Person, gaussians: &[AvatarGaussian], text: &str| {
        let source = AvatarSource { template: person.source(), gaussians, light: Some(LIGHT) };
        let error = source.encode().unwrap_err().to_string();
        assert!(error.contains(text), "{error}");
    };
    let mut dark = LIGHT;
    dark[4][1] = f32::NAN;
    let source = AvatarSource { template: person.source(), gaussians: &gaussians(60), light: Some(dark) };
    assert!(source.encode().unwrap_err().to_string().contains("light is not finite"));
    refused(&person, &gaussians(59), "differ in length");
    refused(&Person::tube(60, 4), &gaussians(60), "has no nodes");
    refused(&Person::tube(0, 0), &[], "one Gaussian");
    let poisons: [fn(&mut AvatarGaussian); 4] = [
        |g| g.scale_m[1] = f32::NAN,
        |g| g.rotation[2] = f32::INFINITY,
        |g| g.color[0] = f32::NAN,
        |g| g.opacity = f32::NEG_INFINITY,
    ];
    for poison in poisons {
        let mut bad = gaussians(60);
        poison(&mut bad[8]);
        refused(&person, &bad, "not finite");
    }
}

#[test]
fn a_tracked_avatar_moves_and_grows_with_its_nodes() {
    let person = Person::tube(2000, 40);
    let source = gaussians(2000);
    let encoded = AvatarSource { template: person.source(), gaussians: &source, light: None }.encode().unwrap();
    let decoded = StreamTemplate::decode(&encoded.bytes).unwrap();
    assert_eq!(decoded, encoded.template);
    assert!(decoded.has_axes() && !decoded.has_colors() && decoded.nodes() == 40);
    // Three bytes less per Gaussian than with colours.
    let still = Person::tube(2000, 0);
    let with_colors = self::encoded(&still, &source).bytes.len() - still.encode().bytes.len();
    let without = encoded.bytes.len() - person.encode().bytes.len();
    assert_eq!(with_colors - without, 3 * 2000 + 12 * LIGHT_TERMS - 40 * 12);

    // Centres and growth are those of the same surface without axes, but for the places of the nodes, which are exact here.
    let mut motion = person.motion(4);
    motion.nodes.iter_mut().flatten().for_each(|by| *by *= 20.0);
    let own = |template: &EncodedTemplate| Motion {
        nodes: template.node_order.iter().map(|node| motion.nodes[*node as usize]).collect(),
        ..motion.clone()
    };
    let (mut posed, mut axes, mut at_rest) = (Posed::default(), PosedAxes::default(), PosedAxes::default());
    let still = Motion { nodes: vec![[0.0; 3]; 40], ..motion.clone() };
    decoded.pose(&still, &mut posed);
    assert!(decoded.pose_axes(&still, &posed, &mut at_rest));
    decoded.pose(&own(&encoded), &mut posed);
    assert!(decoded.pose_axes(&own(&encoded), &posed, &mut axes));
    let spread = |on: &([u32; 4], [f32; 4]), by: f64| -> f64 {
        let place = |node: u32, k: usize| {
            f64::from(person.nodes[node as usize][k]) + by * f64::from(motion.nodes[node as usize][k])
        };
        // Nodes without a quantised weight count for nothing.
        let sum: f32 = on.1.iter().sum();
        let mut list: Vec<u32> = (0..4).filter(|k| on.1[*k] / sum * 255.0 >= 0.5).map(|k| on.0[k]).collect();
        list.sort_unstable();
        let mut squares = 0.0;
        for (i, a) in list.iter().enumerate() {
            for b in &list[..i] {
                squares += (0..3).map(|k| (place(*a, k) - place(*b, k)).powi(2)).sum::<f64>();
            }
        }
        squares
    };
    let mut grown = 0;
    for (i, &from) in encoded.gaussian_order.iter().enumerate() {
        let on = &person.node_weights[from as usize];
        let (before, after) = (spread(on, 0.0), spread(on, 1.0));
        let expected = flyrig_model::stretch::growth(before as f32, after as f32, libm::sqrtf);
        for k in 0..3 {
            let found = axes.scale_opacity[i][k] / at_rest.scale_opacity[i][k];
            assert!((found / expected - 1.0).abs() < 1e-3, "{i}: {found} {expected}");
        }
        assert_eq!(axes.scale_opacity[i][3].to_bits(), at_rest.scale_opacity[i][3].to_bits());
        grown += usize::from(expected > 1.01);
    }
    assert!(grown > 200, "{grown} Gaussians have grown");
    assert_eq!(axes.rotation, at_rest.rotation);
    let mut colors = Vec::new();
    assert!(!decoded.avatar_colors(&posed, &mut colors) && colors.is_empty());
}

#[test]
fn damaged_avatars_are_no_panic() {
    let mut refused = 0;
    for (nodes, light) in [(0, Some(LIGHT)), (20, None)] {
        let person = Person::tube(300, nodes);
        let source = AvatarSource { template: person.source(), gaussians: &gaussians(300), light };
        damaged(&source.encode().unwrap().bytes, 3000, |bytes| match StreamTemplate::decode(bytes) {
            Ok(template) => {
                let (mut posed, mut axes, mut colors) = (Posed::default(), PosedAxes::default(), Vec::new());
                template.pose(&person.motion(1), &mut posed);
                if template.pose_axes(&person.motion(1), &posed, &mut axes) {
                    assert_eq!(template.avatar_colors(&posed, &mut colors), template.has_colors());
                    let numbers = axes.rotation.iter().chain(&axes.scale_opacity).chain(&colors).flatten();
                    assert!(numbers.into_iter().all(|v| v.is_finite()) && axes.rotation.len() == template.gaussians());
                }
            }
            Err(_) => refused += 1,
        });
    }
    assert!(refused > 1000, "{refused}");
    let bytes = encoded(&Person::tube(300, 0), &gaussians(300)).bytes;
    let mut newer = bytes.clone();
    newer[3] = 9;
    assert_eq!(StreamTemplate::decode(&newer).unwrap_err(), StreamError::Version { what: "avatar", found: 9 });
    // One that holds another one inside is no avatar.
    let mut nested = bytes[..4].to_vec();
    nested.extend((bytes.len() as u32).to_le_bytes());
    nested.extend(&bytes);
    assert!(StreamTemplate::decode(&nested).is_err());
}
