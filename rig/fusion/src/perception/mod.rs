//! Perception: people in frame sets, as observations with a pose and a mask in every view.
//!
//! [`observation`] is the interface. [`estimated`] finds people in the images, [`given`] takes known poses. Shared by both:
//! [`background`] keeps each camera's empty scene up to date, [`outfit_search`] looks for shoes and skirts, [`split_mask`] divides a mask
//! among several people, and [`clothes_colors`] distinguishes people who come back.

mod background;
mod clothes_colors;
pub(crate) mod estimated;
pub(crate) mod given;
pub(crate) mod observation;
mod outfit_search;
mod sampling;
mod split_mask;

pub use estimated::EstimatedPerception;
pub use given::{GivenPerception, GivenPerson};
pub use observation::{KnownPerson, Perception, PersonObservation, SeenPerson, ViewObservation};
pub use sampling::{SHAPE_SECS, SHAPE_SETS};
