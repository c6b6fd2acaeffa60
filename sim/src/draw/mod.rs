//! Rasteriser of simulated images and of their ground truth, with its shaders.

pub(crate) mod capsules;
pub(crate) mod cast;
pub(crate) mod constants;
pub(crate) mod drawing;
pub(crate) mod figure;
pub(crate) mod gpu_parts;
pub(crate) mod moment;
mod passes;
mod pipelines;
pub(crate) mod plates;
