//! Export of a simulation and samples for training.

pub(crate) mod export;
pub(crate) mod training;
pub(crate) mod truth_file;
