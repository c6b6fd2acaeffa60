//! Compiled kernels of the rasteriser and their compile-time constants.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock};

use flyrig_types::lock;

use bytemuck::{Pod, Zeroable};
use flyrig_gpu::{CAMERA_WGSL, CameraConstants, ComputeKernel, GpuContext};

use crate::anisotropic::order::HarmonicOrder;
use crate::raster::settings::Outputs;
use crate::schema::{CENTER, GAUSSIAN_ATTRIBUTES, HARMONICS, NORMAL, ROTATION, SCALE_OPACITY, bindings_wgsl};
use crate::sort::radix::{BLOCK, DIGIT_BITS, INVALID_KEY};

pub(crate) const FRAME_WGSL: &str = include_str!("frame.wgsl");
const PROJECT_WGSL: &str = include_str!("project.wgsl");
const BINS_WGSL: &str = include_str!("bins.wgsl");
pub(crate) const BUSY_WGSL: &str = include_str!("busy.wgsl");
const BLEND_WGSL: &str = include_str!("blend.wgsl");
pub(crate) const AXES_WGSL: &str = include_str!("../anisotropic/axes.wgsl");
const PLANE_WGSL: &str = include_str!("../anisotropic/plane.wgsl");
const PLANES_WGSL: &str = include_str!("planes.wgsl");
const HARMONICS_WGSL: &str = include_str!("../anisotropic/harmonics.wgsl");
const PAINT_WGSL: &str = include_str!("../anisotropic/paint.wgsl");

/// Invocations of a workgroup of bins.wgsl.
pub(crate) const BINS_LANES: u32 = 256;

/// Alpha below which a splat does not touch a pixel.
pub(crate) const CUT: f64 = 1.0 / 255.0;
/// Largest alpha of one splat (Kerbl et al. 2023).
pub(crate) const MAX_ALPHA: f64 = 0.99;
/// Transmittance below which a pixel is finished.
pub(crate) const OPAQUE: f64 = 1e-4;

/// Cosine between normal and line of sight above which a Gaussian is back-facing. Not 0: a Gaussian just behind the
/// silhouette reaches out beyond it. On the built-in body with a dense front the mean error falls from 0.015 at 0 to
/// 0.002 at 0.35, for a quarter more Gaussians (tests/raster_culling.rs).
pub const BACKFACING_COSINE: f64 = 0.35;

/// Cosine between normal and line of sight above which an anisotropic Gaussian is back-facing. Its opacity is below 1, so
/// that the far side of a body would show through the near one. Lower values cut the silhouette, where fitted Gaussians
/// are rounder than the mesh: 0.35 costs 0.09 dB on d1 (docs/benchmarks/avatar.md).
pub const AWAY_COSINE: f64 = 0.7;

/// Standard deviations along camera z that a plane's depth keeps to, about the depth of the centre.
pub(crate) const REACH: f32 = 3.0;
/// Largest distance of a plane's depth from that of the centre, as a share of the latter.
pub(crate) const MOST_REACH: f32 = 0.9;
/// Least product of a plane's unit normal and the ray through the Gaussian's centre with z = 1: a plane closer to edge-on than this
/// (0.6 degrees) has the depths of one at this angle.
pub(crate) const LEAST_COSINE: f32 = 0.01;

/// Side of a tile, pixels; a multiple of the four rows that one invocation blends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Tile(pub u32);

impl Tile {
    /// Tile of a software adapter, which need not fill more than its vector lanes.
    pub(crate) const SOFTWARE: Self = Self(8);
    /// Tile of a GPU.
    pub(crate) const HARDWARE: Self = Self(16);

    pub(crate) fn for_adapter(gpu: &GpuContext) -> Self {
        if gpu.is_software() { Self::SOFTWARE } else { Self::HARDWARE }
    }

    pub(crate) fn wgsl(self) -> String {
        let Self(tile) = self;
        format!(
            "const TILE: u32 = {tile}u;\nconst INVALID_KEY: u32 = {INVALID_KEY}u;\n\
             const BACKFACING_COSINE: f32 = {BACKFACING_COSINE};\nconst AWAY_COSINE: f32 = {AWAY_COSINE};\nconst CUT: f32 = {CUT};\nconst MAX_ALPHA: f32 = {MAX_ALPHA};\nconst OPAQUE: f32 = {OPAQUE};\n"
        )
    }
}

/// Constants of one image, `struct Frame` in frame.wgsl.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct FrameConstants {
    pub camera: CameraConstants,
    pub size: [u32; 2],
    pub tiles: [u32; 2],
    pub gaussians: u32,
    pub cull_backfacing: u32,
    pub with_canonical: u32,
    pub pair_capacity: u32,
    pub near_m: f32,
    pub filter_variance_px2: f32,
    pub filter_keeps_opacity: u32,
    pub unused: u32,
    pub first_tile: [u32; 2],
    pub unused_too: [u32; 2],
}

pub(crate) fn project_wgsl(tile: Tile) -> String {
    let attributes = bindings_wgsl(1, &GAUSSIAN_ATTRIBUTES);
    [&tile.wgsl(), CAMERA_WGSL, FRAME_WGSL, &attributes, &of_kind(PROJECT_WGSL, false)].concat()
}

pub(crate) fn project_anisotropic_wgsl(tile: Tile) -> String {
    let attributes = bindings_wgsl(1, &[CENTER, SCALE_OPACITY, ROTATION, NORMAL]);
    [&tile.wgsl(), CAMERA_WGSL, FRAME_WGSL, &attributes, AXES_WGSL, &of_kind(PROJECT_WGSL, true)].concat()
}

/// Returns the WGSL that colours anisotropic Gaussians.
pub(crate) fn paint_wgsl(order: HarmonicOrder) -> String {
    let constants = format!("const INVALID_KEY: u32 = {INVALID_KEY}u;\n");
    let attributes = bindings_wgsl(1, &[CENTER, HARMONICS]);
    [&constants, CAMERA_WGSL, FRAME_WGSL, &attributes, &harmonics_wgsl(order), PAINT_WGSL].concat()
}

/// Returns the WGSL of colours by direction and their derivatives.
pub(crate) fn harmonics_wgsl(order: HarmonicOrder) -> String {
    let coefficients = order.coefficients();
    [&format!("const COEFFICIENTS: u32 = {coefficients}u;\n"), HARMONICS_WGSL].concat()
}

pub(crate) fn bins_wgsl() -> String {
    let constants = format!(
        "const LANES: u32 = {BINS_LANES}u;\nconst BLOCK: u32 = {BLOCK}u;\nconst DIGIT_BITS: u32 = {DIGIT_BITS}u;\n"
    );
    [&constants, CAMERA_WGSL, FRAME_WGSL, BINS_WGSL].concat()
}

/// Returns the WGSL that blends these outputs; at most two of them fit the bindings of one kernel ([`blend_passes`]).
pub(crate) fn blend_wgsl(tile: Tile, outputs: Outputs) -> String {
    let Outputs { color, depth, canonical, planes } = outputs;
    let of_outputs = sections(BLEND_WGSL, |name| match name {
        "color" => color,
        "depth" => depth,
        "planes" => planes,
        _ => canonical,
    });
    let plane = if planes { plane_wgsl() } else { String::new() };
    [&tile.wgsl(), CAMERA_WGSL, FRAME_WGSL, BUSY_WGSL, &plane, &of_outputs].concat()
}

/// Returns the WGSL of the planes of anisotropic Gaussians.
pub(crate) fn plane_wgsl() -> String {
    let constants = format!(
        "const LEAST_COSINE: f32 = {LEAST_COSINE};\nconst REACH: f32 = {REACH};\nconst MOST_REACH: f32 = {MOST_REACH};\n"
    );
    [&constants, PLANE_WGSL].concat()
}

/// Returns the WGSL that computes the planes of an image.
pub(crate) fn planes_wgsl() -> String {
    let constants = format!("const INVALID_KEY: u32 = {INVALID_KEY}u;\n");
    let attributes = bindings_wgsl(1, &[CENTER, SCALE_OPACITY, ROTATION]);
    [&constants, CAMERA_WGSL, FRAME_WGSL, &attributes, AXES_WGSL, &plane_wgsl(), PLANES_WGSL].concat()
}

/// Returns the WGSL without the lines between `// only NAME` and `// end` whose name `keeps` rejects.
pub(crate) fn sections(source: &str, keeps: impl Fn(&str) -> bool) -> String {
    let mut kept = String::new();
    let mut keep = true;
    for line in source.lines() {
        match (line.trim(), line.trim().strip_prefix("// only ")) {
            ("// end", _) => keep = true,
            (_, Some(name)) => keep = keeps(name),
            _ if keep => kept.extend([line, "\n"]),
            _ => {}
        }
    }
    kept
}

/// Returns the sections for one kind of Gaussians, without those of planes.
pub(crate) fn of_kind(source: &str, is_anisotropic: bool) -> String {
    sections(source, |name| name == if is_anisotropic { "anisotropic" } else { "isotropic" })
}

/// No image.
const NOTHING: Outputs = Outputs { color: false, depth: false, canonical: false, planes: false };

/// Splits `outputs` over kernels that bind at most 8 buffers each; returns their outputs and their number.
pub(crate) fn blend_passes(outputs: Outputs) -> ([Outputs; 2], usize) {
    if outputs.planes {
        let first = Outputs { color: outputs.color, planes: true, ..NOTHING };
        let rest = Outputs { color: false, planes: false, ..outputs };
        return ([first, rest], if rest == NOTHING { 1 } else { 2 });
    }
    let surface = Outputs { depth: false, ..outputs };
    let depth = Outputs { color: false, canonical: false, ..outputs };
    if outputs == Outputs::ALL { ([surface, depth], 2) } else { ([outputs; 2], 1) }
}

#[derive(Debug)]
pub(crate) struct RasterKernels {
    pub tile: Tile,
    pub project: ComputeKernel,
    pub count_pairs: ComputeKernel,
    pub keep_pairs: ComputeKernel,
    pub write_pairs: ComputeKernel,
    pub end_lists: ComputeKernel,
    blend: Mutex<HashMap<Outputs, Arc<ComputeKernel>>>,
    project_anisotropic: OnceLock<ComputeKernel>,
    planes: OnceLock<ComputeKernel>,
    /// One kernel per harmonic order.
    paint: [OnceLock<ComputeKernel>; 3],
}

impl RasterKernels {
    pub(crate) fn new(gpu: &GpuContext, tile: Tile) -> Self {
        let bins = bins_wgsl();
        let bin_kernel = |entry| ComputeKernel::new(gpu, entry, &[&bins], entry);
        let kernels = Self {
            tile,
            project: ComputeKernel::new(gpu, "project", &[&project_wgsl(tile)], "project"),
            count_pairs: bin_kernel("count_pairs"),
            keep_pairs: bin_kernel("keep_pairs"),
            write_pairs: bin_kernel("write_pairs"),
            end_lists: bin_kernel("end_lists"),
            blend: Mutex::default(),
            project_anisotropic: OnceLock::new(),
            planes: OnceLock::new(),
            paint: Default::default(),
        };
        // What a live session draws; anything else is compiled with the first image that asks for it.
        for outputs in [Outputs::COLOR, Outputs::SURFACE] {
            kernels.blend(gpu, outputs);
        }
        kernels
    }

    /// Returns the blending kernels for these outputs with the outputs of each; compiles them on first use.
    pub(crate) fn blend(&self, gpu: &GpuContext, outputs: Outputs) -> Vec<(Outputs, Arc<ComputeKernel>)> {
        let (passes, count) = blend_passes(outputs);
        let mut kernels = lock(&self.blend);
        let compile = |outputs| Arc::new(ComputeKernel::new(gpu, "blend", &[&blend_wgsl(self.tile, outputs)], "blend"));
        let kernel =
            |&outputs: &Outputs| (outputs, Arc::clone(kernels.entry(outputs).or_insert_with(|| compile(outputs))));
        passes[..count].iter().map(kernel).collect()
    }

    /// Returns the kernel that projects anisotropic Gaussians; compiles it on first use.
    pub(crate) fn project_anisotropic(&self, gpu: &GpuContext) -> &ComputeKernel {
        let compile = || ComputeKernel::new(gpu, "project", &[&project_anisotropic_wgsl(self.tile)], "project");
        self.project_anisotropic.get_or_init(compile)
    }

    /// Returns the kernel that computes planes; compiles it on first use.
    pub(crate) fn planes(&self, gpu: &GpuContext) -> &ComputeKernel {
        self.planes.get_or_init(|| ComputeKernel::new(gpu, "planes", &[&planes_wgsl()], "place_planes"))
    }

    /// Returns the kernel that colours anisotropic Gaussians; compiles it on first use.
    pub(crate) fn paint(&self, gpu: &GpuContext, order: HarmonicOrder) -> &ComputeKernel {
        self.paint[order as usize].get_or_init(|| ComputeKernel::new(gpu, "paint", &[&paint_wgsl(order)], "paint"))
    }
}

#[cfg(test)]
#[path = "shader_tests.rs"]
mod tests;
