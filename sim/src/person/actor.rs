//! Person with a motion.

use flyrig_body::skin_mesh;
use flyrig_types::{Pose, PoseTrack};
use glam::Vec3;

use crate::cloth::Cloth;
use crate::config::SimConfig;
use crate::error::SimError;
use crate::motion::choice;
use crate::person::assembly::Person;
use crate::person::look::PersonLook;

/// Dressed person with a motion.
pub(crate) struct Actor {
    pub person: Person,
    pub track: PoseTrack,
    /// Loose cloth; `None` for a person without any.
    cloth: Option<Cloth>,
}

/// Visible surface, world metres, in the order of [`Person::clothed`].
#[derive(Debug, Clone, Default)]
pub(crate) struct ActorShape {
    pub positions: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    /// Displacement of each vertex from its skinned position, world metres.
    pub displacement: Vec<Vec3>,
}

impl Actor {
    pub(crate) fn new(config: &SimConfig) -> Result<Self, SimError> {
        let person =
            Person::new(&PersonLook::new(config), config.seed, config.texture_px as usize, config.person.fingers)?;
        let track = choice::track(config, &person)?;
        let cloth = Cloth::new(&person);
        Ok(Self { person, track, cloth })
    }

    /// Returns the pose at a time; the motion repeats.
    pub(crate) fn pose(&self, nanos: i64) -> Pose {
        self.track.at_repeated(nanos)
    }

    /// Returns the surface at a time.
    pub(crate) fn shape(&mut self, nanos: i64) -> ActorShape {
        let (mut positions, mut normals) = skin_mesh(&self.person.clothed, &self.pose(nanos));
        let displacement = match &mut self.cloth {
            Some(cloth) => cloth.apply(&self.track, nanos, &mut positions, &mut normals),
            None => vec![Vec3::ZERO; positions.len()],
        };
        ActorShape { positions, normals, displacement }
    }
}
