//! Squatting, sitting down and lying down.

use glam::{DVec2, DVec3};

use super::clip::Clip;
use super::gestures::{breathe, settle};
use crate::motion::curve::{closed, hump};
use crate::motion::posture::Arm;
use crate::motion::puppet::Puppet;

/// Returns two squats, the second deeper, with the arms in front for balance.
pub(crate) fn squat<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    const SECS: f64 = 6.0;
    Clip::new(SECS / speed, move |phase| {
        let down = closed(
            phase,
            &[(0.02, 0.0), (0.20, 0.72), (0.26, 0.72), (0.42, 0.0), (0.52, 0.0), (0.72, 1.0), (0.79, 1.0), (0.97, 0.0)],
        );
        let early = closed(
            phase + 0.035,
            &[(0.02, 0.0), (0.19, 0.75), (0.28, 0.72), (0.43, 0.0), (0.52, 0.0), (0.71, 1.0), (0.80, 1.0), (0.97, 0.0)],
        );
        // A breath and a little rise before going down, a stretch after coming up.
        let rise = hump((phase - 0.93) / 0.10) + hump((phase - 0.43) / 0.10);
        let mut posture = puppet.standing();
        breathe(&mut posture, phase, SECS);
        for (foot, side) in posture.feet.iter_mut().zip([1.0, -1.0]) {
            foot.at.x += side * 0.055;
            foot.yaw += side * 0.28;
        }
        posture.hips += DVec3::new(0.0, -0.50 * down, -0.17 * down);
        posture.pelvis.x += 0.62 * down;
        posture.trunk.x += 0.16 * down - 0.05 * rise;
        posture.head.x -= 0.50 * down;
        posture.knees_out = 0.16 + 0.10 * down;
        for arm in &mut posture.arms {
            let front = Arm {
                upper: DVec3::new(0.10, 0.12 + 0.75 * down, 0.95).normalize_or(DVec3::Z),
                fore: DVec3::new(-0.16, 0.10 + 0.75 * down, 0.95).normalize_or(DVec3::Z),
                hand: [0.0, 0.0],
                curl: 0.15,
            };
            *arm = arm.mix(&front, early.clamp(0.0, 1.0));
        }
        posture
    })
}

/// Height of the seat of [`sit`] and distance of its centre behind the person, metres of the average body.
pub(crate) const SEAT_M: (f64, f64) = (0.44, 0.36);

/// Returns a clip that sits down on a chair behind, leans back, looks around and gets up.
pub(crate) fn sit<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    const SECS: f64 = 8.0;
    Clip::new(SECS / speed, move |phase| {
        let down = closed(phase, &[(0.05, 0.0), (0.12, 0.10), (0.28, 1.0), (0.70, 1.0), (0.84, 0.12), (0.92, 0.0)]);
        // The trunk goes ahead of the hips, down and up again.
        let lean = closed(
            phase,
            &[(0.03, 0.0), (0.17, 1.0), (0.30, 0.25), (0.36, 0.0), (0.60, 0.0), (0.69, 1.1), (0.76, 1.0), (0.93, 0.0)],
        );
        let rest = closed(phase, &[(0.27, 0.0), (0.36, 1.0), (0.60, 1.0), (0.68, 0.0)]);
        let look = closed(phase, &[(0.36, 0.0), (0.44, 1.0), (0.50, 1.0), (0.58, -0.6), (0.64, 0.0)]);
        let hands = closed(phase, &[(0.10, 0.0), (0.28, 1.0), (0.72, 1.0), (0.86, 0.0)]);
        let mut posture = puppet.standing();
        breathe(&mut posture, phase, SECS);
        settle(&mut posture, 0.25 * (1.0 - down));
        for (foot, side) in posture.feet.iter_mut().zip([1.0, -1.0]) {
            foot.at += DVec2::new(side * 0.02, 0.0);
        }
        // Hips on the seat: joints about 9 cm above it.
        posture.hips += DVec3::new(0.0, -(0.875 - SEAT_M.0 - 0.085) * down, -(SEAT_M.1 - 0.02) * down);
        posture.pelvis.x += 0.30 * lean - 0.24 * rest;
        posture.trunk.x += 0.52 * lean + 0.02 * rest;
        posture.head += DVec3::new(-0.35 * lean + 0.16 * rest, 0.05 * look, 0.55 * look);
        posture.trunk.z += 0.10 * look;
        posture.knees_out = 0.06 * down;
        for (arm, offset) in posture.arms.iter_mut().zip([0.0, 0.03]) {
            // Hands on the thighs; while the trunk leans, reaching for the knees.
            let on_thigh = Arm {
                upper: DVec3::new(0.20, -0.86 + 0.10 * lean, 0.36 + 0.25 * lean + offset).normalize_or(DVec3::NEG_Y),
                fore: DVec3::new(-0.16, -0.30 - 0.25 * lean, 0.92).normalize_or(DVec3::Z),
                hand: [0.12, -0.25],
                curl: 0.30,
            };
            *arm = arm.mix(&on_thigh, hands);
        }
        posture
    })
}

/// Height of the hip joint of a lying person above the floor, metres of the average body.
const LYING_M: f64 = 0.125;

/// Returns a clip that squats down, sits on the floor, lies back with the knees up, looks around and gets up.
pub(crate) fn lie<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    const SECS: f64 = 10.0;
    Clip::new(SECS / speed, move |phase| {
        let down = closed(phase, &[(0.03, 0.0), (0.08, 0.06), (0.24, 1.0), (0.78, 1.0), (0.92, 0.06), (0.97, 0.0)]);
        // The trunk leans forward on the way, and falls back once the hips are on the floor.
        let lean = closed(
            phase,
            &[(0.02, 0.0), (0.14, 1.0), (0.26, 0.3), (0.34, 0.0), (0.66, 0.0), (0.78, 0.8), (0.86, 1.0), (0.98, 0.0)],
        );
        let back = closed(phase, &[(0.22, 0.0), (0.38, 1.0), (0.62, 1.0), (0.78, 0.0)]);
        let look = closed(phase, &[(0.38, 0.0), (0.46, 1.0), (0.54, -0.8), (0.62, 0.0)]);
        let mut posture = puppet.standing();
        breathe(&mut posture, phase, SECS);
        for (foot, side) in posture.feet.iter_mut().zip([1.0, -1.0]) {
            foot.at.x += side * 0.02;
        }
        posture.hips += DVec3::new(0.0, -(0.875 - LYING_M) * down, -0.42 * down - 0.06 * back);
        posture.pelvis.x += 0.55 * lean - 1.50 * back;
        posture.trunk.x += 0.45 * lean - 0.04 * back;
        posture.head += DVec3::new(-0.30 * lean, 0.0, 0.60 * look);
        posture.knees_out = 0.08 * down;
        for arm in &mut posture.arms {
            let front = Arm {
                upper: DVec3::new(0.14, -0.55, 0.80).normalize_or(DVec3::Z),
                fore: DVec3::new(-0.08, -0.25, 0.95).normalize_or(DVec3::Z),
                hand: [0.0, 0.0],
                curl: 0.2,
            };
            let beside = Arm::angled(0.02, puppet.hang_out() + 0.25, 0.10, 0.0);
            *arm = arm.mix(&front, down).mix(&beside, back);
        }
        posture
    })
}
