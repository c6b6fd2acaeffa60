//! Backward rasteriser on the processor: `backward/blend.wgsl` and the sums per Gaussian.

#![allow(clippy::needless_range_loop)] // one index for several lanes is what compilers turn into vectors

mod project;

use glam::{Vec3, Vec4};
use rayon::prelude::*;

use crate::anisotropic::buffers::{AnisotropicBuffers, AnisotropicGradients};
use crate::anisotropic::harmonics::Harmonics;
use crate::backward::gradients::{Carry, GaussianGradients, ImageGradients};
use crate::backward::processor::project::{PairSum, add_anisotropic, add_isotropic};
use crate::backward::target::GradientTarget;
use crate::buffers::{GaussianBuffers, RenderTarget};
use crate::raster::kernels::{MAX_ALPHA, OPAQUE};
use crate::raster::processor::blend::{LOG2_CUT, TileLanes, exponents, is_opaque, rows_of};
use crate::raster::processor::lanes::{LANES, Lanes, exp2, sums as sums_of_lanes};
use crate::raster::processor::project::{ProjectedSplat, TILE};
use crate::raster::processor::rasterizer::{ProcessorRasterizer, RasterImage};
use crate::raster::processor::shape::Shape;

const ROWS: usize = TILE as usize;
/// Index of the sum of weights in [`PairSum`].
const WEIGHT: usize = 7;
/// Gaussians per task of the projection's derivative.
const CHUNK: usize = 1024;

/// [`BackwardRasterizer`](crate::BackwardRasterizer) on the processor. The next image reuses its arrays.
#[derive(Debug, Default)]
pub(crate) struct ProcessorBackward {
    /// Sum per list entry; valid for blended tiles.
    pair_sums: Vec<PairSum>,
    /// Number of pairs walked per tile.
    walked: Vec<u32>,
    /// Sum per Gaussian.
    sums: Vec<PairSum>,
    is_touched: Vec<bool>,
}

impl ProcessorBackward {
    /// Adds the derivatives of the image that `rasterizer` rendered last. The caller has checked the arrays.
    pub(crate) fn add(
        &mut self,
        rasterizer: &ProcessorRasterizer,
        target: &RenderTarget,
        incoming: &ImageGradients,
        to: GradientTarget<'_>,
    ) {
        let Some(rendered) = &rasterizer.latest else { return };
        match to {
            GradientTarget::Isotropic { gaussians, carry, out } => {
                let Some(color) = gaussians.color.slice() else { return };
                if self.sum(rasterizer, (target, incoming, false), &color).is_some() {
                    self.add_isotropic(rendered, gaussians, carry, out);
                }
            }
            GradientTarget::Anisotropic { gaussians, out } => {
                if self.sum(rasterizer, (target, incoming, true), &rasterizer.lists.painted).is_some() {
                    self.add_anisotropic(rendered, gaussians, out);
                }
            }
        }
    }

    /// Sums over the pixels of the image for each Gaussian. With `carries_color`, pixels carry their dL/d colour.
    fn sum(
        &mut self,
        rasterizer: &ProcessorRasterizer,
        (target, incoming, carries_color): (&RenderTarget, &ImageGradients, bool),
        color: &[[f32; 4]],
    ) -> Option<()> {
        let ProcessorRasterizer { lists, latest: Some(rendered), .. } = rasterizer else { return None };
        let (drawn_color, drawn_depth) = (target.color.slice()?, target.depth.slice()?);
        let (d_color, d_depth) = (incoming.color.slice()?, incoming.depth_carry.slice()?);
        let pixels = Pixels {
            size: rendered.size.map(|side| side as usize),
            color: &drawn_color,
            depth: rendered.settings.outputs.depth.then_some(&drawn_depth),
            d_color: &d_color,
            d_depth: &d_depth,
            carries_color,
        };
        self.pair_sums.resize(lists.pairs.len(), [0.0; 11]);
        self.walked.clear();
        self.walked.resize(lists.starts.len().saturating_sub(1), 0);
        // The part of the sums that belongs to each row of tiles.
        let mut rest = self.pair_sums.as_mut_slice();
        let columns = lists.tiles[0] as usize;
        let mut bands = Vec::with_capacity(lists.tiles[1] as usize);
        for (row, walked) in self.walked.chunks_mut(columns.max(1)).enumerate() {
            let first = lists.starts[row * columns];
            let (part, others) = rest.split_at_mut((lists.starts[(row + 1) * columns] - first) as usize);
            bands.push((row, first as usize, part, walked));
            rest = others;
        }
        let within = |first: u32, count: u32, at: usize| (first as usize..(first + count) as usize).contains(&at);
        bands.into_par_iter().filter(|(row, ..)| within(rendered.first_tile[1], rendered.blended[1], *row)).for_each(
            |(row, first, part, walked)| {
                for (column, walked) in walked.iter_mut().enumerate() {
                    if !within(rendered.first_tile[0], rendered.blended[0], column) {
                        continue;
                    }
                    let Some(state) = pixels.state(column, row) else { continue };
                    let range = lists.range(row * columns + column);
                    let (origin, list) = ([(column * LANES) as f32, (row * ROWS) as f32], &lists.pairs[range.clone()]);
                    let (splats, out) = (&lists.splats[..], &mut part[range.start - first..range.end - first]);
                    *walked = if pixels.only_colors() {
                        flyrig_types::vectorized(TileBackward::<true> { state, origin, list, splats, color, out })
                    } else {
                        flyrig_types::vectorized(TileBackward::<false> { state, origin, list, splats, color, out })
                    };
                }
            },
        );
        self.sums.clear();
        self.sums.resize(rendered.gaussians, [0.0; 11]);
        self.is_touched.clear();
        self.is_touched.resize(rendered.gaussians, false);
        for (tile, &walked) in self.walked.iter().enumerate().filter(|(_, walked)| **walked > 0) {
            let range = lists.range(tile);
            let range = range.start..range.start + walked as usize;
            let pairs = lists.pairs[range.clone()].iter().zip(&self.pair_sums[range]);
            // Without weight in any pixel all sums are 0.
            for (&gaussian, more) in pairs.filter(|(_, sums)| sums[WEIGHT] != 0.0) {
                let (sums, is_touched) = (&mut self.sums[gaussian as usize], &mut self.is_touched[gaussian as usize]);
                sums.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
                *is_touched = true;
            }
        }
        Some(())
    }

    /// Carries the sums to isotropic Gaussians.
    fn add_isotropic(
        &self,
        rendered: &RasterImage,
        gaussians: &GaussianBuffers,
        carry: Carry,
        out: &GaussianGradients,
    ) {
        let Some(center_scale) = gaussians.center_scale.slice() else { return };
        let (Some(mut center), Some(mut carried)) = (out.center.slice_mut(), out.carried.slice_mut()) else { return };
        let outs = center.par_chunks_mut(CHUNK).zip(carried.par_chunks_mut(2 * CHUNK));
        let ins = self.sums.par_chunks(CHUNK).zip(self.is_touched.par_chunks(CHUNK));
        outs.zip(ins).zip(center_scale.par_chunks(CHUNK)).for_each(
            |(((center, carried), (sums, is_touched)), center_scale)| {
                let gaussians = center.iter_mut().zip(carried.chunks_exact_mut(2)).zip(sums).zip(center_scale);
                for (((center, carried), sums), center_scale) in
                    gaussians.zip(is_touched).filter(|(_, is_touched)| **is_touched).map(|(one, _)| one)
                {
                    add_isotropic(rendered, sums, center_scale, carry, center, carried);
                }
            },
        );
    }

    /// Carries the sums to anisotropic Gaussians.
    fn add_anisotropic(&self, rendered: &RasterImage, gaussians: &AnisotropicBuffers, out: &AnisotropicGradients) {
        let slices = gaussians.attributes().map(flyrig_gpu::StorageBuffer::slice);
        let [Some(center), Some(scale_opacity), Some(rotation), Some(harmonics)] = &slices else { return };
        let slices = out.attributes().map(flyrig_gpu::StorageBuffer::slice_mut);
        let [Some(mut center_out), Some(mut scale_out), Some(mut rotation_out), Some(mut harmonics_out)] = slices
        else {
            return;
        };
        let coefficients = gaussians.order().coefficients();
        let colors = Harmonics { center, harmonics, coefficients, eye: rendered.camera.center() };
        let shapes = center_out.par_chunks_mut(CHUNK).zip(scale_out.par_chunks_mut(CHUNK));
        let outs =
            shapes.zip(rotation_out.par_chunks_mut(CHUNK)).zip(harmonics_out.par_chunks_mut(CHUNK * coefficients));
        let ins = self.sums.par_chunks(CHUNK).zip(self.is_touched.par_chunks(CHUNK));
        outs.zip(ins).enumerate().for_each(
            |(chunk, ((((center_out, scale_out), rotation_out), harmonics_out), ins))| {
                flyrig_types::vectorized(CarryChunk {
                    rendered,
                    first: chunk * CHUNK,
                    ins,
                    scale_opacity: &scale_opacity[..],
                    rotation: &rotation[..],
                    colors,
                    outs: [center_out, scale_out, rotation_out],
                    harmonics_out,
                });
            },
        );
    }
}

/// Sums of a chunk of anisotropic Gaussians, to be carried to their attributes.
struct CarryChunk<'a> {
    rendered: &'a RasterImage,
    /// Index of the chunk's first Gaussian.
    first: usize,
    ins: (&'a [PairSum], &'a [bool]),
    scale_opacity: &'a [[f32; 4]],
    rotation: &'a [[f32; 4]],
    colors: Harmonics<'a>,
    /// Derivatives of the chunk's centres, scales with opacities, and rotations.
    outs: [&'a mut [[f32; 4]]; 3],
    harmonics_out: &'a mut [[f32; 4]],
}

impl pulp::NullaryFnOnce for CarryChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { rendered, first, ins: (sums, is_touched), scale_opacity, rotation, colors, outs, harmonics_out } =
            self;
        let ([center_out, scale_out, rotation_out], coefficients) = (outs, colors.coefficients);
        for at in (0..sums.len()).filter(|at| is_touched[*at]) {
            let (sums, i) = (&sums[at], first + at);
            let Some(shape) = Shape::new(&scale_opacity[i], &rotation[i]) else { continue };
            let out = [&mut center_out[at], &mut scale_out[at], &mut rotation_out[at]];
            add_anisotropic(rendered, sums, &colors.center[i], &shape, out);
            let harmonics_out = &mut harmonics_out[at * coefficients..(at + 1) * coefficients];
            let d_color = Vec3::new(sums[8], sums[9], sums[10]);
            colors.add_backward(i, d_color, &mut center_out[at], harmonics_out);
        }
    }
}

/// Images and incoming derivatives of one view.
struct Pixels<'a> {
    size: [usize; 2],
    color: &'a [[f32; 4]],
    depth: Option<&'a Vec<f32>>,
    d_color: &'a [[f32; 4]],
    d_depth: &'a [[f32; 4]],
    /// Whether dL/d colour is carried to the Gaussians in place of the last three numbers of `d_depth`.
    carries_color: bool,
}

/// Incoming derivatives of a tile's pixels. A pixel without influence starts opaque.
struct State {
    transmittance: TileLanes,
    color: [TileLanes; 3],
    /// dL/d alpha of the pixel times its final transmittance.
    passing: TileLanes,
    /// dL/d depth / alpha; `mean_depth` is the rendered depth.
    by_depth: TileLanes,
    mean_depth: TileLanes,
    carried: [TileLanes; 3],
    /// Linearised loss of the colours that are still to be blended. Depths are relative to the rendered depth, so that
    /// theirs sum to 0.
    behind: TileLanes,
}

impl Pixels<'_> {
    /// Returns whether the pixels have derivatives by colour alone, which are those that are carried.
    fn only_colors(&self) -> bool {
        self.carries_color && self.depth.is_none()
    }

    /// Returns the incoming derivatives of a tile; `None` where no pixel has any.
    fn state(&self, column: usize, row: usize) -> Option<State> {
        const ZERO: TileLanes = [[0.0; LANES]; ROWS];
        let mut state = State {
            transmittance: ZERO,
            color: [ZERO; 3],
            passing: ZERO,
            by_depth: ZERO,
            mean_depth: ZERO,
            carried: [ZERO; 3],
            behind: ZERO,
        };
        let mut matters = false;
        for y in 0..ROWS.min(self.size[1] - row * ROWS) {
            for x in 0..LANES.min(self.size[0] - column * LANES) {
                let at = (row * ROWS + y) * self.size[0] + column * LANES + x;
                let (seen, d_color, mut d_depth) = (self.color[at], self.d_color[at], self.d_depth[at]);
                if self.depth.is_none() {
                    d_depth[0] = 0.0;
                }
                if self.carries_color {
                    d_depth[1..].copy_from_slice(&d_color[..3]);
                }
                let (color, depth) = (Vec4::from(d_color), Vec4::from(d_depth));
                let is_zero = color == Vec4::ZERO && depth == Vec4::ZERO;
                if seen[3] > 0.0 && !is_zero && color.is_finite() && depth.is_finite() {
                    matters = true;
                    state.transmittance[y][x] = 1.0;
                    for c in 0..3 {
                        state.color[c][y][x] = d_color[c];
                        state.carried[c][y][x] = d_depth[1 + c];
                    }
                    state.passing[y][x] = d_color[3] * (1.0 - seen[3]);
                    state.behind[y][x] = color.truncate().dot(Vec4::from(seen).truncate());
                    if let Some(rendered) = self.depth {
                        state.by_depth[y][x] = d_depth[0] / seen[3].max(1e-6);
                        state.mean_depth[y][x] = rendered[at];
                    }
                }
            }
        }
        matters.then_some(state)
    }
}

/// Derivative of a tile's blending. The list is walked front to back again; the light from behind a splat is the
/// finished pixel less what was blended so far. Writes the sum of each pair and returns the number of pairs walked.
///
/// With `ONLY_COLORS`, the pixels' derivatives are those of colours and coverage, and the carried ones those of colours.
struct TileBackward<'a, const ONLY_COLORS: bool> {
    state: State,
    origin: [f32; 2],
    list: &'a [u32],
    splats: &'a [ProjectedSplat],
    color: &'a [[f32; 4]],
    out: &'a mut [PairSum],
}

impl<const ONLY_COLORS: bool> pulp::NullaryFnOnce for TileBackward<'_, ONLY_COLORS> {
    type Output = u32;

    #[inline(always)]
    fn call(self) -> u32 {
        let Self { mut state, origin, list, splats, color, out } = self;
        for (index, (&gaussian, out)) in list.iter().zip(out).enumerate() {
            let (splat, paint) = (&splats[gaussian as usize], &color[gaussian as usize]);
            let (mut moments, mut values) = ([[0.0; LANES]; LANES], [[0.0; LANES]; 3]);
            for row in rows_of(splat, origin[1]) {
                state.add_row::<ONLY_COLORS>(splat, paint, origin, row, (&mut moments, &mut values));
            }
            let moments = sums_of_lanes(&moments);
            let [a, b, c] = values;
            let [red, green, blue, ..] = sums_of_lanes(&[a, b, c, a, a, b, c, a]);
            let [slope, slope_x, slope_y, by_depth, xx, xy, yy, weight] = moments;
            *out = [slope, slope_x, slope_y, by_depth, xx, xy, yy, weight, red, green, blue];
            if index % LANES == LANES - 1 && is_opaque(&state.transmittance) {
                return index as u32 + 1;
            }
        }
        list.len() as u32
    }
}

impl State {
    /// Adds a splat's contribution in a row to its sums.
    #[inline(always)]
    fn add_row<const ONLY_COLORS: bool>(
        &mut self,
        splat: &ProjectedSplat,
        paint: &[f32; 4],
        origin: [f32; 2],
        row: usize,
        (moments, values): (&mut [Lanes; LANES], &mut [Lanes; 3]),
    ) {
        let exponents = exponents(splat, origin, row);
        let (opaque, most) = (OPAQUE as f32, MAX_ALPHA as f32);
        let mut touched = 0u32;
        for lane in 0..LANES {
            touched |= u32::from(exponents[lane] >= LOG2_CUT) & u32::from(self.transmittance[row][lane] >= opaque);
        }
        if touched == 0 {
            return;
        }
        let dy = origin[1] + row as f32 - splat.pixel.y;
        for lane in 0..LANES {
            let dx = origin[0] + lane as f32 - splat.pixel.x;
            let transmittance = self.transmittance[row][lane];
            let is_touched = (exponents[lane] >= LOG2_CUT) & (transmittance >= opaque);
            let unclamped = exp2(exponents[lane]);
            let clamped = if unclamped < most { unclamped } else { most };
            let alpha = if is_touched { clamped } else { 0.0 };
            let weight = alpha * transmittance;
            let color = [0, 1, 2].map(|c| self.color[c][row][lane]);
            let mut value = color[0] * paint[0] + color[1] * paint[1] + color[2] * paint[2];
            if !ONLY_COLORS {
                let by_depth = self.by_depth[row][lane];
                value += by_depth * (splat.depth - self.mean_depth[row][lane]);
                moments[3][lane] += weight * by_depth;
            }
            let behind = self.behind[row][lane] - weight * value;
            self.behind[row][lane] = behind;
            let by_this_alpha = transmittance * value + (self.passing[row][lane] - behind) / (1.0 - alpha);
            // dL/d exponent; at the clamp alpha does not follow it.
            let slope = by_this_alpha * alpha * std::f32::consts::LN_2;
            let slope = if unclamped < most { slope } else { 0.0 };
            moments[0][lane] += slope;
            moments[1][lane] += slope * dx;
            moments[2][lane] += slope * dy;
            moments[4][lane] += slope * dx * dx;
            moments[5][lane] += slope * dx * dy;
            moments[6][lane] += slope * dy * dy;
            moments[7][lane] += weight;
            for (c, values) in values.iter_mut().enumerate() {
                values[lane] += weight * if ONLY_COLORS { color[c] } else { self.carried[c][row][lane] };
            }
            self.transmittance[row][lane] = transmittance * (1.0 - alpha);
        }
    }
}
