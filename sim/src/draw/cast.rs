//! People in the room over time.

use flyrig_types::Pose;
use glam::Vec3;

use crate::config::SimConfig;
use crate::draw::capsules::Limbs;
use crate::draw::figure::Figured;
use crate::draw::moment::{Bound, Moment};
use crate::error::SimError;
use crate::person::actor::{Actor, ActorShape};
use crate::person::passer::passer_by;

/// Longest interval between keys, seconds, as long as there are at most [`MOST_KEYS`].
const KEY_SECS: f64 = 0.008;
const MOST_KEYS: usize = 65;

/// The person and an optional passer-by.
pub(crate) struct Cast {
    pub main: Actor,
    limbs: Limbs,
    other: Option<(Actor, Limbs)>,
}

impl Cast {
    pub(crate) fn new(config: &SimConfig) -> Result<Self, SimError> {
        let main = Actor::new(config)?;
        let other = if config.scene.passer_by { Some(passer_by(config)?) } else { None };
        let limbs = Limbs::new(&main.person);
        let other = other.map(|actor| {
            let limbs = Limbs::new(&actor.person);
            (actor, limbs)
        });
        Ok(Self { main, limbs, other })
    }

    /// Iterates over the actors, the person first.
    pub(crate) fn actors(&self) -> impl Iterator<Item = &Actor> {
        std::iter::once(&self.main).chain(self.other.iter().map(|(actor, _)| actor))
    }

    pub(crate) fn pose(&self, nanos: i64) -> Pose {
        self.main.pose(nanos)
    }

    /// Returns all people from `reach_secs` before an instant to as long after it.
    pub(crate) fn moment(&mut self, nanos: i64, reach_secs: f64) -> Moment {
        let count = match reach_secs {
            reach if reach <= 0.0 => 1,
            reach => ((2.0 * reach / KEY_SECS).ceil() as usize + 1).clamp(3, MOST_KEYS),
        };
        let gap_secs = if count > 1 { 2.0 * reach_secs / (count - 1) as f64 } else { 0.0 };
        let times: Vec<i64> = (0..count)
            .map(|key| nanos.saturating_add(((key as f64 * gap_secs - reach_secs) * 1e9).round() as i64))
            .collect();
        let mut moment = Moment {
            first_secs: if count > 1 { -reach_secs } else { 0.0 },
            keys_a_second: if count > 1 { gap_secs.recip() } else { 0.0 },
            people: Vec::new(),
            ball: (Vec3::ZERO, 0.0),
            bounds: Vec::new(),
            capsules: Vec::new(),
        };
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let everybody = std::iter::once((&mut self.main, &self.limbs))
            .chain(self.other.iter_mut().map(|(actor, limbs)| (actor, &*limbs)));
        for (actor, limbs) in everybody {
            let keys: Vec<ActorShape> = times.iter().map(|&at| actor.shape(at)).collect();
            let capsules = limbs.posed(&actor.person, &actor.pose(nanos));
            // Shade changes little within an exposure: the middle's serves all keys.
            let middle = &keys[count / 2];
            let openness = limbs.openness(&actor.person, &middle.positions, &middle.normals, &capsules);
            let points = || keys.iter().flat_map(|key| key.positions.iter().copied());
            let (own_low, own_high) =
                (points().fold(Vec3::INFINITY, Vec3::min), points().fold(Vec3::NEG_INFINITY, Vec3::max));
            let center = ((own_low + own_high) * 0.5).truncate();
            let radius = points().map(|p| p.truncate().distance_squared(center)).fold(0.0, f32::max).sqrt();
            moment.bounds.push(Bound { center: center.to_array(), radius, top: own_high.z });
            (low, high) = (low.min(own_low), high.max(own_high));
            moment.people.push(Figured { keys, openness });
            moment.capsules.extend(capsules);
        }
        moment.ball = ((low + high) * 0.5, (high - low).length() * 0.5 + 0.02);
        moment
    }
}
