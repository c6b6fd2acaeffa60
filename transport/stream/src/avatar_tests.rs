//! Avatars against plain f64 references, and damaged ones.
#![allow(clippy::unwrap_used)] // helpers of tests

use std::{string::ToString as _, vec::Vec};

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
    AvatarSource { template: person.source(), gaussians, light: LIGHT }.encode().unwrap()
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
    assert!(decoded.pose_axes(&motion, &mut axes));
    decoded.pose(&motion, &mut posed);
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
    assert!(!plain.template.pose_axes(&motion, &mut axes) && !plain.template.avatar_colors(&posed, &mut colors));
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
        let source = AvatarSource { template: person.source(), gaussians, light: LIGHT };
        let error = source.encode().unwrap_err().to_string();
        assert!(error.contains(text), "{error}");
    };
    let mut dark = LIGHT;
    dark[4][1] = f32::NAN;
    let source = AvatarSource { template: person.source(), gaussians: &gaussians(60), light: dark };
    assert!(source.encode().unwrap_err().to_string().contains("light is not finite"));
    refused(&person, &gaussians(59), "differ in length");
    refused(&Person::tube(60, 4), &gaussians(60), "no nodes");
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
fn damaged_avatars_are_no_panic() {
    let person = Person::tube(300, 0);
    let bytes = encoded(&person, &gaussians(300)).bytes;
    let mut refused = 0;
    damaged(&bytes, 3000, |bytes| match StreamTemplate::decode(bytes) {
        Ok(template) => {
            let mut axes = PosedAxes::default();
            if template.pose_axes(&person.motion(1), &mut axes) {
                let numbers = axes.rotation.iter().chain(&axes.scale_opacity).flatten();
                let (mut posed, mut colors) = (Posed::default(), Vec::new());
                template.pose(&person.motion(1), &mut posed);
                assert!(template.avatar_colors(&posed, &mut colors));
                assert!(colors.iter().flatten().all(|value| value.is_finite()));
                assert!(numbers.into_iter().all(|v| v.is_finite()) && axes.rotation.len() == template.gaussians());
            }
        }
        Err(_) => refused += 1,
    });
    assert!(refused > 500, "{refused}");
    let mut newer = bytes.clone();
    newer[3] = 9;
    assert_eq!(StreamTemplate::decode(&newer).unwrap_err(), StreamError::Version { what: "avatar", found: 9 });
    // One that holds another one inside is no avatar.
    let mut nested = bytes[..4].to_vec();
    nested.extend((bytes.len() as u32).to_le_bytes());
    nested.extend(&bytes);
    assert!(StreamTemplate::decode(&nested).is_err());
}
