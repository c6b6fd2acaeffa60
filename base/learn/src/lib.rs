//! Gradient descent on networks, for learned appearance and avatars alike: parameters by name, their way into tensors and back, Adam.
//!
//! A crate of its own because of the build time of `burn`: other crates use it through this one.

mod adam;
mod parameters;

pub use adam::{AdamStep, Moments};
pub use burn_tensor;
pub use parameters::{Parameter, Start, Tensors, count, drawn, is_finite, to_vec};
