//! Walking along closed paths.

use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};

use super::clip::Clip;
use crate::motion::posture::Arm;
use crate::motion::puppet::Puppet;
use crate::motion::steps::{Gait, Plant, STANCE, foot};

/// Lengths in metres of the average body.
const CIRCLE_M: f64 = 0.78;
/// Length of a step at speed 1.
const STEP_M: f64 = 0.56;
const STEPS_A_SECOND: f64 = 1.85;
/// Distance of the feet from the path.
const BESIDE_M: f64 = 0.058;

/// Closed path on the ground (x, z).
#[derive(Debug, Clone, Copy)]
enum Path {
    /// Counter-clockwise circle around the origin.
    Circle { radius: f64 },
    /// Two parallel lines, there and back, with half circles at the ends.
    Lanes { half_length: f64, radius: f64, near: f64, yaw: f64 },
}

impl Path {
    fn length(self) -> f64 {
        match self {
            Self::Circle { radius } => TAU * radius,
            Self::Lanes { half_length, radius, .. } => 4.0 * half_length + TAU * radius,
        }
    }

    /// Returns position and heading after `s` metres; the heading grows by a turn per cycle.
    fn at(self, s: f64) -> (DVec2, f64) {
        let round = (s / self.length()).floor();
        let s = s - round * self.length();
        match self {
            Self::Circle { radius } => {
                let yaw = s / radius;
                (-left_of(yaw) * radius, yaw + TAU * round)
            }
            Self::Lanes { half_length, radius, near, yaw } => {
                let (straight, bend) = (2.0 * half_length, PI * radius);
                // In the frame of the first lane: x to its left, y along it. The lane that comes back is left of it.
                let on_bend = |far: f64, turned: f64| {
                    DVec2::new(radius - radius * turned.cos(), half_length * far + radius * turned.sin())
                };
                let (at, turned) = if s < straight {
                    (DVec2::new(0.0, s - half_length), 0.0)
                } else if s < straight + bend {
                    let turned = (s - straight) / radius;
                    (on_bend(1.0, turned), turned)
                } else if s < 2.0 * straight + bend {
                    (DVec2::new(2.0 * radius, half_length - (s - straight - bend)), PI)
                } else {
                    let turned = PI + (s - 2.0 * straight - bend) / radius;
                    (on_bend(-1.0, turned), turned)
                };
                let forward = forward_of(yaw);
                (left_of(yaw) * (at.x + near) + forward * at.y, yaw + turned + TAU * round)
            }
        }
    }

    /// Returns the heading averaged over a step before and after: people turn before their path does.
    fn facing(self, s: f64, step_m: f64) -> f64 {
        let headings = (-4..=4).map(|i| self.at(s + f64::from(i) * 0.3 * step_m).1);
        headings.sum::<f64>() / 9.0
    }
}

fn forward_of(yaw: f64) -> DVec2 {
    DVec2::new(yaw.sin(), yaw.cos())
}

fn left_of(yaw: f64) -> DVec2 {
    DVec2::new(yaw.cos(), -yaw.sin())
}

/// Returns a walk around the ring's centre. Faster walkers take longer steps and more of them.
pub(crate) fn circle<'a>(puppet: &'a Puppet<'_>, speed: f64) -> Clip<'a> {
    walk(puppet, Path::Circle { radius: CIRCLE_M }, speed, 1.0)
}

/// Returns a walk straight through the room in the direction `yaw` with the centre `near_m` metres to the right, from
/// `reach_m` before the centre to `reach_m` behind it, and back at the same distance farther from the centre.
pub(crate) fn passing<'a>(
    puppet: &'a Puppet<'_>,
    near_m: f64,
    yaw: f64,
    reach_m: f64,
    speed: f64,
    swing: f64,
) -> Clip<'a> {
    const RADIUS_M: f64 = 0.42;
    let scale = puppet.scale();
    let half_length = (reach_m / scale - RADIUS_M).max(0.5);
    walk(puppet, Path::Lanes { half_length, radius: RADIUS_M, near: near_m / scale, yaw }, speed, swing)
}

fn walk<'a>(puppet: &'a Puppet<'_>, path: Path, speed: f64, swing: f64) -> Clip<'a> {
    let pace = speed.sqrt();
    // An even number of steps closes the round.
    let steps = 2.0 * (path.length() / (2.0 * STEP_M * pace)).round().max(2.0);
    let step_m = path.length() / steps;
    let secs = steps / (STEPS_A_SECOND * pace);
    let plants = [0usize, 1].map(|side| {
        let outwards = [1.0, -1.0][side];
        let plant = |index: f64| {
            let (at, heading) = path.at(index * step_m);
            Plant {
                leaves: (index - 2.0 + STANCE) / steps,
                lands: (index - STANCE) / steps,
                at: at + left_of(heading) * outwards * BESIDE_M,
                yaw: heading + outwards * 0.09,
            }
        };
        (0..(steps / 2.0) as u32).map(|i| plant(f64::from(2 * i) + side as f64)).collect::<Vec<_>>()
    });
    let long = (step_m / STEP_M).min(1.3);
    let gait = Gait { lift_m: 0.035 + 0.02 * long, push: 0.85 * long, strike: 0.30 * long };
    Clip::new(secs, move |phase| {
        let stepped = phase * steps;
        let s = stepped * step_m;
        let (at, heading) = path.at(s);
        let yaw = path.facing(s, step_m);
        let (wave, beat) = ((PI * stepped).sin(), (PI * stepped).cos());
        let (twice, _) = (TAU * stepped).sin_cos();
        // Into the bend, as bicycles lean.
        let turning = (path.facing(s + 0.1, step_m) - path.facing(s - 0.1, step_m)) / 0.2;
        let metres_a_second = step_m * steps / secs;
        let lean = (turning * metres_a_second * metres_a_second / 9.81).clamp(-0.2, 0.2);
        let mut posture = puppet.standing();
        let hips = at + forward_of(heading) * (0.030 - 0.010 * twice) + left_of(heading) * (0.024 * beat + 0.35 * lean);
        posture.hips = DVec3::new(hips.x, -0.020 - 0.006 * long, hips.y);
        posture.yaw = yaw;
        posture.pelvis = DVec3::new(0.03, -0.055 * beat + 0.3 * lean, 0.10 * long * wave);
        posture.trunk = DVec3::new(
            0.035 + 0.012 * (TAU * stepped + 0.6).cos(),
            0.060 * beat + 0.35 * lean,
            -0.20 * long * swing * wave,
        );
        let ahead = (path.facing(s + 1.2 * step_m, step_m) - yaw).clamp(-0.6, 0.6);
        posture.head =
            DVec3::new(-0.03 + 0.012 * (TAU * stepped).cos(), -0.02 * beat, 0.10 * long * wave + 0.6 * ahead);
        posture.feet = [0, 1].map(|side| foot(&plants[side], phase, TAU, gait));
        posture.arms = [1.0, -1.0].map(|side| {
            let forth = side * (PI * stepped - 0.15).sin();
            let forward = 0.02 + 0.38 * long * swing * forth;
            let bend = 0.30 + 0.30 * long * swing * (0.4 + forth).max(0.0);
            Arm::angled(forward, puppet.hang_out() - 0.02, bend, 0.30).with_hand(0.06, 0.0, 0.45)
        });
        posture
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_close_and_are_as_long_as_they_say() {
        let lanes = Path::Lanes { half_length: 3.0, radius: 0.4, near: 0.9, yaw: 0.7 };
        for path in [Path::Circle { radius: 0.8 }, lanes] {
            let length = path.length();
            let mut walked = 0.0;
            for i in 0..5000 {
                let s = |i: i32| length * f64::from(i) / 5000.0;
                let (step, heading) = (path.at(s(i + 1)).0 - path.at(s(i)).0, path.at(s(i) + 0.5 * length / 5000.0).1);
                walked += step.length();
                assert!(step.normalize().dot(forward_of(heading)) > 0.999, "{path:?} {i}");
            }
            assert!((walked / length - 1.0).abs() < 1e-4, "{walked} of {length}");
            assert!(path.at(length + 0.1).0.distance(path.at(0.1).0) < 1e-9);
            assert!((path.at(length + 0.1).1 - path.at(0.1).1 - TAU).abs() < 1e-9);
        }
        // The centre lies 0.9 m to the right of the first lane.
        let (at, heading) = lanes.at(3.0);
        assert!((at.dot(left_of(heading)) - 0.9).abs() < 1e-9 && at.dot(forward_of(heading)).abs() < 1e-9);
    }
}
