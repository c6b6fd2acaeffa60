//! Gaussians of three scales, a rotation and a colour by direction: buffers, derivatives, and the evaluation of colours.
//!
//! Their projection and its derivative are sections of the kernels in [`crate::raster`] and [`crate::backward`]; sort, lists and blending are
//! those of isotropic Gaussians.

pub(crate) mod buffers;
pub(crate) mod harmonics;
pub(crate) mod join;
pub(crate) mod order;
pub(crate) mod recolor;
pub(crate) mod splats;
