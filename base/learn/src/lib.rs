//! Gradient descent for networks and avatars: parameters by name, their conversion to tensors and back, convolutions, Adam.
//!
//! A crate of its own because of the build time of `burn`, which other crates use through this one.

mod adam;
mod column_adam;
mod convolution;
mod parameters;

pub use adam::{AdamStep, Moments};
pub use burn_tensor;
pub use column_adam::ColumnAdam;
pub use convolution::{Convolution, ConvolutionSlopes, Planes};
pub use parameters::{Parameter, Start, Tensors, count, drawn, is_finite, to_vec};
