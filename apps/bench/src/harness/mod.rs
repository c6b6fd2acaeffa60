//! Shared parts of the benchmarks: arguments, simulated sequences, measures.

pub mod arguments;
pub mod images;
pub mod joints;
pub mod people;
pub mod sequence;
pub mod statistics;
pub mod surface;
