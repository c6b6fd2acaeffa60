//! Native twins of the drawing kernels, for computers whose only graphics adapter is a software one.
//!
//! They follow the WGSL kernels step by step and agree with them up to rounding; `tests/raster.rs` and its siblings
//! check both against one reference. Threads share work by rows of tiles, lanes by the pixels of a row, and every sum
//! runs in a fixed order: equal input gives equal bytes, whatever the number of threads.
//!
//! A tile's pixels are blended eight at a time by plain loops over arrays of eight, compiled for each generation of vector
//! instructions; [`flyrig_types::vectorized`] picks the one that the processor has.

#![allow(clippy::needless_range_loop)] // one index for several lanes is what compilers turn into vectors

pub(crate) mod blend;
pub(crate) mod lanes;
pub(crate) mod lists;
pub(crate) mod planes;
pub(crate) mod project;
pub(crate) mod rasterizer;
pub(crate) mod shape;
