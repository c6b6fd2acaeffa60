//! The avatar: attributes of its Gaussians, posing, light, files, rendering, and levels of detail for small images.

pub(crate) mod avatar;
mod coarser;
pub(crate) mod detail;
pub(crate) mod drawn_surface;
mod file;
pub(crate) mod known_poses;
pub(crate) mod light;
pub(crate) mod parameters;
pub(crate) mod posing;
pub(crate) mod scene;
pub(crate) mod splat_glb;
mod surface;
mod tracking;
