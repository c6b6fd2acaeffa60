//! WGSL of the backward rasteriser's kernels and its compile-time constants.

use flyrig_gpu::CAMERA_WGSL;

use crate::anisotropic::order::HarmonicOrder;
use crate::raster::kernels::{AXES_WGSL, BUSY_WGSL, FRAME_WGSL, Tile, harmonics_wgsl, of_kind, plane_wgsl, sections};
use crate::schema::{CENTER, HARMONICS, ROTATION, SCALE_OPACITY, bindings_wgsl, derivatives_wgsl};

const BACKWARD_FRAME_WGSL: &str = include_str!("frame.wgsl");
const PLACES_WGSL: &str = include_str!("places.wgsl");
const BLEND_WGSL: &str = include_str!("blend.wgsl");
const PROJECT_WGSL: &str = include_str!("project.wgsl");
const PLANES_WGSL: &str = include_str!("planes.wgsl");
const SUMS_WGSL: &str = include_str!("sums.wgsl");
const PAINT_WGSL: &str = include_str!("../anisotropic/paint_backward.wgsl");

/// Returns the number of vectors of four floats in `struct PairSum`.
pub(crate) const fn vectors(planes: bool) -> usize {
    if planes { 5 } else { 3 }
}

/// Bytes of a vector of four floats.
pub(crate) const VECTOR_BYTES: u64 = 16;
/// Largest number of pairs that one tile's invocations walk over. Each pair costs about two iterations, and Mesa's
/// software adapter silently ends an invocation after 65,535 iterations of all its loops.
const MAX_LIST: u32 = 24_576;
/// Largest number of tiles whose sums are added for one Gaussian, for the same reason.
const MAX_TILES: u32 = 60_000;
/// Bytes of workgroup memory for partial sums; WebGPU guarantees 16 KiB.
const PARTIAL_BYTES: u32 = 12 << 10;

pub(crate) fn places_wgsl() -> String {
    let constants = format!("const MAX_TILES: u32 = {MAX_TILES}u;\n");
    [&constants, CAMERA_WGSL, FRAME_WGSL, &frame_wgsl(false), PLACES_WGSL].concat()
}

/// Returns the WGSL of the sums' layout.
fn frame_wgsl(planes: bool) -> String {
    [&format!("const VECTORS: u32 = {}u;\n", vectors(planes)), BACKWARD_FRAME_WGSL].concat()
}

/// Returns the sections of images with or without planes.
fn with_planes(source: &str, planes: bool) -> String {
    sections(source, |name| (name == "planes") == planes)
}

/// Depths that an image has derivatives by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Depths {
    /// None.
    None,
    /// Depths of the centres.
    Centers,
    /// Depths of the planes, and normals.
    Planes,
}

/// Returns the WGSL of the blending's derivative. With `carry_color`, pixels carry their dL/d colour to the Gaussians.
pub(crate) fn blend_wgsl(tile: Tile, depths: Depths, carry_color: bool) -> String {
    let (with_depth, planes) = (depths == Depths::Centers, depths == Depths::Planes);
    let invocations = tile.0 * tile.0 / 4;
    let fitting = PARTIAL_BYTES / (invocations * (vectors(planes) as u64 * VECTOR_BYTES) as u32);
    // A power of two, so that the splats that are loaded together are a multiple.
    let batch = 1 << fitting.ilog2();
    let constants = format!(
        "{}const WITH_DEPTH: bool = {with_depth};\nconst CARRY_COLOR: bool = {carry_color};\nconst BATCH: u32 = {batch}u;\n\
         const MAX_LIST: u32 = {MAX_LIST}u;\n",
        tile.wgsl()
    );
    let (plane, blend) = (if planes { plane_wgsl() } else { String::new() }, with_planes(BLEND_WGSL, planes));
    [&constants, CAMERA_WGSL, FRAME_WGSL, BUSY_WGSL, &frame_wgsl(planes), &plane, &blend].concat()
}

pub(crate) fn project_wgsl(lift: bool) -> String {
    let constants = format!("const LIFT: bool = {lift};\n");
    let project = of_kind(PROJECT_WGSL, false);
    [&constants, CAMERA_WGSL, FRAME_WGSL, &frame_wgsl(false), &project].concat()
}

pub(crate) fn sums_wgsl(planes: bool) -> String {
    [CAMERA_WGSL, FRAME_WGSL, &frame_wgsl(planes), &with_planes(SUMS_WGSL, planes)].concat()
}

pub(crate) fn project_anisotropic_wgsl(planes: bool) -> String {
    let attributes = [CENTER, SCALE_OPACITY, ROTATION];
    let bindings = [bindings_wgsl(2, &attributes), derivatives_wgsl(5, &attributes)].concat();
    let project = sections(PROJECT_WGSL, |name| name == "anisotropic" || (planes && name == "planes"));
    let plane = if planes { [&plane_wgsl(), PLANES_WGSL].concat() } else { String::new() };
    [CAMERA_WGSL, FRAME_WGSL, &frame_wgsl(planes), &bindings, AXES_WGSL, &plane, &project].concat()
}

pub(crate) fn paint_wgsl(order: HarmonicOrder, planes: bool) -> String {
    let attributes = [CENTER, HARMONICS];
    let bindings = [bindings_wgsl(1, &attributes), derivatives_wgsl(4, &attributes)].concat();
    [CAMERA_WGSL, FRAME_WGSL, &frame_wgsl(planes), &bindings, &harmonics_wgsl(order), PAINT_WGSL].concat()
}
