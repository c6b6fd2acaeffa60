//! Deformation tracking: solvers compared, endurance, and behaviour under faults.

mod case;
mod cases;
#[cfg(test)]
mod desync_tests;
pub mod endure;
#[cfg(test)]
mod state_tests;
mod summary;
pub mod track;
mod write;
