//! Generated motions: each is a closed curve of postures.

mod clip;
mod dance;
mod gestures;
mod jump;
mod lower;
mod turn;
mod walk;

use crate::config::MotionKind;
use crate::motion::puppet::Puppet;

pub(crate) use clip::Clip;
pub(crate) use walk::passing;

/// Returns the clip of a kind; files and the seed's choice are not clips and stand still. `turn_secs` is the time of a
/// full turn at speed 1.
pub(crate) fn clip<'a>(kind: MotionKind, puppet: &'a Puppet<'_>, seed: u64, turn_secs: f64, speed: f64) -> Clip<'a> {
    let speed = speed.max(1e-3);
    match kind {
        MotionKind::Turn => turn::turn(puppet, turn_secs / speed),
        MotionKind::Walk => walk::circle(puppet, speed),
        MotionKind::Wave => gestures::wave(puppet, speed),
        MotionKind::Reach => gestures::reach(puppet, speed),
        MotionKind::CrossArms => gestures::cross_arms(puppet, speed),
        MotionKind::Squat => lower::squat(puppet, speed),
        MotionKind::Sit => lower::sit(puppet, speed),
        MotionKind::Lie => lower::lie(puppet, speed),
        MotionKind::Jump => jump::jump(puppet, speed),
        MotionKind::Dance => dance::dance(puppet, seed, speed),
        MotionKind::Still | MotionKind::BySeed | MotionKind::Bvh | MotionKind::Gltf => gestures::still(puppet),
    }
}

#[cfg(test)]
mod tests;
