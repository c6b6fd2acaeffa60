//! WGSL of the backward rasteriser's kernels and its compile-time constants.

use flyrig_gpu::CAMERA_WGSL;

use crate::anisotropic::order::HarmonicOrder;
use crate::raster::kernels::{AXES_WGSL, BUSY_WGSL, FRAME_WGSL, Tile, harmonics_wgsl, of_kind};
use crate::schema::{CENTER, HARMONICS, ROTATION, SCALE_OPACITY, bindings_wgsl, derivatives_wgsl};

const BACKWARD_FRAME_WGSL: &str = include_str!("frame.wgsl");
const PLACES_WGSL: &str = include_str!("places.wgsl");
const BLEND_WGSL: &str = include_str!("blend.wgsl");
const PROJECT_WGSL: &str = include_str!("project.wgsl");
const SUMS_WGSL: &str = include_str!("sums.wgsl");
const PAINT_WGSL: &str = include_str!("../anisotropic/paint_backward.wgsl");

/// Bytes of `struct PairSum`.
pub(crate) const PAIR_SUM_BYTES: u64 = 48;
/// Largest number of pairs that one tile's invocations walk over. Each pair costs about two iterations, and Mesa's
/// software adapter silently ends an invocation after 65,535 iterations of all its loops.
const MAX_LIST: u32 = 24_576;
/// Largest number of tiles whose sums are added for one Gaussian, for the same reason.
const MAX_TILES: u32 = 60_000;
/// Bytes of workgroup memory for partial sums; WebGPU guarantees 16 KiB.
const PARTIAL_BYTES: u32 = 12 << 10;

pub(crate) fn places_wgsl() -> String {
    let constants = format!("const MAX_TILES: u32 = {MAX_TILES}u;\n");
    [&constants, CAMERA_WGSL, FRAME_WGSL, BACKWARD_FRAME_WGSL, PLACES_WGSL].concat()
}

/// Returns the WGSL of the blending's derivative. With `carry_color`, pixels carry their dL/d colour to the Gaussians.
pub(crate) fn blend_wgsl(tile: Tile, with_depth: bool, carry_color: bool) -> String {
    let invocations = tile.0 * tile.0 / 4;
    let batch = PARTIAL_BYTES / (invocations * PAIR_SUM_BYTES as u32);
    let constants = format!(
        "{}const WITH_DEPTH: bool = {with_depth};\nconst CARRY_COLOR: bool = {carry_color};\nconst BATCH: u32 = {batch}u;\n\
         const MAX_LIST: u32 = {MAX_LIST}u;\n",
        tile.wgsl()
    );
    [&constants, CAMERA_WGSL, FRAME_WGSL, BUSY_WGSL, BACKWARD_FRAME_WGSL, BLEND_WGSL].concat()
}

pub(crate) fn project_wgsl(lift: bool) -> String {
    let constants = format!("const LIFT: bool = {lift};\n");
    let project = of_kind(PROJECT_WGSL, false);
    [&constants, CAMERA_WGSL, FRAME_WGSL, BACKWARD_FRAME_WGSL, &project].concat()
}

pub(crate) fn sums_wgsl() -> String {
    [CAMERA_WGSL, FRAME_WGSL, BACKWARD_FRAME_WGSL, SUMS_WGSL].concat()
}

pub(crate) fn project_anisotropic_wgsl() -> String {
    let attributes = [CENTER, SCALE_OPACITY, ROTATION];
    let bindings = [bindings_wgsl(2, &attributes), derivatives_wgsl(5, &attributes)].concat();
    let project = of_kind(PROJECT_WGSL, true);
    [CAMERA_WGSL, FRAME_WGSL, BACKWARD_FRAME_WGSL, &bindings, AXES_WGSL, &project].concat()
}

pub(crate) fn paint_wgsl(order: HarmonicOrder) -> String {
    let attributes = [CENTER, HARMONICS];
    let bindings = [bindings_wgsl(1, &attributes), derivatives_wgsl(4, &attributes)].concat();
    [CAMERA_WGSL, FRAME_WGSL, BACKWARD_FRAME_WGSL, &bindings, &harmonics_wgsl(order), PAINT_WGSL].concat()
}
