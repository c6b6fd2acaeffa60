//! Splat files in the layout of the 3D Gaussian Splatting reference code.

pub(crate) mod anisotropic_ply;
pub(crate) mod ply;
