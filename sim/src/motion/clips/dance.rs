//! Dance: a seed's mixture of moves over steps from side to side.

use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use super::clip::Clip;
use crate::motion::curve::{ease, hump};
use crate::motion::posture::{Arm, Posture};
use crate::motion::puppet::Puppet;
use crate::motion::steps::{Gait, Plant, foot};

const BARS: usize = 8;
const BEATS_A_BAR: usize = 4;
const BEATS_A_MINUTE: f64 = 112.0;

/// Motion of hips, trunk and arms during a bar.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Move {
    /// Hips from side to side, arms swinging along.
    Sway,
    /// Trunk against hips, elbows bent.
    Twist,
    /// Both arms up, waving.
    ArmsUp,
    /// Knees bounce, fists pump.
    Bounce,
    /// One arm points up to the side, then the other.
    Point,
    /// Arms spread, rolling like a wave.
    Ripple,
}

const MOVES: [Move; 6] = [Move::Sway, Move::Twist, Move::ArmsUp, Move::Bounce, Move::Point, Move::Ripple];

/// Motion of the feet during a bar.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Footwork {
    /// A step to the side, the other foot follows, and back.
    SideTouch,
    /// Steps on the spot.
    March,
    /// Half a turn.
    Spin,
}

/// Returns eight bars drawn from a seed.
pub(crate) fn dance<'a>(puppet: &'a Puppet<'_>, seed: u64, speed: f64) -> Clip<'a> {
    let mut dice = StdRng::seed_from_u64(seed ^ 0x6461_6e63);
    let first = dice.random_range(0..MOVES.len());
    let mut moves = [MOVES[first]; BARS];
    for bar in 1..BARS {
        // Another one each bar, also across the seam.
        let step = dice.random_range(1..MOVES.len());
        let known = MOVES.iter().position(|&m| m == moves[bar - 1]).unwrap_or(0);
        moves[bar] = MOVES[(known + step) % MOVES.len()];
    }
    let spin = dice.random_range(2..BARS - 2);
    let feet: [Footwork; BARS] = std::array::from_fn(|bar| match bar {
        bar if bar == spin || bar == spin + 1 => Footwork::Spin,
        _ if dice.random_range(0..3) == 0 => Footwork::March,
        _ => Footwork::SideTouch,
    });
    let big = dice.random_range(0.8..1.15);
    let beats = (BARS * BEATS_A_BAR) as f64;
    let secs = beats * 60.0 / BEATS_A_MINUTE / speed;
    let plants = footsteps(&feet);
    let gait = Gait { lift_m: 0.055, push: 0.45, strike: 0.0 };
    Clip::new(secs, move |phase| {
        let beat = phase * beats;
        let bar = beat / BEATS_A_BAR as f64;
        // From move to move within the last beat of a bar.
        let index = (bar.floor() as usize).min(BARS - 1);
        let into_next = ease((bar - index as f64 - 0.82) / 0.18);
        let now = style(puppet, moves[index], beat, big);
        let mut posture = now.mix(&style(puppet, moves[(index + 1) % BARS], beat, big), into_next);
        posture.feet = [0, 1].map(|side| foot(&plants[side], phase, TAU, gait));
        let [left, right] = posture.feet;
        posture.yaw = (left.yaw + right.yaw) * 0.5;
        // Weight goes to the foot that stands, averaged over a beat: bodies are heavy.
        let weight_at = |phase: f64| {
            let [left, right] = [0, 1].map(|side| foot(&plants[side], phase, TAU, gait));
            let share = 0.5 + 7.0 * (right.lift - left.lift);
            right.at.lerp(left.at, share).lerp((left.at + right.at) * 0.5, 0.3)
        };
        let weight = (-4..=4).map(|i| weight_at(phase + 0.11 * f64::from(i) / beats)).sum::<DVec2>() / 9.0;
        posture.hips += DVec3::new(weight.x, 0.0, weight.y);
        posture
    })
}

/// Returns the plants of both feet over all bars, one step per beat.
fn footsteps(bars: &[Footwork; BARS]) -> [Vec<Plant>; 2] {
    const SIDE_M: f64 = 0.24;
    let beats = (BARS * BEATS_A_BAR) as f64;
    let mut plants = [Vec::new(), Vec::new()];
    let (mut middle, mut yaw) = (0.0f64, 0.0f64);
    for (bar, work) in bars.iter().enumerate() {
        for beat in 0..BEATS_A_BAR {
            // Left, right, then back: right, left.
            let side = match work {
                Footwork::SideTouch => [0, 1, 1, 0][beat],
                _ => beat % 2,
            };
            let outwards = [1.0, -1.0][side];
            let mut wide = 0.115;
            match work {
                Footwork::SideTouch => {
                    if beat == 0 {
                        middle = SIDE_M;
                    } else if beat == 2 {
                        middle = 0.0;
                    }
                    wide = if beat % 2 == 0 { 0.13 } else { 0.09 };
                }
                Footwork::March => middle = 0.0,
                Footwork::Spin => yaw += TAU / (2 * BEATS_A_BAR) as f64,
            }
            let start = (bar * BEATS_A_BAR + beat) as f64;
            let across = DVec2::new(yaw.cos(), -yaw.sin());
            plants[side].push(Plant {
                leaves: (start + 0.10) / beats,
                lands: (start + 0.82) / beats,
                at: across * (outwards * wide) + DVec2::X * middle,
                yaw: yaw + outwards * 0.22,
            });
        }
    }
    plants
}

/// Returns hips, trunk, head and arms of a move at a beat, with the feet side by side.
fn style(puppet: &Puppet<'_>, what: Move, beat: f64, big: f64) -> Posture {
    let mut posture = puppet.standing();
    let half = (PI * beat).sin() * big;
    let slow = (0.5 * PI * beat).sin() * big;
    let bounce = hump(beat.rem_euclid(1.0));
    let side = [1.0, -1.0];
    posture.hips.y -= 0.030 + 0.030 * bounce * big;
    posture.head.x += 0.06 * bounce;
    match what {
        Move::Sway => {
            posture.hips.x += 0.035 * half;
            posture.pelvis.y -= 0.12 * half;
            posture.trunk.y += 0.18 * half;
            posture.head.y -= 0.08 * half;
            posture.arms = side.map(|s| {
                Arm::angled(0.35 + 0.35 * s * half, 0.35, 1.0 + 0.25 * s * half, 0.45).with_hand(0.0, 0.4, 0.4)
            });
        }
        Move::Twist => {
            posture.pelvis.z += 0.28 * half;
            posture.trunk.z -= 0.55 * half;
            posture.trunk.x += 0.10;
            posture.arms = side.map(|s| Arm::angled(0.15 + 0.55 * s * half, 0.45, 1.5, 0.5).with_hand(0.0, 0.2, 0.8));
        }
        Move::ArmsUp => {
            posture.trunk += DVec3::new(-0.08, 0.14 * slow, 0.0);
            posture.pelvis.y -= 0.08 * half;
            posture.head.x -= 0.15;
            posture.arms = side.map(|s| Arm {
                upper: DVec3::new(0.55 + 0.20 * s * slow, 0.80, 0.18).normalize_or(DVec3::Y),
                fore: DVec3::new(0.05 + 0.45 * s * slow, 0.95, 0.12).normalize_or(DVec3::Y),
                hand: [0.2 * half, 0.2],
                curl: 0.15,
            });
        }
        Move::Bounce => {
            posture.hips.y -= 0.045 * bounce;
            posture.trunk.x += 0.12 + 0.10 * bounce;
            posture.arms = side.map(|s| {
                Arm::angled(0.55 + 0.30 * bounce, 0.30, 1.75 - 0.45 * (1.0 + s * half) * bounce, 0.25)
                    .with_hand(0.0, 0.0, 0.95)
            });
        }
        Move::Point => {
            posture.trunk += DVec3::new(0.0, 0.10 * slow, 0.25 * slow);
            posture.head += DVec3::new(-0.12, 0.0, 0.35 * slow);
            posture.pelvis.y -= 0.10 * slow;
            posture.arms = side.map(|s| {
                let up = ease(0.5 + 0.9 * s * slow);
                let pointing = Arm {
                    upper: DVec3::new(0.72, 0.55, 0.42).normalize_or(DVec3::Y),
                    fore: DVec3::new(0.70, 0.62, 0.36).normalize_or(DVec3::Y),
                    hand: [0.0, 0.3],
                    curl: 0.45,
                };
                Arm::angled(0.10, 0.50, 1.6, 0.9).with_hand(0.1, 0.2, 0.7).mix(&pointing, up)
            });
        }
        Move::Ripple => {
            posture.trunk.y += 0.10 * half;
            posture.hips.x += 0.02 * half;
            posture.arms = side.map(|s| {
                let (now, late) = ((PI * beat + 0.8 * s).sin() * big, (PI * beat + 0.8 * s - 0.9).sin() * big);
                Arm {
                    upper: DVec3::new(0.93, -0.10 + 0.32 * now, 0.25).normalize_or(DVec3::X),
                    fore: DVec3::new(0.90, -0.05 + 0.50 * late, 0.32).normalize_or(DVec3::X),
                    hand: [0.35 * late, 0.0],
                    curl: 0.12,
                }
            });
        }
    }
    posture
}
