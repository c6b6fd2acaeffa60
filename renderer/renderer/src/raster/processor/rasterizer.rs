//! Forward rasteriser on the processor.

use std::time::{Duration, Instant};

use flyrig_gpu::{CameraConstants, StorageBuffer};
use flyrig_types::Camera;
use rayon::prelude::*;

use crate::anisotropic::buffers::Gaussians;
use crate::anisotropic::harmonics::Harmonics;
use crate::anisotropic::order::HarmonicOrder;
use crate::buffers::RenderTarget;
use crate::raster::processor::blend::{BlendTile, BlendedTile, PLANE_SUMS};
use crate::raster::processor::lanes::LANES;
use crate::raster::processor::lists::{Anisotropic, Isotropic, Lists};
use crate::raster::processor::project::{Projection, TILE};
use crate::raster::settings::{Latest, tile_range};
use crate::raster::settings::{Outputs, RasterSettings, RasterStats};

/// [`Rasterizer`](crate::Rasterizer) on the processor: renders while an image is recorded.
#[derive(Debug, Default)]
pub(crate) struct ProcessorRasterizer {
    pub(crate) lists: Lists,
    /// Image rendered last.
    pub(crate) latest: Option<RasterImage>,
    overflowed_images: u32,
    blend_time: Duration,
}

/// Parameters of a rendered image that its derivative needs.
#[derive(Debug, Clone)]
pub(crate) struct RasterImage {
    pub camera: CameraConstants,
    pub size: [u32; 2],
    pub gaussians: usize,
    /// Harmonic order of the colours; `None` for isotropic Gaussians.
    pub order: Option<HarmonicOrder>,
    pub settings: RasterSettings,
    /// First blended tile; `blended` has columns and rows of blended tiles.
    pub first_tile: [u32; 2],
    pub blended: [u32; 2],
}

impl ProcessorRasterizer {
    /// Renders an image. Does nothing for arrays that lie on a device.
    pub(crate) fn draw(
        &mut self,
        gaussians: Gaussians<'_>,
        camera: &Camera,
        settings: &RasterSettings,
        target: &RenderTarget,
    ) {
        self.latest = None;
        let size = [target.width, target.height];
        if size.contains(&0) {
            return;
        }
        let constants = CameraConstants::from(camera);
        let projection = Projection { camera: constants, size, settings };
        let tiles = match gaussians {
            Gaussians::Isotropic(buffers) => {
                let slices = buffers.attributes().map(StorageBuffer::slice);
                let [Some(center_scale), Some(normal), Some(color), Some(canonical)] = &slices else { return };
                self.lists.fill(&projection, Isotropic { center_scale, normal, color, canonical });
                self.blend(&projection, color, canonical, target)
            }
            Gaussians::Anisotropic(buffers) => {
                let slices = buffers.attributes().map(StorageBuffer::slice);
                let [Some(center), Some(scale_opacity), Some(rotation), Some(harmonics)] = &slices else { return };
                let coefficients = buffers.order().coefficients();
                let colors = Harmonics { center, harmonics, coefficients, eye: constants.center() };
                let surface =
                    buffers.surface.as_ref().map(|surface| (surface.normal.slice(), surface.canonical.slice()));
                let (normal, canonical) = match &surface {
                    Some((Some(normal), Some(canonical))) => (Some(normal.as_slice()), canonical.as_slice()),
                    Some(_) => return,
                    None => (None, &[][..]),
                };
                let anisotropic = Anisotropic { colors, scale_opacity, rotation, normal };
                self.lists.fill(&projection, anisotropic);
                if settings.outputs.planes {
                    self.lists.fill_planes(&constants, anisotropic);
                }
                let painted = std::mem::take(&mut self.lists.painted);
                let tiles = self.blend(&projection, &painted, canonical, target);
                self.lists.painted = painted;
                tiles
            }
        };
        let Some((first_tile, blended)) = tiles else { return };
        let (gaussians, order, settings) = (gaussians.count(), gaussians.order(), *settings);
        self.latest = Some(RasterImage { camera: constants, size, gaussians, order, settings, first_tile, blended });
    }

    /// Blends the lists into the images. Returns the first blended tile, and columns and rows of blended tiles.
    fn blend(
        &mut self,
        projection: &Projection<'_>,
        colors: &[[f32; 4]],
        positions: &[[f32; 4]],
        target: &RenderTarget,
    ) -> Option<([u32; 2], [u32; 2])> {
        let Projection { size, settings, .. } = *projection;
        self.overflowed_images += u32::from(self.lists.overflowed);
        let (first_tile, blended) = tile_range(settings.area, self.lists.tiles, TILE);
        let Outputs { color: with_color, depth: with_depth, canonical: with_canonical, planes: with_planes } =
            settings.outputs;
        let mut pictures = (
            target.color.slice_mut().filter(|_| with_color),
            target.depth.slice_mut().filter(|_| with_depth),
            target.canonical.slice_mut().filter(|_| with_canonical),
            target.planes.as_ref().and_then(StorageBuffer::slice_mut).filter(|_| with_planes),
        );
        let start = Instant::now();
        let row_of_tiles = (size[0] * TILE) as usize;
        // Rows of tiles; nothing where an image is not asked for.
        let mut bands: Vec<Band<'_>> = (0..self.lists.tiles[1]).map(|_| Band::default()).collect();
        if let Some(color) = &mut pictures.0 {
            bands.iter_mut().zip(color.chunks_mut(row_of_tiles)).for_each(|(band, part)| band.color = part);
        }
        if let Some(depth) = &mut pictures.1 {
            bands.iter_mut().zip(depth.chunks_mut(row_of_tiles)).for_each(|(band, part)| band.depth = part);
        }
        if let Some(canonical) = &mut pictures.2 {
            bands.iter_mut().zip(canonical.chunks_mut(row_of_tiles)).for_each(|(band, part)| band.canonical = part);
        }
        if let Some(planes) = &mut pictures.3 {
            bands.iter_mut().zip(planes.chunks_mut(row_of_tiles)).for_each(|(band, part)| band.planes = part);
        }
        let rows = first_tile[1] as usize..(first_tile[1] + blended[1]) as usize;
        let bands = bands.get_mut(rows)?;
        let lists = &self.lists;
        bands.par_iter_mut().enumerate().for_each(|(row, band)| {
            let row = first_tile[1] + row as u32;
            for column in first_tile[0]..first_tile[0] + blended[0] {
                let list = &lists.pairs[lists.range((row * lists.tiles[0] + column) as usize)];
                let left = column as usize * LANES;
                if list.is_empty() {
                    band.clear(size[0] as usize, left);
                    continue;
                }
                let origin = [(column * TILE) as f32, (row * TILE) as f32];
                let (splats, planes, outputs) = (&lists.splats[..], &lists.planes[..], settings.outputs);
                let (color, canonical, width) = (colors, positions, size[0] as usize);
                if with_planes {
                    let tile: BlendTile<'_, PLANE_SUMS> =
                        BlendTile { origin, list, splats, color, canonical, planes, outputs };
                    band.write(&flyrig_types::vectorized(tile), width, left);
                } else {
                    let tile: BlendTile<'_, 0> =
                        BlendTile { origin, list, splats, color, canonical, planes: &[], outputs };
                    band.write(&flyrig_types::vectorized(tile), width, left);
                }
            }
        });
        self.blend_time = start.elapsed();
        Some((first_tile, blended))
    }

    pub(crate) fn latest(&self) -> Option<Latest> {
        let RasterImage { size, gaussians, order, settings, blended, .. } = self.latest.as_ref()?;
        let outputs = settings.outputs;
        Some(Latest { gaussians: *gaussians, order: *order, size: *size, blended: *blended, outputs })
    }

    pub(crate) fn times(&self) -> [Duration; 4] {
        let [project, sort, lists] = self.lists.times;
        [project, sort, lists, self.blend_time]
    }

    pub(crate) fn stats(&self) -> RasterStats {
        RasterStats {
            visible_gaussians: self.lists.visible_gaussians,
            pairs: self.lists.wanted_pairs,
            overflowed_images: self.overflowed_images,
        }
    }
}

/// One row of tiles of each image; empty where the image is not written.
#[derive(Default)]
struct Band<'a> {
    color: &'a mut [[f32; 4]],
    depth: &'a mut [f32],
    canonical: &'a mut [[f32; 4]],
    planes: &'a mut [[f32; 4]],
}

impl Band<'_> {
    /// Clears a tile whose first pixel is in column `left`.
    fn clear(&mut self, width: usize, left: usize) {
        let columns = left..width.min(left + LANES);
        self.color.chunks_mut(width).for_each(|pixels| pixels[columns.clone()].fill([0.0; 4]));
        self.depth.chunks_mut(width).for_each(|pixels| pixels[columns.clone()].fill(0.0));
        self.canonical.chunks_mut(width).for_each(|pixels| pixels[columns.clone()].fill([0.0; 4]));
        self.planes.chunks_mut(width).for_each(|pixels| pixels[columns.clone()].fill([0.0; 4]));
    }

    /// Writes a tile whose first pixel is in column `left`.
    fn write<const PLANES: usize>(&mut self, tile: &BlendedTile<PLANES>, width: usize, left: usize) {
        let columns = LANES.min(width - left);
        let three = |sums: &[[[f32; LANES]; LANES]; 3], row: usize, lane: usize| {
            [sums[0][row][lane], sums[1][row][lane], sums[2][row][lane], tile.coverage[row][lane]]
        };
        for (row, pixels) in self.color.chunks_mut(width).enumerate() {
            for (lane, pixel) in pixels[left..left + columns].iter_mut().enumerate() {
                *pixel = three(&tile.color, row, lane);
            }
        }
        for (row, pixels) in self.depth.chunks_mut(width).enumerate() {
            for (lane, pixel) in pixels[left..left + columns].iter_mut().enumerate() {
                // Coverage is 0 or at least the cut.
                *pixel = tile.depth[row][lane] / tile.coverage[row][lane].max(1e-6);
            }
        }
        for (row, pixels) in self.canonical.chunks_mut(width).enumerate() {
            for (lane, pixel) in pixels[left..left + columns].iter_mut().enumerate() {
                *pixel = three(&tile.canonical, row, lane);
            }
        }
        for (row, pixels) in self.planes.chunks_mut(width).enumerate() {
            for (lane, pixel) in pixels[left..left + columns].iter_mut().enumerate() {
                pixel.iter_mut().zip(&tile.planes).for_each(|(value, sums)| *value = sums[row][lane]);
            }
        }
    }
}
