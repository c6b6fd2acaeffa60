//! Forward rasteriser: projection, stable sort by depth, lists by tile, blending.
//!
//! On the device Gaussians are sorted by depth, their pairs with tiles are written in that order and sorted by tile, both by one stable radix
//! sort ([`crate::sort`]); kernels whose work depends on the number of pairs are dispatched indirectly, so that nothing waits. [`processor`]
//! has the native twins of the kernels. Drawing kernels bind at most 8 storage buffers, the limit that browsers guarantee.

pub(crate) mod buffers;
pub(crate) mod device;
pub(crate) mod kernels;
pub(crate) mod processor;
pub(crate) mod rasterizer;
pub(crate) mod settings;
