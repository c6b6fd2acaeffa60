//! Turning around on the spot in small steps.

use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};

use super::clip::Clip;
use crate::motion::posture::Arm;
use crate::motion::puppet::Puppet;
use crate::motion::steps::{Gait, Plant, foot};

/// Steps of a full turn; even, so that the clip closes.
const STEPS: f64 = 12.0;

/// Returns one full turn to the left: weight goes from foot to foot, the head looks ahead, the arms gesture.
pub(crate) fn turn<'a>(puppet: &'a Puppet<'_>, secs: f64) -> Clip<'a> {
    const STEP_ANGLE: f64 = TAU / STEPS;
    let plants = [0usize, 1].map(|side| {
        let outwards = [1.0, -1.0][side];
        let plant = |index: f64| {
            // Swung in step `index`, for the most of it; then it stands until the step after the next.
            let yaw = (index + 1.5) * STEP_ANGLE;
            Plant {
                leaves: (index + 0.12) / STEPS,
                lands: (index + 0.88) / STEPS,
                at: DVec2::new(yaw.cos(), -yaw.sin()) * outwards * 0.118,
                yaw: yaw + outwards * 0.12,
            }
        };
        (0..(STEPS / 2.0) as u32).map(|i| plant(f64::from(2 * i) + side as f64)).collect::<Vec<_>>()
    });
    let gait = Gait { lift_m: 0.050, push: 0.40, strike: 0.0 };
    Clip::new(secs, move |phase| {
        let steps = phase * STEPS;
        let yaw = phase * TAU;
        let wave = |cycles: f64, offset: f64| (TAU * (cycles * phase + offset)).sin();
        // Weight goes to the standing foot: right while the left swings in even steps.
        let shift = -(PI * steps).sin();
        let mut posture = puppet.standing();
        let hips = DVec2::new(yaw.cos(), -yaw.sin()) * 0.032 * shift;
        posture.hips = DVec3::new(hips.x, -0.010 - 0.004 * (1.0 + (TAU * steps).cos()), hips.y);
        posture.yaw = yaw;
        posture.pelvis = DVec3::new(0.015 * wave(3.0, 0.1), -0.030 * shift, 0.0);
        let look = 0.16 + 0.12 * wave(2.0, 0.0);
        posture.trunk = DVec3::new(0.035 + 0.04 * wave(4.0, 0.07), 0.060 * shift, look);
        posture.head = DVec3::new(-0.02 + 0.06 * wave(3.0, 0.3), 0.03 * wave(2.0, 0.6), 1.3 * look);
        posture.feet = [0, 1].map(|side| foot(&plants[side], phase, TAU, gait));
        posture.arms = [0.0, 0.21].map(|offset| {
            // Hanging, then gestures: out, forward, bent.
            let raise = (0.5 + 0.5 * wave(2.0, 0.75 + offset)).powi(2);
            let bend = 0.30 + 0.55 * (0.5 + 0.5 * wave(3.0, offset + 0.4)) * (0.35 + 0.65 * raise);
            let forward = 0.06 + 0.24 * wave(3.0, offset) + 0.25 * raise;
            Arm::angled(forward, puppet.hang_out() + 0.55 * raise, bend, 0.25).with_hand(
                0.10 + 0.12 * wave(4.0, offset),
                0.5 * raise,
                0.35,
            )
        });
        posture
    })
}
