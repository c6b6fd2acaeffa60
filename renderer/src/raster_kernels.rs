//! Compiled kernels of the rasteriser and the numbers they are compiled with.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::{Pod, Zeroable};
use flyrig_gpu::{CAMERA_WGSL, CameraConstants, ComputeKernel, GpuContext};

use crate::Outputs;
use crate::schema::bindings_wgsl;
use crate::sort::{INVALID_KEY, SortShape};

pub(crate) const FRAME_WGSL: &str = include_str!("raster_frame.wgsl");
const PROJECT_WGSL: &str = include_str!("raster_project.wgsl");
const BINS_WGSL: &str = include_str!("raster_bins.wgsl");
const BLEND_WGSL: &str = include_str!("raster_blend.wgsl");

/// Alpha below which a splat does not touch a pixel.
pub(crate) const CUT: f64 = 1.0 / 255.0;
/// Largest alpha of one splat (Kerbl et al. 2023).
pub(crate) const MAX_ALPHA: f64 = 0.99;
/// Transmittance below which a pixel is finished.
pub(crate) const OPAQUE: f64 = 1e-4;

/// A Gaussian is back-facing when the cosine between its normal and the line of sight is above this. Not 0: a
/// Gaussian just behind the rim reaches out beyond it. On the built-in body with a dense front the mean error
/// falls from 0.015 at 0 to 0.002 at 0.35, for a quarter more Gaussians (tests/raster_culling.rs).
pub const BACKFACING_COSINE: f64 = 0.35;

/// How the work is cut for an adapter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RasterShape {
    /// Side of a tile, pixels; a multiple of the four rows that one invocation blends.
    pub tile: u32,
    /// Depth sort.
    pub sort: SortShape,
    /// Invocations that share the binning, at most.
    pub max_bin_chunks: u32,
    /// Elements of the tile table (tiles times chunks), as far as one chunk a tile allows.
    pub max_tile_table: u32,
}

impl RasterShape {
    /// Few invocations for a CPU in disguise: they only need to fill its vector lanes, and each costs a
    /// column of the tables.
    pub(crate) const SOFTWARE: Self = Self {
        tile: 8,
        sort: SortShape { chunks: 64, digit_bits: 8, digit_passes: 3 },
        max_bin_chunks: 32,
        max_tile_table: 1 << 21,
    };
    /// Enough invocations for a large GPU, small enough tables for an integrated one.
    pub(crate) const HARDWARE: Self = Self {
        tile: 16,
        sort: SortShape { chunks: 1024, digit_bits: 8, digit_passes: 3 },
        max_bin_chunks: 512,
        max_tile_table: 1 << 22,
    };

    pub(crate) fn for_adapter(gpu: &GpuContext) -> Self {
        if gpu.is_software() { Self::SOFTWARE } else { Self::HARDWARE }
    }

    pub(crate) fn wgsl(self) -> String {
        let tile = self.tile;
        format!(
            "const TILE: u32 = {tile}u;\nconst INVALID_KEY: u32 = {INVALID_KEY}u;\n\
             const BACKFACING_COSINE: f32 = {BACKFACING_COSINE};\nconst CUT: f32 = {CUT};\nconst MAX_ALPHA: f32 = {MAX_ALPHA};\nconst OPAQUE: f32 = {OPAQUE};\n"
        )
    }
}

/// Constants of one image, `struct Frame` in raster_frame.wgsl.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct Frame {
    pub camera: CameraConstants,
    pub size: [u32; 2],
    pub tiles: [u32; 2],
    pub gaussians: u32,
    pub cull_backfacing: u32,
    pub with_canonical: u32,
    pub pair_capacity: u32,
    pub near_m: f32,
    pub filter_variance_px2: f32,
    pub bin_chunks: u32,
    pub unused: u32,
    pub first_tile: [u32; 2],
    pub unused_too: [u32; 2],
}

pub(crate) fn project_wgsl(shape: RasterShape) -> String {
    [&shape.wgsl(), CAMERA_WGSL, FRAME_WGSL, &bindings_wgsl(1), PROJECT_WGSL].concat()
}

pub(crate) fn bins_wgsl() -> String {
    [CAMERA_WGSL, FRAME_WGSL, BINS_WGSL].concat()
}

/// The kernel that writes these outputs; at most two of them fit the bindings of one.
pub(crate) fn blend_wgsl(shape: RasterShape, outputs: Outputs) -> String {
    let Outputs { color, depth, canonical } = outputs;
    let mut kept = String::new();
    let mut keep = true;
    for line in BLEND_WGSL.lines() {
        match line.trim() {
            "// only color" => keep = color,
            "// only depth" => keep = depth,
            "// only canonical" => keep = canonical,
            "// end" => keep = true,
            _ if keep => kept.extend([line, "\n"]),
            _ => {}
        }
    }
    [&shape.wgsl(), CAMERA_WGSL, FRAME_WGSL, &kept].concat()
}

/// The outputs of each kernel that draws `outputs`, so that none binds more than 8 buffers.
pub(crate) fn blend_passes(outputs: Outputs) -> ([Outputs; 2], usize) {
    let surface = Outputs { depth: false, ..outputs };
    let depth = Outputs { color: false, canonical: false, ..outputs };
    if outputs == Outputs::ALL { ([surface, depth], 2) } else { ([outputs; 2], 1) }
}

#[derive(Debug)]
pub(crate) struct RasterKernels {
    pub shape: RasterShape,
    pub project: ComputeKernel,
    pub count_pairs: ComputeKernel,
    pub place_pairs: ComputeKernel,
    pub count_tiles: ComputeKernel,
    pub list_pairs: ComputeKernel,
    blend: Mutex<HashMap<Outputs, Arc<ComputeKernel>>>,
}

impl RasterKernels {
    pub(crate) fn new(gpu: &GpuContext, shape: RasterShape) -> Self {
        let bins = bins_wgsl();
        let bin_kernel = |entry| ComputeKernel::new(gpu, entry, &[&bins], entry);
        let kernels = Self {
            shape,
            project: ComputeKernel::new(gpu, "project", &[&project_wgsl(shape)], "project"),
            count_pairs: bin_kernel("count_pairs"),
            place_pairs: bin_kernel("place_pairs"),
            count_tiles: bin_kernel("count_tiles"),
            list_pairs: bin_kernel("list_pairs"),
            blend: Mutex::default(),
        };
        // What a live session draws; anything else is compiled with the first image that asks for it.
        for outputs in [Outputs::COLOR, Outputs::SURFACE] {
            kernels.blend(gpu, outputs);
        }
        kernels
    }

    /// The blending kernels that write these outputs, and what each of them writes; compiled on first use.
    pub(crate) fn blend(&self, gpu: &GpuContext, outputs: Outputs) -> Vec<(Outputs, Arc<ComputeKernel>)> {
        let (passes, count) = blend_passes(outputs);
        let mut kernels = self.blend.lock().unwrap_or_else(PoisonError::into_inner);
        let compile =
            |outputs| Arc::new(ComputeKernel::new(gpu, "blend", &[&blend_wgsl(self.shape, outputs)], "blend"));
        let kernel =
            |&outputs: &Outputs| (outputs, Arc::clone(kernels.entry(outputs).or_insert_with(|| compile(outputs))));
        passes[..count].iter().map(kernel).collect()
    }
}

#[cfg(test)]
#[path = "raster_shader_tests.rs"]
mod tests;
