//! Kernels for programs that draw with them through another host than this crate: the web page does in browsers with WebGPU.

use std::mem::offset_of;

use crate::raster_buffers::{MIN_PAIRS, PAIRS_PER_GAUSSIAN, PAIRS_PER_TILE};
use crate::raster_kernels::{BINS_LANES, Frame, Tile, bins_wgsl, blend_wgsl, project_anisotropic_wgsl, project_wgsl};
use crate::scan::{SEGMENTS, scan_wgsl};
use crate::sort::{BLOCK, DIGIT_BITS, KEY_BITS, sort_wgsl};
use crate::{Outputs, RasterSettings};

/// WGSL and numbers for a host that draws Gaussians as [`crate::Rasterizer`] does on a device, colour and alpha only: isotropic ones, or
/// anisotropic ones of one colour each, which the host hands to `blend` in place of what `raster_paint.wgsl` would write.
/// Bindings and their order are those of `raster_device.rs`; no entry point binds more than 8 storage buffers.
#[derive(Debug, Clone)]
pub struct BrowserKernels {
    /// Name and WGSL of each module, and of `srgb`, a function for the host's own modules.
    pub modules: [(&'static str, String); 7],
    /// Name and value of the numbers that the host needs: workgroup sizes, room for pairs, settings of the drawing.
    pub numbers: [(&'static str, f64); 11],
    /// Name and byte offset of the fields of an image's constants, and their size. The matrix of the camera is first.
    pub frame: [(&'static str, usize); 13],
}

impl BrowserKernels {
    /// Returns the kernels for graphics processors.
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
                ("position", offset_of!(Frame, camera.position)),
                ("focal", offset_of!(Frame, camera.focal_px)),
                ("center", offset_of!(Frame, camera.center_px)),
                ("cameraSize", offset_of!(Frame, camera.size)),
                ("validRadius", offset_of!(Frame, camera.valid_radius)),
                ("size", offset_of!(Frame, size)),
                ("tiles", offset_of!(Frame, tiles)),
                ("gaussians", offset_of!(Frame, gaussians)),
                ("cullBackfacing", offset_of!(Frame, cull_backfacing)),
                ("pairCapacity", offset_of!(Frame, pair_capacity)),
                ("near", offset_of!(Frame, near_m)),
                ("filterVariance", offset_of!(Frame, filter_variance_px2)),
                ("bytes", size_of::<Frame>()),
            ],
        }
    }
}

impl Default for BrowserKernels {
    fn default() -> Self {
        Self::new()
    }
}
