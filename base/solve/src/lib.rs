//! Numeric core: rotations, rigid alignment, robust line fits and robust nonlinear least squares.
//!
//! Everything is `f64`, single-threaded and deterministic: equal inputs give equal bits on one machine. Inputs that are
//! not finite or that leave the answer open give `None` or an error, never NaN.

mod align;
mod blocks;
mod kernel;
mod line;
mod median;
mod minimize;
mod motion;
mod normal;
mod rotation;
#[cfg(test)]
mod testing;

pub use align::{Alignment, PointPair, align_rigid, align_similarity};
pub use blocks::{BlockError, BlockProblem, Residual, block_covariance, jacobian_error, minimize_blocks};
pub use kernel::Kernel;
pub use line::{ClockLine, LineFit, LineGate, LineOptions, LineSample, fit_line};
pub use median::median;
pub use minimize::{Convergence, Problem, Solution, Stop, minimize};
pub use motion::RigidMotion;
pub use normal::{ArrowNormal, DenseNormal, EliminatedBlock, Factor, NormalEquations};
pub use rotation::{exp_rotation, left_jacobian, left_jacobian_inverse, log_rotation, skew};
