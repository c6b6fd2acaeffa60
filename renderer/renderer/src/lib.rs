//! Splats to images and back: forward and backward rasteriser, direct appearance, splat files.

mod anisotropic;
mod anisotropic_ply;
mod anisotropic_splats;
mod appearance;
mod browser_kernels;
mod buffers;
mod color;
mod color_match;
mod color_means;
mod constants;
mod export;
mod gradients;
mod image_loss;
mod processor;
mod raster;
mod raster_backward;
mod raster_backward_device;
mod raster_backward_kernels;
mod raster_buffers;
mod raster_device;
mod raster_kernels;
mod raster_settings;
mod scan;
mod schema;
mod sort;
mod splat_rows;
mod view_bytes;
mod view_painter;

pub use anisotropic::{AnisotropicBuffers, AnisotropicGradients, Gaussians, HarmonicOrder};
pub use anisotropic_ply::{PlyError, parse_anisotropic_ply, write_anisotropic_ply};
pub use anisotropic_splats::AnisotropicSplats;
pub use appearance::{
    AppearanceError, AppearanceSettings, DiffusionHierarchy, DiffusionLevel, DirectAppearance, ObservationBuffers,
    Observations, ViewInput,
};
pub use browser_kernels::BrowserKernels;
pub use buffers::{GaussianBuffers, RenderTarget};
pub use color::{composite_over, linear_from_srgb, rgba8_from_target, srgb_from_linear};
pub use color_match::ColorMatcher;
pub use color_means::ColorMeans;
pub use export::{ExportError, SH_DEGREE_0, Splat, read_splats, write_splat_ply};
pub use gradients::{Carry, GaussianGradients, ImageGradients};
pub use image_loss::{ImageLoss, ImageSums, LossSettings, UNKNOWN_RGBA, WantedImage};
pub use raster::Rasterizer;
pub use raster_backward::{BackwardError, BackwardRasterizer};
pub use raster_kernels::BACKFACING_COSINE;
pub use raster_settings::{Outputs, RasterSettings, RasterStats};
pub use schema::{ANISOTROPIC_ATTRIBUTES, GAUSSIAN_ATTRIBUTES, GaussianAttribute, GaussianElement, PLY_PROPERTIES};
pub use splat_rows::{PixelShares, PosedGaussians, pixel_shares};
pub use view_bytes::ViewBytes;
pub use view_painter::ViewPainter;
