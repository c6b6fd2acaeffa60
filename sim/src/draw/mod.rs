//! Rasteriser of simulated images and of their ground truth, with its shaders.
//!
//! The room's light is baked into plates for each camera and lamp. People are lit at their vertices, rendered into the
//! room's depth, and summed over shutter and lens. All cameras of an instant share one submission. Constants lie in
//! storage buffers, since Mesa's software adapter never frees its specialisations for uniform buffers.

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
