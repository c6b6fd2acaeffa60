//! Backward rasteriser on the processor: the sums per Gaussian.

mod blend;
mod planes;
mod project;

use flyrig_gpu::StorageBuffer;
use glam::Vec3;
use rayon::prelude::*;

use crate::anisotropic::buffers::{AnisotropicBuffers, AnisotropicGradients};
use crate::anisotropic::harmonics::Harmonics;
use crate::backward::gradients::{Carry, GaussianGradients, ImageGradients};
use crate::backward::processor::blend::{PLANE_INPUTS, Pixels, ROWS, TileBackward};
use crate::backward::processor::planes::{PlaneSum, add_plane};
use crate::backward::processor::project::{PairSum, add_anisotropic, add_isotropic};
use crate::backward::target::GradientTarget;
use crate::buffers::{GaussianBuffers, RenderTarget};
use crate::raster::processor::lanes::LANES;
use crate::raster::processor::lists::Lists;
use crate::raster::processor::rasterizer::{ProcessorRasterizer, RasterImage};
use crate::raster::processor::shape::Shape;

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
    /// Sum of the plane per list entry; valid for blended tiles of an image with planes.
    plane_pair_sums: Vec<PlaneSum>,
    /// Sum per Gaussian.
    sums: Vec<PairSum>,
    /// Sum of the plane per Gaussian; empty for an image without planes.
    plane_sums: Vec<PlaneSum>,
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
        let outputs = rendered.settings.outputs;
        let with_planes = outputs.planes && carries_color;
        let images = [&target.planes, &incoming.planes].map(|image| image.as_ref().and_then(StorageBuffer::slice));
        let planes = match &images {
            [Some(drawn), Some(incoming)] if with_planes => Some([&drawn[..], &incoming[..]]),
            _ => None,
        };
        let with_planes = planes.is_some();
        let pixels = Pixels {
            size: rendered.size.map(|side| side as usize),
            color: &drawn_color,
            depth: (outputs.depth && !with_planes).then_some(&drawn_depth),
            d_color: &d_color,
            d_depth: &d_depth,
            planes,
            carries_color,
        };
        self.pair_sums.resize(lists.pairs.len(), [0.0; 11]);
        self.plane_pair_sums.resize(if with_planes { lists.pairs.len() } else { 0 }, [0.0; 8]);
        self.walked.clear();
        self.walked.resize(lists.starts.len().saturating_sub(1), 0);
        // The part of the sums that belongs to each row of tiles.
        let mut rest = self.pair_sums.as_mut_slice();
        let mut plane_rest = self.plane_pair_sums.as_mut_slice();
        let columns = lists.tiles[0] as usize;
        let mut bands = Vec::with_capacity(lists.tiles[1] as usize);
        for (row, walked) in self.walked.chunks_mut(columns.max(1)).enumerate() {
            let first = lists.starts[row * columns];
            let length = (lists.starts[(row + 1) * columns] - first) as usize;
            let (part, others) = rest.split_at_mut(length);
            let (plane_part, plane_others) = plane_rest.split_at_mut(length.min(plane_rest.len()));
            bands.push((row, first as usize, (part, plane_part), walked));
            (rest, plane_rest) = (others, plane_others);
        }
        let within = |first: u32, count: u32, at: usize| (first as usize..(first + count) as usize).contains(&at);
        bands.into_par_iter().filter(|(row, ..)| within(rendered.first_tile[1], rendered.blended[1], *row)).for_each(
            |(row, first, (part, plane_part), walked)| {
                for (column, walked) in walked.iter_mut().enumerate() {
                    if !within(rendered.first_tile[0], rendered.blended[0], column) {
                        continue;
                    }
                    let range = lists.range(row * columns + column);
                    let (at, list) = ((column, row), &lists.pairs[range.clone()]);
                    let range = range.start - first..range.end - first;
                    let plane_out = if with_planes { &mut plane_part[range.clone()] } else { &mut [] };
                    let out = (&mut part[range], plane_out);
                    *walked = match (pixels.only_colors(), with_planes) {
                        (true, true) => walk::<true, PLANE_INPUTS>(&pixels, at, (list, lists, color), out),
                        (true, false) => walk::<true, 0>(&pixels, at, (list, lists, color), out),
                        (false, _) => walk::<false, 0>(&pixels, at, (list, lists, color), out),
                    };
                }
            },
        );
        self.add_up(lists, rendered.gaussians);
        Some(())
    }

    /// Adds the sums of the list entries to those of their Gaussians, tile by tile.
    fn add_up(&mut self, lists: &Lists, gaussians: usize) {
        self.sums.clear();
        self.sums.resize(gaussians, [0.0; 11]);
        self.plane_sums.clear();
        self.plane_sums.resize(if self.plane_pair_sums.is_empty() { 0 } else { gaussians }, [0.0; 8]);
        self.is_touched.clear();
        self.is_touched.resize(gaussians, false);
        for (tile, &walked) in self.walked.iter().enumerate().filter(|(_, walked)| **walked > 0) {
            let range = lists.range(tile);
            let range = range.start..range.start + walked as usize;
            let pairs = lists.pairs[range.clone()].iter().zip(&self.pair_sums[range.clone()]);
            // Without weight in any pixel all sums are 0.
            for (&gaussian, more) in pairs.filter(|(_, sums)| sums[WEIGHT] != 0.0) {
                let (sums, is_touched) = (&mut self.sums[gaussian as usize], &mut self.is_touched[gaussian as usize]);
                sums.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
                *is_touched = true;
            }
            if !self.plane_sums.is_empty() {
                let pairs = lists.pairs[range.clone()].iter().zip(&self.plane_pair_sums[range]);
                for (&gaussian, more) in pairs {
                    let sums = &mut self.plane_sums[gaussian as usize];
                    sums.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
                }
            }
        }
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
        let slices = gaussians.attributes().map(StorageBuffer::slice);
        let [Some(center), Some(scale_opacity), Some(rotation), Some(harmonics)] = &slices else { return };
        let slices = out.attributes().map(StorageBuffer::slice_mut);
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
                    plane_sums: &self.plane_sums,
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

/// Walks over the list of the tile at a column and row of tiles and writes the sum of each pair. Returns the number of pairs walked.
fn walk<const ONLY_COLORS: bool, const PLANES: usize>(
    pixels: &Pixels<'_>,
    (column, row): (usize, usize),
    (list, lists, color): (&[u32], &Lists, &[[f32; 4]]),
    (out, plane_out): (&mut [PairSum], &mut [PlaneSum]),
) -> u32 {
    let Some(state) = pixels.state::<PLANES>(column, row) else { return 0 };
    let origin = [(column * LANES) as f32, (row * ROWS) as f32];
    let (splats, planes) = (&lists.splats[..], &lists.planes[..]);
    let tile: TileBackward<'_, ONLY_COLORS, PLANES> =
        TileBackward { state, origin, list, splats, color, planes, out, plane_out };
    flyrig_types::vectorized(tile)
}

/// Sums of a chunk of anisotropic Gaussians, to be carried to their attributes.
struct CarryChunk<'a> {
    rendered: &'a RasterImage,
    /// Index of the chunk's first Gaussian.
    first: usize,
    ins: (&'a [PairSum], &'a [bool]),
    /// Sums of the planes of all Gaussians; empty for an image without planes.
    plane_sums: &'a [PlaneSum],
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
        let Self { rendered, first, ins, plane_sums, scale_opacity, rotation, colors, outs, harmonics_out } = self;
        let (sums, is_touched) = ins;
        let ([center_out, scale_out, rotation_out], coefficients) = (outs, colors.coefficients);
        for at in (0..sums.len()).filter(|at| is_touched[*at]) {
            let (sums, i) = (&sums[at], first + at);
            let Some(shape) = Shape::new(&scale_opacity[i], &rotation[i]) else { continue };
            let out = [&mut center_out[at], &mut scale_out[at], &mut rotation_out[at]];
            add_anisotropic(rendered, sums, &colors.center[i], &shape, out);
            if let Some(sums) = plane_sums.get(i) {
                let out = [&mut center_out[at], &mut scale_out[at], &mut rotation_out[at]];
                add_plane(rendered, sums, &colors.center[i], &shape, out);
            }
            let harmonics_out = &mut harmonics_out[at * coefficients..(at + 1) * coefficients];
            let d_color = Vec3::new(sums[8], sums[9], sums[10]);
            colors.add_backward(i, d_color, &mut center_out[at], harmonics_out);
        }
    }
}
