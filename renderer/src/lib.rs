//! Splats to pictures and back: forward rasteriser, direct appearance, image metrics, splat export.

mod buffers;
mod raster;

pub use buffers::{GaussianBuffers, RenderTarget};
pub use raster::{Outputs, RasterSettings, Rasterizer};
