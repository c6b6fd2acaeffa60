//! Simulation of loose cloth and hair.
//!
//! Skirts, coat tails, open jackets, hems and hair ends are carried by control particles a few centimetres apart. Each
//! is pulled towards its skinned position with the frequency of a pendulum of its free length, is constrained to its
//! neighbours, and stays out of the body ([`solver`]). Surfaces follow by smooth weights ([`pieces`]); an instant
//! depends on its time alone, so any order of requests gives the same bytes ([`replay`]).

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

/// Loose parts of a person's clothes and hair.
pub(crate) struct Cloth {
    pieces: Pieces,
    replay: Replay,
}

impl Cloth {
    /// Creates the simulation; `None` for a person without loose clothes.
    pub(crate) fn new(person: &Person) -> Option<Self> {
        let colliders = Colliders::fitted(person);
        let pieces = Pieces::new(person, &colliders.at_rest())?;
        let replay = Replay::new(person.body.skeleton.clone(), pieces.particles.clone(), colliders);
        Some(Self { pieces, replay })
    }

    /// Moves the skinned surface of an instant to its loose positions and returns the world displacement of every
    /// vertex from its skinned position, metres.
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

    /// Returns the number of control particles.
    #[cfg(test)]
    pub(crate) fn particle_count(&self) -> usize {
        self.pieces.particles.particles.points.len()
    }
}
