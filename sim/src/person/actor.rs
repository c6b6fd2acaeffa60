//! A person who moves.

use flyrig_body::skin_mesh;
use flyrig_types::{Pose, PoseTrack};
use glam::Vec3;

use crate::cloth::Cloth;
use crate::motion::choice;
use crate::person::assembly::Person;
use crate::person::look::Look;
use crate::{SimConfig, SimError};

/// A dressed person with a motion.
pub(crate) struct Actor {
    pub person: Person,
    pub track: PoseTrack,
    /// None for a person who wears nothing loose.
    cloth: Option<Cloth>,
}

/// The surface that the cameras see, world metres, in the order of [`Person::clothed`].
#[derive(Debug, Clone, Default)]
pub(crate) struct Shape {
    pub positions: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    /// How far each vertex is from where skinning alone would put it, world metres.
    pub displacement: Vec<Vec3>,
}

impl Actor {
    pub(crate) fn new(config: &SimConfig) -> Result<Self, SimError> {
        let person = Person::new(&Look::new(config), config.seed, config.texture_px as usize, config.person.fingers)?;
        let track = choice::track(config, &person)?;
        let cloth = Cloth::new(&person);
        Ok(Self { person, track, cloth })
    }

    /// Pose at a time; the motion starts over after its end.
    pub(crate) fn pose(&self, nanos: i64) -> Pose {
        self.track.at_repeated(nanos)
    }

    /// The surface at a time.
    pub(crate) fn shape(&mut self, nanos: i64) -> Shape {
        let (mut positions, mut normals) = skin_mesh(&self.person.clothed, &self.pose(nanos));
        let displacement = match &mut self.cloth {
            Some(cloth) => cloth.apply(&self.track, nanos, &mut positions, &mut normals),
            None => vec![Vec3::ZERO; positions.len()],
        };
        Shape { positions, normals, displacement }
    }
}
