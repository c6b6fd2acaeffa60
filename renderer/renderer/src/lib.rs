//! Gaussians to images and back: forward and backward rasteriser, direct appearance, image loss, splat files.
//!
//! Every kernel exists twice: as WGSL for a device and as a native twin (`processor.rs` or `processor/` beside it), which computes
//! while it is recorded. A [`GpuContext`](flyrig_gpu::GpuContext) decides which one runs; callers do not notice, provided that they record
//! copies and clears through [`StorageBuffer`](flyrig_gpu::StorageBuffer) and never through its raw buffer. Tests run both against one f64
//! reference.
//!
//! - `raster`, `backward`, `anisotropic`: the rasteriser, its derivative, and Gaussians of three scales with colours by direction, their
//!   normals and the depths on their planes.
//! - `sort`: radix sort and prefix sum on the device.
//! - `appearance`: colours from the images of an instant. `image_loss`: comparison of images for the deformation.
//! - `files`: PLY files. `browser_kernels`: the WGSL for pages with WebGPU.
//!
//! Equal input gives equal bytes on one device: no kernel uses atomics on floats, and every sum has a fixed order.

mod anisotropic;
mod appearance;
mod backward;
mod browser_kernels;
mod buffers;
mod color;
mod color_match;
mod constants;
mod files;
mod image_loss;
mod pixel_plane;
mod raster;
mod schema;
mod sort;
mod splat_rows;
mod splats;
mod view_bytes;
mod view_painter;

pub use anisotropic::buffers::{AnisotropicBuffers, AnisotropicGradients, Gaussians, SurfaceBuffers};
pub use anisotropic::join::GaussianJoin;
pub use anisotropic::order::HarmonicOrder;
pub use anisotropic::recolor::{Corrected, Recolor};
pub use anisotropic::splats::AnisotropicSplats;
pub use appearance::color_means::ColorMeans;
pub use appearance::hierarchy::{DiffusionHierarchy, DiffusionLevel};
pub use appearance::settings::{AppearanceError, AppearanceSettings, Observations, ViewInput};
pub use appearance::update::DirectAppearance;
pub use backward::error::BackwardError;
pub use backward::gradients::{Carry, GaussianGradients, ImageGradients};
pub use backward::rasterizer::BackwardRasterizer;
pub use browser_kernels::BrowserKernels;
pub use buffers::{GaussianBuffers, RenderTarget};
pub use color::{composite_over, linear_from_srgb, rgba8_from_target, srgb_from_linear};
pub use color_match::ColorMatcher;
pub use files::anisotropic_ply::write_anisotropic_ply;
pub use files::ply::{ExportError, SH_DEGREE_0};
pub use files::ply_error::PlyError;
pub use files::splat_file::{SplatFile, SplatFilter};
pub use image_loss::loss::{ImageLoss, ImageSums, WantedImage};
pub use image_loss::settings::{LossSettings, UNKNOWN_RGBA};
pub use pixel_plane::PixelPlane;
pub use raster::kernels::{AWAY_COSINE, BACKFACING_COSINE};
pub use raster::rasterizer::Rasterizer;
pub use raster::settings::{Outputs, RasterSettings, RasterStats};
pub use schema::{ANISOTROPIC_ATTRIBUTES, GAUSSIAN_ATTRIBUTES, GaussianAttribute, GaussianElement, PLY_PROPERTIES};
pub use splat_rows::{PixelShares, PosedGaussians, pixel_shares};
pub use splats::{Splat, read_splats};
pub use view_bytes::ViewBytes;
pub use view_painter::ViewPainter;
