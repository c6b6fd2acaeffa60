//! Signed distances in sparse blocks of voxels.

mod blocks;
mod evidence;
mod fuse;
mod lattice;

pub use blocks::{Evidence, Field, Voxel};
pub use fuse::fuse;
pub(crate) use fuse::fuse_blocks;
pub(crate) use lattice::{SIDE, VOXELS, local_of, voxel_of};
