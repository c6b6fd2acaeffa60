//! Standing and arm gestures.

use std::f64::consts::TAU;

use glam::DVec3;

use super::clip::Clip;
use crate::motion::curve::{closed, ease, hump};
use crate::motion::posture::{Arm, Posture};
use crate::motion::puppet::Puppet;

/// Returns a clip of standing still.
pub(crate) fn still<'a>(puppet: &'a Puppet<'_>) -> Clip<'a> {
    Clip::new(4.0, |_| {
        let mut posture = puppet.standing();
        // Nobody stands like a ruler: weight on one leg.
        settle(&mut posture, 0.7);
        posture
    })
}

/// Shifts the weight to the left leg (positive) or the right one, -1..=1: hips over it, the trunk balancing.
pub(super) fn settle(posture: &mut Posture, weight: f64) {
    posture.hips += DVec3::new(0.040 * weight, -0.006 * weight.abs(), 0.0);
    posture.pelvis.y -= 0.050 * weight;
    posture.trunk.y += 0.065 * weight;
    posture.head.y -= 0.03 * weight;
    posture.trunk.z += 0.03 * weight;
}

/// Adds the small movements of a standing person; all of them close after `secs`.
pub(super) fn breathe(posture: &mut Posture, phase: f64, secs: f64) {
    let cycles = |every: f64| (secs / every).round().max(1.0);
    let wave = |every: f64, offset: f64| (TAU * (cycles(every) * phase + offset)).sin();
    posture.trunk.x += 0.012 * wave(3.6, 0.0);
    posture.hips += DVec3::new(0.005 * wave(4.5, 0.3), 0.0, 0.006 * wave(3.1, 0.1));
    posture.head += DVec3::new(0.025 * wave(3.0, 0.4), 0.015 * wave(4.2, 0.0), 0.05 * wave(5.0, 0.2));
    for (arm, offset) in posture.arms.iter_mut().zip([0.0, 0.3]) {
        arm.upper.z += 0.02 * wave(3.3, offset);
        arm.fore.z += 0.03 * wave(3.3, offset + 0.05);
    }
}

/// Returns a big wave with the right hand.
pub(crate) fn wave<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    const SECS: f64 = 4.5;
    Clip::new(SECS / speed, move |phase| {
        let up = closed(phase, &[(0.04, 0.0), (0.08, -0.06), (0.24, 1.0), (0.70, 1.0), (0.90, 0.0)]);
        let waving = closed(phase, &[(0.16, 0.0), (0.28, 1.0), (0.64, 1.0), (0.76, 0.0)]);
        let swing = waving * (TAU * phase * 7.0).sin();
        let late = waving * (TAU * (phase * 7.0 - 0.14)).sin();
        let mut posture = puppet.standing();
        breathe(&mut posture, phase, SECS);
        settle(&mut posture, 0.35 + 0.5 * up);
        posture.trunk += DVec3::new(-0.03 * up, 0.05 * up + 0.02 * swing, -0.06 * up);
        posture.head += DVec3::new(-0.05 * up, -0.10 * up + 0.03 * late, -0.08 * up);
        let low = posture.arms[1];
        let upper = DVec3::new(0.80, 0.28, 0.38) + DVec3::new(0.08, 0.04, 0.0) * swing;
        let fore = DVec3::new(0.22 + 0.50 * swing, 0.95, 0.22);
        let high = Arm {
            upper: upper.normalize_or(DVec3::X),
            fore: fore.normalize_or(DVec3::Y),
            hand: [-0.12 * late, 0.2],
            curl: 0.08,
        };
        posture.arms[1] = low.mix(&high, up);
        posture
    })
}

/// Returns a reach up to a high shelf with the right hand and down to the floor with the left.
pub(crate) fn reach<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    const SECS: f64 = 8.0;
    Clip::new(SECS / speed, move |phase| {
        let up = closed(phase, &[(0.03, 0.0), (0.20, 1.0), (0.32, 1.0), (0.46, 0.0)]);
        let down = closed(phase, &[(0.44, 0.0), (0.66, 1.0), (0.76, 1.0), (0.96, 0.0)]);
        // The arm starts before the body follows.
        let hand_up = closed(phase, &[(0.0, 0.0), (0.16, 0.92), (0.21, 1.0), (0.33, 1.0), (0.47, 0.0)]);
        let hand_down = closed(phase, &[(0.47, 0.0), (0.64, 1.0), (0.77, 1.0), (0.93, 0.0)]);
        let ready = hump((phase - 0.92) / 0.08) + hump((phase - 0.46) / 0.05);
        let mut posture = puppet.standing();
        breathe(&mut posture, phase, SECS);
        settle(&mut posture, -0.8 * up);
        posture.hips += DVec3::new(0.06 * down, -0.36 * down - 0.008 * ready, 0.03 * up - 0.10 * down);
        posture.pelvis += DVec3::new(0.62 * down - 0.04 * up, 0.10 * down, -0.05 * up + 0.10 * down);
        posture.trunk += DVec3::new(0.62 * down - 0.10 * up, 0.20 * down - 0.10 * up, 0.10 * up - 0.16 * down);
        posture.head += DVec3::new(-0.34 * up + 0.10 * down, 0.0, -0.20 * up + 0.12 * down);
        posture.knees_out = 0.30 * down;
        for foot in &mut posture.feet {
            foot.roll = 0.42 * ease(up);
        }
        let [left, right] = posture.arms;
        let high = Arm {
            upper: DVec3::new(0.30, 0.93, 0.22).normalize_or(DVec3::Y),
            fore: DVec3::new(0.02, 0.97, 0.24).normalize_or(DVec3::Y),
            hand: [0.1, 0.3],
            curl: 0.25,
        };
        let low = Arm {
            upper: DVec3::new(0.12, -0.70, 0.70).normalize_or(DVec3::NEG_Y),
            fore: DVec3::new(0.02, -0.66, 0.75).normalize_or(DVec3::NEG_Y),
            hand: [0.15, 0.0],
            curl: 0.30,
        };
        // The other hand rests on the thigh, or balances.
        let braced = Arm {
            upper: DVec3::new(0.42, -0.78, 0.46).normalize_or(DVec3::NEG_Y),
            fore: DVec3::new(-0.20, -0.72, 0.66).normalize_or(DVec3::NEG_Y),
            hand: [-0.5, 0.0],
            curl: 0.2,
        };
        let balance = Arm::angled(-0.15, puppet.hang_out() + 0.30, 0.45, 0.1);
        posture.arms[1] = right.mix(&high, hand_up).mix(&braced, down);
        posture.arms[0] = left.mix(&low, hand_down).mix(&balance, up);
        posture
    })
}

/// Returns a clip that crosses the arms, waits, looks around and lets go.
pub(crate) fn cross_arms<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    const SECS: f64 = 7.0;
    let depth = puppet.chest_m() - 0.02;
    Clip::new(SECS / speed, move |phase| {
        let cross = closed(phase, &[(0.04, 0.0), (0.10, 0.10), (0.24, 1.0), (0.74, 1.0), (0.90, 0.06), (0.96, 0.0)]);
        // The right arm goes first and lies below.
        let first = closed(phase, &[(0.02, 0.0), (0.20, 1.0), (0.76, 1.0), (0.92, 0.0)]);
        let aside = closed(phase, &[(0.26, 0.0), (0.38, 1.0), (0.48, 1.0), (0.62, -0.7), (0.74, 0.0)]);
        let mut posture = puppet.standing();
        breathe(&mut posture, phase, SECS);
        settle(&mut posture, closed(phase, &[(0.0, 0.2), (0.25, 0.8), (0.5, 0.8), (0.62, -0.8), (0.8, -0.6)]));
        posture.trunk += DVec3::new(-0.05 * cross, 0.0, 0.05 * aside);
        posture.head += DVec3::new(0.02 * cross, 0.03 * aside, 0.40 * aside);
        let [left, right] = posture.arms;
        let elbow = DVec3::new(0.75, -1.0, 0.1);
        let below = puppet.reach(DVec3::new(-0.045, -0.235, depth + 0.050), elbow).with_hand(0.25, 0.0, 0.30);
        let above = puppet.reach(DVec3::new(-0.075, -0.195, depth + 0.105), elbow).with_hand(0.45, -0.1, 0.35);
        // Hands come up in front of the belly before they cross.
        let before = puppet.reach(DVec3::new(0.14, -0.24, depth + 0.16), elbow);
        let folded = |from: &Arm, to: &Arm, t: f64| from.mix(&before, ease(t * 1.8)).mix(to, ease(t * 1.8 - 0.8));
        posture.arms = [folded(&left, &above, cross), folded(&right, &below, first)];
        posture
    })
}
