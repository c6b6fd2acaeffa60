//! Loose cloth and hair: how they swing.
//!
//! Skirts, coat tails, open jackets, hems and hair ends are carried by control particles a few centimetres apart. Each
//! is drawn to the place that skinning gives it with the frequency of a pendulum as long as it hangs free, is held to its
//! neighbours, and stays out of the body ([`solver`]). Surfaces follow by smooth weights ([`pieces`]); what is computed
//! is a function of time alone ([`replay`]).

mod colliders;
mod pieces;
mod replay;
mod solver;

#[cfg(test)]
mod tests;

use flyrig_types::PoseTrack;
use glam::Vec3;

use crate::person::assembly::Person;
use colliders::Colliders;
use pieces::Pieces;
use replay::Replay;

/// The loose parts of a person's clothes and hair.
pub(crate) struct Cloth {
    pieces: Pieces,
    replay: Replay,
}

impl Cloth {
    /// `None` for a person who wears nothing loose.
    pub(crate) fn new(person: &Person) -> Option<Self> {
        let colliders = Colliders::fitted(person);
        let pieces = Pieces::new(person, &colliders.at_rest())?;
        let replay = Replay::new(person.body.skeleton.clone(), pieces.particles.clone(), colliders);
        Some(Self { pieces, replay })
    }

    /// Moves the skinned surface of an instant to where its loose parts are, and gives the world offset of every vertex
    /// from its skinned place, metres.
    pub(crate) fn apply(
        &mut self,
        track: &PoseTrack,
        nanos: i64,
        positions: &mut [Vec3],
        normals: &mut [Vec3],
    ) -> Vec<Vec3> {
        let offsets = self.replay.at(track, nanos);
        let capsules = self.replay.capsules(track, nanos);
        self.pieces.apply(&offsets, &capsules, positions, normals)
    }

    /// Control particles.
    #[cfg(test)]
    pub(crate) fn particle_count(&self) -> usize {
        self.pieces.particles.particles.points.len()
    }
}
