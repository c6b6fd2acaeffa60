//! One step of the particles: extended position-based dynamics with small steps (Macklin, Müller, Chentanez, XPBD:
//! Position-Based Simulation of Compliant Constrained Dynamics, MIG 2016, Eq. 17 and 18, one iteration a step as in
//! Macklin et al., Small Steps in Physics Simulation, SCA 2019).

use glam::Vec3;

use super::colliders::Capsule;

/// Steps per second.
pub(crate) const STEPS_A_SECOND: i64 = 120;
pub(crate) const STEP_SECS: f32 = 1.0 / STEPS_A_SECOND as f32;
pub(crate) const GRAVITY: f32 = 9.81;
/// Damping rate of motion through air, 1/s.
const AIR: f32 = 0.9;
/// Damping rate of motion relative to the wearer, 1/s.
const RUB: f32 = 1.6;
/// Inverse stiffness of threads, and of compressed cloth, per unit of mass.
const STRETCH_COMPLIANCE: f32 = 1e-5;
const PUSH_COMPLIANCE: f32 = 4e-4;
/// Fraction of the sliding along the body that friction removes per step.
const FRICTION: f32 = 0.25;
/// Largest velocity relative to the wearer, metres per second.
const FASTEST: f32 = 7.0;
/// Movement of a carrier per step above which the particle is moved along rigidly, metres.
const TELEPORT_M: f32 = 0.25;
/// Height of resting cloth above the floor, metres.
const FLOOR_M: f32 = 0.004;

/// Constant properties of the particles.
#[derive(Debug, Clone, Default)]
pub(crate) struct Particles {
    pub points: Vec<Particle>,
    pub links: Vec<ParticleLink>,
}

/// Control particle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Particle {
    /// Free length, metres; 0 for a fixed particle.
    pub free_m: f32,
    /// Stiffness of its material relative to plain cloth.
    pub stiff: f32,
    /// Largest movement against the surface's normal, metres.
    pub backstop_m: f32,
    /// Allowed depth inside the body's capsules, as at rest, metres; `None` if they do not push it.
    pub inside_m: Option<f32>,
}

/// Two particles and their rest distance, metres; `soft` multiplies the compliance (bending).
#[derive(Debug, Clone, Copy)]
pub(crate) struct ParticleLink {
    pub ends: [u32; 2],
    pub rest_m: f32,
    pub soft: f32,
}

/// Skinned state of a particle at a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SkinnedParticle {
    /// Skinned position.
    pub place: Vec3,
    /// Direction that was up at rest.
    pub up: Vec3,
    /// Normal of the surface.
    pub normal: Vec3,
}

/// Simulated state of the particles.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct State {
    pub places: Vec<Vec3>,
    pub speeds: Vec<Vec3>,
    /// Skinned positions of the previous step.
    pub carried: Vec<Vec3>,
}

impl State {
    /// Returns the state at rest on the body.
    pub(crate) fn at_rest(carried: &[SkinnedParticle]) -> Self {
        let places: Vec<Vec3> = carried.iter().map(|c| c.place).collect();
        Self { speeds: vec![Vec3::ZERO; places.len()], carried: places.clone(), places }
    }
}

/// Returns the squared angular frequency of a particle about its skinned position, 1/s²: that of a pendulum of its
/// length, as gravity at rest is part of its shape.
pub(crate) fn pull(particle: &Particle) -> f32 {
    particle.stiff * GRAVITY / particle.free_m.max(1e-3)
}

/// Advances the particles by [`STEP_SECS`].
pub(crate) fn step(particles: &Particles, carried: &[SkinnedParticle], capsules: &[Capsule], state: &mut State) {
    const DT: f32 = STEP_SECS;
    let before = state.places.clone();
    for (i, (particle, now)) in particles.points.iter().zip(carried).enumerate() {
        let was = state.carried[i];
        if !now.place.is_finite() {
            continue;
        }
        if now.place.distance(was) > TELEPORT_M || !was.is_finite() {
            // The wearer is somewhere else now: everything goes along.
            (state.places[i], state.speeds[i]) = (now.place, Vec3::ZERO);
            continue;
        }
        if particle.free_m <= 0.0 {
            state.places[i] = now.place;
            continue;
        }
        // What gravity does beyond what threads hold at rest; those that have fallen over hold nothing.
        let fall = (now.up * now.up.z.max(0.0) - Vec3::Z) * GRAVITY;
        let wearer = (now.place - was) / DT;
        let mut speed = (state.speeds[i] + fall * DT) / (1.0 + AIR * DT);
        speed = wearer + (speed - wearer) / (1.0 + RUB * DT);
        let place = state.places[i] + speed * DT;
        let pull = pull(particle) * DT * DT;
        state.places[i] = place + (now.place - place) * (pull / (1.0 + pull));
    }
    for link in &particles.links {
        hold(particles, link, &mut state.places);
    }
    for (i, (particle, now)) in particles.points.iter().zip(carried).enumerate() {
        if particle.free_m <= 0.0 || !now.place.is_finite() {
            state.carried[i] = now.place;
            continue;
        }
        let wearer = now.place - state.carried[i];
        let follows = wearer.length() <= TELEPORT_M;
        let wearer = if follows { wearer } else { Vec3::ZERO };
        let mut place = state.places[i];
        let above = (place - now.place).dot(now.normal) + particle.backstop_m;
        place -= now.normal * above.min(0.0);
        if let Some(inside_m) = particle.inside_m {
            for capsule in capsules {
                if let Some((depth, out)) = capsule.depth(place).filter(|(depth, _)| *depth > inside_m) {
                    place += out * (depth - inside_m);
                    let slid = place - before[i] - wearer;
                    place -= (slid - out * slid.dot(out)) * FRICTION;
                }
            }
        }
        place.z = place.z.max(FLOOR_M);
        // No thread is longer than it is, whatever happens.
        place = now.place + (place - now.place).clamp_length_max(1.3 * particle.free_m);
        let speed = match follows {
            true => (place - before[i] - wearer).clamp_length_max(FASTEST * DT) / DT + wearer / DT,
            false => Vec3::ZERO,
        };
        let sound = place.is_finite() && speed.is_finite();
        (state.places[i], state.speeds[i]) = if sound { (place, speed) } else { (now.place, Vec3::ZERO) };
        state.carried[i] = now.place;
    }
}

/// Applies a distance constraint: Eq. 18 of XPBD with the multiplier reset to zero each step; all free particles have
/// equal mass.
fn hold(particles: &Particles, link: &ParticleLink, places: &mut [Vec3]) {
    let [a, b] = link.ends.map(|end| end as usize);
    let weight = |i: usize| f32::from(u8::from(particles.points[i].free_m > 0.0));
    let (wa, wb) = (weight(a), weight(b));
    let apart = places[b] - places[a];
    let length = apart.length();
    if wa + wb <= 0.0 || length < 1e-6 {
        return;
    }
    let too_long = length - link.rest_m;
    let compliance = link.soft * if too_long > 0.0 { STRETCH_COMPLIANCE } else { PUSH_COMPLIANCE };
    let share = too_long / (wa + wb + compliance / (STEP_SECS * STEP_SECS));
    let moved = apart * (share / length);
    places[a] += moved * wa;
    places[b] -= moved * wb;
}
