//! Kernels for other hosts than this crate: the web page draws with them in browsers with WebGPU.

use std::mem::offset_of;

use crate::raster::buffers::{MIN_PAIRS, PAIRS_PER_GAUSSIAN, PAIRS_PER_TILE};
use crate::raster::kernels::{
    BINS_LANES, FrameConstants, Tile, bins_wgsl, blend_wgsl, project_anisotropic_wgsl, project_wgsl,
};
use crate::raster::settings::{Outputs, RasterSettings};
use crate::sort::radix::{BLOCK, DIGIT_BITS, KEY_BITS, sort_wgsl};
use crate::sort::scan::{SEGMENTS, scan_wgsl};

/// WGSL and constants for a host that draws colour and alpha of Gaussians as [`crate::Rasterizer`] does on a device:
/// isotropic ones, or anisotropic ones of one colour each, which the host passes to `blend` in place of the output of
/// `anisotropic/paint.wgsl`. Bindings and their order are those of `raster/device.rs`; no entry point binds more than 8
/// storage buffers.
#[derive(Debug, Clone)]
pub struct BrowserKernels {
    /// Name and WGSL of each module, and of `srgb`, a function for the host's own modules.
    pub modules: [(&'static str, String); 7],
    /// Name and value of the constants that the host needs: workgroup sizes, capacity for pairs, settings of the
    /// rendering.
    pub numbers: [(&'static str, f64); 11],
    /// Name and byte offset of the fields of an image's constants, and their size. The matrix of the camera is first.
    pub frame: [(&'static str, usize); 13],
}

impl BrowserKernels {
    /// Generates the kernels for GPUs.
    #[must_use]
    pub fn new() -> Self {
        let tile = Tile::HARDWARE;
        let settings = RasterSettings::default();
        Self {
            modules: [
                ("project", project_wgsl(tile)),
                ("projectAxes", project_anisotropic_wgsl(tile)),
                ("bins", bins_wgsl()),
                ("scan", scan_wgsl()),
                ("sort", sort_wgsl()),
                ("blend", blend_wgsl(tile, Outputs::COLOR)),
                ("srgb", flyrig_model::srgb::WGSL.to_owned()),
            ],
            numbers: [
                ("tile", tile.0.into()),
                ("binsLanes", BINS_LANES.into()),
                ("block", BLOCK as f64),
                ("digitBits", DIGIT_BITS.into()),
                ("keyBits", KEY_BITS.into()),
                ("segments", SEGMENTS.into()),
                ("pairsPerGaussian", PAIRS_PER_GAUSSIAN as f64),
                ("pairsPerTile", PAIRS_PER_TILE as f64),
                ("minPairs", MIN_PAIRS as f64),
                ("filterVariancePx2", settings.filter_variance_px2.into()),
                ("nearM", settings.near_m.into()),
            ],
            frame: [
                ("position", offset_of!(FrameConstants, camera.position)),
                ("focal", offset_of!(FrameConstants, camera.focal_px)),
                ("center", offset_of!(FrameConstants, camera.center_px)),
                ("cameraSize", offset_of!(FrameConstants, camera.size)),
                ("validRadius", offset_of!(FrameConstants, camera.valid_radius)),
                ("size", offset_of!(FrameConstants, size)),
                ("tiles", offset_of!(FrameConstants, tiles)),
                ("gaussians", offset_of!(FrameConstants, gaussians)),
                ("cullBackfacing", offset_of!(FrameConstants, cull_backfacing)),
                ("pairCapacity", offset_of!(FrameConstants, pair_capacity)),
                ("near", offset_of!(FrameConstants, near_m)),
                ("filterVariance", offset_of!(FrameConstants, filter_variance_px2)),
                ("bytes", size_of::<FrameConstants>()),
            ],
        }
    }
}

impl Default for BrowserKernels {
    fn default() -> Self {
        Self::new()
    }
}
