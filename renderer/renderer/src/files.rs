//! Splat files in the layout of the 3D Gaussian Splatting reference code, and those of other tools.

pub(crate) mod anisotropic_ply;
pub(crate) mod ply;
pub(crate) mod ply_error;
mod ply_header;
pub(crate) mod splat_file;
