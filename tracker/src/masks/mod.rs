//! Masks of people: backgrounds, coarse masks of the network, gates of the posed body, and mattes.

pub(crate) mod background;
pub(crate) mod background_event;
pub(crate) mod background_light;
pub(crate) mod carried_mask;
mod drift;
pub(crate) mod edge_color;
pub(crate) mod gate;
pub(crate) mod gated_mask;
pub(crate) mod key_color;
pub(crate) mod matte;
pub(crate) mod person_area;
mod plate;
mod plate_evidence;
mod plate_shift;
pub(crate) mod seen_background;
pub(crate) mod silhouette;
pub(crate) mod support;
