//! Room around the person: walls, furniture, lamps and their surfaces.

pub(crate) mod furniture;
pub(crate) mod lamps;
mod plan;
pub(crate) mod rooms;
pub(crate) mod scene;
pub(crate) mod scene_config;
pub(crate) mod scene_mesh;
pub(crate) mod surfaces;
