//! Synthetic people: appearance drawn from a seed, body, face, hair, shoes, and their assembly with clothes into one
//! textured surface.

pub(crate) mod actor;
pub(crate) mod assembly;
pub(crate) mod describe;
pub(crate) mod face;
pub(crate) mod features;
pub(crate) mod hair;
pub(crate) mod hats;
pub(crate) mod look;
pub(crate) mod palette;
pub(crate) mod passer;
pub(crate) mod regions;
pub(crate) mod shoes;
