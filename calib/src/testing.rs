//! Simulated boards, for tests and benchmarks.

mod corners;
mod photograph;

pub use corners::{Random, pose_errors, ring, shots, view};
pub use photograph::photograph;
