//! Second person who walks through the room.

use crate::camera::sensor::hash;
use crate::config::{MotionConfig, MotionKind, PersonConfig, SimConfig};
use crate::error::SimError;
use crate::motion::choice;
use crate::person::actor::Actor;

/// Creates a person other than the configured one, who walks to and fro past the centre.
pub(crate) fn passer_by(config: &SimConfig) -> Result<Actor, SimError> {
    let seed = hash(config.seed, 0x9a55_e12b);
    let own = SimConfig {
        seed,
        person: PersonConfig::default(),
        // Its own track replaces this one.
        motion: MotionConfig { kind: MotionKind::Still, ..MotionConfig::default() },
        ..config.clone()
    };
    let mut actor = Actor::new(&own)?;
    // Turns round inside the ring, so that no camera is in the way.
    actor.track = choice::pass_by(&actor.person, seed, 0.75 * config.cameras.radius_m)?;
    Ok(actor)
}
