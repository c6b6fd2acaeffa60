//! Motion of the simulated people: clips, postures and the puppet that takes them.

pub(crate) mod choice;
pub(crate) mod clips;
pub(crate) mod curve;
pub(crate) mod fingers;
pub(crate) mod posture;
pub(crate) mod puppet;
pub(crate) mod steps;
