//! On-the-fly deformation (FlyHuman section 3.1): moves the nodes of a deformation graph until the posed Gaussians
//! explain the images.
//!
//! The unknowns are the nodes' canonical translations `t_i`. A Gaussian at canonical `x` moves by `t_x`, the Eq. 2 mean of
//! its nodes, and stands in the world at `LBS(x + t_x)`. A [`DataTerm`](crate::DataTerm) renders and compares (the solver
//! itself knows no GPU). Its derivatives by world centres are carried back through the blended bone matrix of each Gaussian
//! and to the nodes, joined with Eq. 4, and turned into a step:
//!
//! - [`DeformSolver::Paper`](crate::DeformSolver::Paper): plain gradient descent, the measured baseline.
//! - [`DeformSolver::GaussNewton`](crate::DeformSolver::GaussNewton):
//!   `(H + 2 λ_reg (λ_spat + λ_temp) L + μ) Δt = -g`, with the Gauss-Newton matrix H of the data in 3x3 blocks for every
//!   pair of nodes that share a Gaussian, the graph Laplacian L and a Levenberg damping μ, by conjugate gradients; a step
//!   is accepted only if the loss fell.
//!
//! Everything is `f64` and summed in a fixed order.

mod carry;
pub(crate) mod data;
mod normal;
pub(crate) mod outline;
mod regularizer;
pub(crate) mod settings;
mod silhouette;
mod thickness;
pub(crate) mod track;
