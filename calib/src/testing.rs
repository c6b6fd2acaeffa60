//! Simulated boards and errors of rigs, for tests and benchmarks.

mod corners;
mod photograph;
mod rig_errors;

pub use corners::{Random, bent_shots, pose_errors, ring, shots, view};
pub use photograph::photograph;
pub use rig_errors::{RigError, rig_errors};
