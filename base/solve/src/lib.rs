//! Numerical algorithms: rotations, rigid alignment, robust line fits and robust nonlinear least squares.
//!
//! All computations are in `f64`, single-threaded and deterministic: equal inputs give equal bits on one machine. Inputs that are
//! not finite or leave the solution undetermined give `None` or an error, never NaN.

mod align;
mod blocks;
mod kernel;
mod line;
mod minimize;
mod motion;
mod normal;
mod percentile;
mod rotation;
#[cfg(test)]
mod testing;

pub use align::{Alignment, PointPair, align_rigid, align_similarity};
pub use blocks::{BlockError, BlockProblem, Residual, block_covariance, jacobian_error, minimize_blocks};
pub use kernel::Kernel;
pub use line::{ClockLine, LineFit, LineGate, LineOptions, LineSample, fit_line};
pub use minimize::{Convergence, Problem, Solution, Stop, minimize};
pub use motion::RigidMotion;
pub use normal::{ArrowNormal, DenseNormal, EliminatedBlock, Factor, NormalEquations};
pub use percentile::{median, percentile};
pub use rotation::{exp_rotation, left_jacobian, left_jacobian_inverse, log_rotation, skew};
