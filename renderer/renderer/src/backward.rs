//! Backward rasteriser: dL/d image to dL/d Gaussians.
//!
//! It walks the tile lists of the image rendered last again and writes the sum of every (tile, Gaussian) pair to a slot of its own; the
//! slots of a Gaussian are then added in a fixed order, so that results do not depend on the order of threads.

pub(crate) mod device;
pub(crate) mod error;
pub(crate) mod gradients;
pub(crate) mod kernels;
pub(crate) mod processor;
pub(crate) mod rasterizer;
pub(crate) mod target;
