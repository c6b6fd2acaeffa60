//! Jumping on the spot.

use glam::DVec3;

use super::clip::Clip;
use super::gestures::breathe;
use crate::motion::curve::{closed, ease, hermite};
use crate::motion::posture::Arm;
use crate::motion::puppet::Puppet;

/// Returns a jump: crouches, swings the arms, flies ballistically, lands softly and stands up.
pub(crate) fn jump<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    const SECS: f64 = 3.2;
    /// Phases of take-off and touch-down.
    const OFF: f64 = 0.40;
    const ON: f64 = 0.55;
    /// Phases of the deepest crouch before and after the flight, and their depths, metres.
    const BENT: f64 = 0.29;
    const LOW: f64 = 0.64;
    const DEEP_M: f64 = 0.30;
    const SOFT_M: f64 = 0.27;
    const GRAVITY: f64 = 9.81;
    let in_air_secs = (ON - OFF) * SECS;
    let apex_m = GRAVITY * in_air_secs * in_air_secs / 8.0;
    // Hips from standing down, up to the tips of the toes with the speed of the flight, down into a crouch with it.
    let speed_up = 0.5 * GRAVITY * in_air_secs * SECS;
    let (tips_m, soles_m) = (0.055, 0.025);
    let hips = move |phase: f64| match phase {
        p if p < BENT => -DEEP_M * ease((p - 0.06) / (BENT - 0.06)),
        p if p < OFF => hermite((p - BENT) / (OFF - BENT), [-DEEP_M, tips_m], [0.0, speed_up * (OFF - BENT)]),
        p if p < ON => {
            let flight = (p - OFF) / (ON - OFF);
            4.0 * apex_m * flight * (1.0 - flight) + tips_m + (soles_m - tips_m) * ease(flight)
        }
        p if p < LOW => hermite((p - ON) / (LOW - ON), [soles_m, -SOFT_M], [-speed_up * (LOW - ON), 0.0]),
        p => -SOFT_M * (1.0 - ease((p - LOW - 0.02) / 0.24)),
    };
    Clip::new(SECS / speed, move |phase| {
        let crouch = closed(
            phase,
            &[(0.06, 0.0), (BENT - 0.01, 1.0), (OFF, 0.0), (ON - 0.02, 0.10), (LOW + 0.01, 0.95), (0.90, 0.0)],
        );
        let tiptoe = closed(phase, &[(0.30, 0.0), (OFF, 1.0), (0.47, 1.0), (ON, 0.45), (0.59, 0.0)]);
        let back = closed(
            phase,
            &[(0.06, 0.0), (0.27, 1.0), (0.30, 1.0), (0.37, 0.0), (0.62, 0.0), (0.72, 0.35), (0.90, 0.0)],
        );
        let up = closed(phase, &[(0.29, 0.0), (0.41, 1.0), (0.50, 1.0), (0.66, 0.0)]);
        let tucked = closed(phase, &[(OFF, 0.0), (0.475, 1.0), (ON, 0.0)]);
        let flight = ((phase - OFF) / (ON - OFF)).clamp(0.0, 1.0);
        let height = 4.0 * apex_m * flight * (1.0 - flight);
        let mut posture = puppet.standing();
        breathe(&mut posture, phase, SECS);
        for (foot, side) in posture.feet.iter_mut().zip([1.0, -1.0]) {
            foot.at.x += side * 0.02;
            foot.roll = 0.75 * ease(tiptoe);
            foot.lift = height + 0.07 * tucked;
        }
        posture.hips += DVec3::new(0.0, hips(phase), -0.07 * crouch);
        posture.pelvis.x += 0.42 * crouch;
        posture.trunk.x += 0.40 * crouch - 0.14 * up;
        posture.head.x -= 0.45 * crouch - 0.06 * up;
        posture.knees_out = 0.10 * crouch;
        for arm in &mut posture.arms {
            let behind = Arm::angled(-0.95, puppet.hang_out() + 0.12, 0.25, 0.0);
            let above = Arm {
                upper: DVec3::new(0.35, 0.72, 0.60).normalize_or(DVec3::Y),
                fore: DVec3::new(0.12, 0.92, 0.38).normalize_or(DVec3::Y),
                hand: [0.0, 0.2],
                curl: 0.2,
            };
            // Through the front, close to the body.
            let middle = Arm::angled(0.7, puppet.hang_out(), 0.7, 0.2);
            let raised = arm.mix(&middle, ease(2.0 * up)).mix(&above, ease(2.0 * up - 1.0));
            *arm = raised.mix(&behind, back);
        }
        posture
    })
}
