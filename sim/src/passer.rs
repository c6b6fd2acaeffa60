//! A second person who walks through.

use std::f64::consts::TAU;

use flyrig_types::PoseTrack;
use glam::{DQuat, DVec3};

use crate::actor::Actor;
use crate::sensor::{hash, uniform};
use crate::{MotionConfig, PersonConfig, SimConfig, SimError};

/// Another person than the configuration's, who walks to and fro past the middle.
pub(crate) fn passer_by(config: &SimConfig) -> Result<Actor, SimError> {
    let seed = hash(config.seed, 0x9a55_e12b);
    let own = SimConfig {
        seed,
        person: PersonConfig::default(),
        motion: MotionConfig { turn_secs: 9.0, ..MotionConfig::default() },
        ..config.clone()
    };
    let mut actor = Actor::new(&own)?;
    // Outside of what the person reaches, inside the ring.
    let line_m = (0.48 * config.cameras.radius_m).max(1.35);
    actor.track = walk(&actor.track, seed, line_m, 0.75 * config.cameras.radius_m)?;
    Ok(actor)
}

/// A turn on the spot, drawn out along a line that passes the middle at `line_m` and reaches `reach_m` to both sides.
fn walk(turn: &PoseTrack, seed: u64, line_m: f64, reach_m: f64) -> Result<PoseTrack, SimError> {
    let (start, end) = turn.span_nanos();
    let heading = TAU * uniform(seed, 1);
    let (sin, cos) = heading.sin_cos();
    let (along, aside) = (DVec3::new(cos, sin, 0.0), DVec3::new(-sin, cos, 0.0));
    let keys = turn
        .keys()
        .iter()
        .map(|(nanos, pose)| {
            let share = (nanos - start) as f64 / (end - start) as f64;
            let mut pose = pose.clone();
            // The turn faces -y at the start and goes once around; a walker faces where it goes.
            let wave = TAU * share;
            let facing = heading + if wave.cos() > 0.0 { 0.0 } else { TAU / 2.0 };
            let turned = DQuat::from_rotation_z(facing + TAU / 4.0 - wave);
            pose.root_translation = turned * pose.root_translation + along * (reach_m * wave.sin()) + aside * line_m;
            if let Some(root) = pose.joint_rotations.first_mut() {
                *root = (turned * *root).normalize();
            }
            (*nanos, pose)
        })
        .collect();
    Ok(PoseTrack::new(keys)?)
}
