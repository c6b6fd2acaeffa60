//! Signed distances in sparse blocks of voxels.

mod blocks;
mod evidence;
mod fuse;

pub use blocks::{Evidence, Field, Voxel};
pub(crate) use blocks::{SIDE, VOXELS, local_of, voxel_of};
pub use fuse::fuse;
