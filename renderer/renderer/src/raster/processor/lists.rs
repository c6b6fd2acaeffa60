//! Gaussians in depth order and the lists of the tiles: projection, radix sort, and counting sort by tile.

use std::time::{Duration, Instant};

use flyrig_gpu::CameraConstants;
use rayon::prelude::*;

use crate::anisotropic::harmonics::Harmonics;
use crate::raster::buffers::pair_capacity;
use crate::raster::processor::planes::{Plane, PlaneChunk};
use crate::raster::processor::project::{ProjectedSplat, Projection, Rect, TILE};

/// Gaussians per projection task.
const CHUNK: usize = 4096;
/// Bits per pass of the radix sort, and number of passes: keys are sorted to their product, in bits of their range.
const DIGIT_BITS: u32 = 12;
const PASSES: u32 = 2;

/// Source of Gaussians to project.
pub(crate) trait Source: Copy + Send + Sync {
    /// Returns the number of Gaussians.
    fn count(&self) -> usize;

    /// Projects Gaussian `i` to its splat and tiles; `None` where it is not drawn.
    fn splat(&self, projection: &Projection<'_>, i: usize) -> Option<(ProjectedSplat, Rect)>;

    /// Returns the colours by direction, where the Gaussians have such.
    fn harmonics(&self) -> Option<Harmonics<'_>> {
        None
    }
}

/// Attributes of isotropic Gaussians, as in [`GaussianBuffers`](crate::GaussianBuffers).
#[derive(Clone, Copy)]
pub(crate) struct Isotropic<'a> {
    pub center_scale: &'a [[f32; 4]],
    pub normal: &'a [[f32; 4]],
    pub color: &'a [[f32; 4]],
    pub canonical: &'a [[f32; 4]],
}

impl Source for Isotropic<'_> {
    fn count(&self) -> usize {
        self.center_scale.len()
    }

    #[inline(always)]
    fn splat(&self, projection: &Projection<'_>, i: usize) -> Option<(ProjectedSplat, Rect)> {
        projection.isotropic(&self.center_scale[i], &self.normal[i], &self.color[i], &self.canonical[i])
    }
}

/// Attributes of anisotropic Gaussians, as in [`AnisotropicBuffers`](crate::AnisotropicBuffers).
#[derive(Clone, Copy)]
pub(crate) struct Anisotropic<'a> {
    pub colors: Harmonics<'a>,
    pub scale_opacity: &'a [[f32; 4]],
    pub rotation: &'a [[f32; 4]],
    /// Normals of the surface, where the Gaussians belong to one.
    pub normal: Option<&'a [[f32; 4]]>,
}

impl Source for Anisotropic<'_> {
    fn count(&self) -> usize {
        self.scale_opacity.len()
    }

    #[inline(always)]
    fn splat(&self, projection: &Projection<'_>, i: usize) -> Option<(ProjectedSplat, Rect)> {
        let normal = self.normal.map(|normals| &normals[i]);
        projection.anisotropic(&self.colors.center[i], &self.scale_opacity[i], &self.rotation[i], normal)
    }

    fn harmonics(&self) -> Option<Harmonics<'_>> {
        Some(self.colors)
    }
}

/// Element of the sort. It carries its rectangle: looking rectangles up by Gaussian costs more than all other work on
/// the lists.
#[derive(Debug, Clone, Copy, Default)]
struct Ranked {
    /// Bits of the depth, which sort as positive floats do.
    key: u32,
    gaussian: u32,
    rect: Rect,
}

/// Splats and tile lists of one image. The next image reuses the arrays.
#[derive(Debug, Default)]
pub(crate) struct Lists {
    /// Splat per Gaussian; stale where the Gaussian is not drawn.
    pub splats: Vec<ProjectedSplat>,
    /// Colour per Gaussian as seen from the camera, where colours depend on the direction; stale where the Gaussian is
    /// not drawn.
    pub painted: Vec<[f32; 4]>,
    /// Plane per Gaussian; stale where the image draws no planes or the Gaussian is not drawn.
    pub planes: Vec<Plane>,
    /// Drawn Gaussians of each chunk.
    visible: Vec<Vec<Ranked>>,
    /// Drawn Gaussians, nearest first.
    order: Vec<Ranked>,
    scratch: Vec<Ranked>,
    /// Columns and rows of tiles.
    pub tiles: [u32; 2],
    /// Start of each tile's list in `pairs`, and the end of the last one.
    pub starts: Vec<u32>,
    /// Concatenated lists of Gaussians by tile, nearest first.
    pub pairs: Vec<u32>,
    /// Gaussians that touch the image.
    pub visible_gaussians: u32,
    /// Pairs of a Gaussian and a tile that were required, at most one more than the capacity.
    pub wanted_pairs: u32,
    /// Whether the pairs exceeded the capacity.
    pub overflowed: bool,
    /// Run times of projection, sort and lists.
    pub times: [Duration; 3],
}

impl Lists {
    /// Projects, sorts and lists the Gaussians of an image.
    pub fn fill(&mut self, projection: &Projection<'_>, gaussians: impl Source) {
        let start = Instant::now();
        self.project(projection, gaussians);
        if let Some(harmonics) = gaussians.harmonics() {
            self.paint(gaussians.count(), harmonics);
        }
        let projected = Instant::now();
        self.sort();
        let sorted = Instant::now();
        self.bin(projection.size, gaussians.count());
        self.times = [projected - start, sorted - projected, sorted.elapsed()];
    }

    fn project(&mut self, projection: &Projection<'_>, gaussians: impl Source) {
        let count = gaussians.count();
        self.splats.resize(count, ProjectedSplat::default());
        self.visible.resize(count.div_ceil(CHUNK), Vec::new());
        let chunks = self.splats.par_chunks_mut(CHUNK).zip(&mut self.visible);
        chunks.enumerate().for_each(|(chunk, (splats, visible))| {
            visible.clear();
            flyrig_types::vectorized(ProjectChunk { projection, gaussians, first: chunk * CHUNK, splats, visible });
        });
    }

    /// Computes the colours of drawn Gaussians. A Gaussian with a non-finite colour is not drawn.
    fn paint(&mut self, count: usize, harmonics: Harmonics<'_>) {
        self.painted.resize(count, [0.0; 4]);
        let chunks = self.painted.par_chunks_mut(CHUNK).zip(&mut self.visible);
        chunks.enumerate().for_each(|(chunk, (painted, visible))| {
            flyrig_types::vectorized(PaintChunk { harmonics, first: chunk * CHUNK, painted, visible });
        });
    }

    /// Computes the planes of the Gaussians.
    pub fn fill_planes(&mut self, camera: &CameraConstants, gaussians: Anisotropic<'_>) {
        let Anisotropic { colors: Harmonics { center, .. }, scale_opacity, rotation, .. } = gaussians;
        self.planes.resize(gaussians.count(), Plane::default());
        self.planes.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, planes)| {
            let first = chunk * CHUNK;
            flyrig_types::vectorized(PlaneChunk { camera, first, center, scale_opacity, rotation, planes });
        });
    }

    /// Sorts by depth with a stable radix sort, to 24 bits of the range of the depths' bits.
    fn sort(&mut self) {
        self.order.clear();
        self.visible.iter().for_each(|visible| self.order.extend_from_slice(visible));
        self.visible_gaussians = self.order.len() as u32;
        let (low, high) =
            self.order.iter().fold((u32::MAX, 0u32), |(low, high), one| (low.min(one.key), high.max(one.key)));
        let range_bits = u32::BITS - high.saturating_sub(low).leading_zeros();
        let shift = range_bits.saturating_sub(DIGIT_BITS * PASSES);
        self.scratch.resize(self.order.len(), Ranked::default());
        for pass in 0..PASSES {
            let digit = |key: u32| (((key - low) >> shift) >> (pass * DIGIT_BITS)) as usize & ((1 << DIGIT_BITS) - 1);
            let mut places = vec![0u32; 1 << DIGIT_BITS];
            self.order.iter().for_each(|one| places[digit(one.key)] += 1);
            let mut end = 0;
            for place in &mut places {
                end += std::mem::replace(place, end);
            }
            for one in &self.order {
                let place = &mut places[digit(one.key)];
                self.scratch[*place as usize] = *one;
                *place += 1;
            }
            std::mem::swap(&mut self.order, &mut self.scratch);
        }
    }

    /// Builds the lists by tile. Where the pairs exceed the capacity, the farthest Gaussians are dropped entirely.
    fn bin(&mut self, size: [u32; 2], count: usize) {
        self.tiles = size.map(|side| side.div_ceil(TILE));
        let tiles = self.tiles[0] as usize * self.tiles[1] as usize;
        let capacity = pair_capacity(count, tiles as u64, u64::from(u32::MAX));
        let mut pairs = 0;
        let mut kept = self.order.len();
        for (rank, one) in self.order.iter().enumerate() {
            let more = one.rect.tiles();
            if more > capacity - pairs {
                kept = rank;
                break;
            }
            pairs += more;
        }
        self.overflowed = kept < self.order.len();
        self.wanted_pairs = if self.overflowed { capacity + 1 } else { pairs };
        let order = &self.order[..kept];
        let [columns, rows] = self.tiles.map(|count| count as usize);
        // Threads share the rows of tiles; each walks over all Gaussians in their order.
        let bands = rayon::current_num_threads().clamp(1, rows.max(1));
        let band_rows = rows.div_ceil(bands).max(1);
        self.starts.clear();
        self.starts.resize(tiles + 1, 0);
        let counts = &mut self.starts[1..];
        counts.par_chunks_mut(band_rows * columns.max(1)).enumerate().for_each(|(band, counts)| {
            for one in order {
                each_tile(&one.rect, band * band_rows, band_rows, columns, |at| counts[at] += 1);
            }
        });
        let mut end = 0;
        for start in &mut self.starts {
            end += *start;
            *start = end;
        }
        self.pairs.resize(pairs as usize, 0);
        // The part of the pairs that belongs to each band.
        let mut rest = self.pairs.as_mut_slice();
        let mut parts = Vec::with_capacity(bands);
        for band in 0..bands {
            let tile = |row: usize| (row.min(rows) * columns).min(tiles);
            let range = tile(band * band_rows)..tile((band + 1) * band_rows);
            let (first, last) = (self.starts[range.start], self.starts[range.end]);
            let (part, others) = rest.split_at_mut((last - first) as usize);
            parts.push((band, &self.starts[range], first, part));
            rest = others;
        }
        parts.into_par_iter().for_each(|(band, starts, first, part)| {
            let mut places: Vec<u32> = starts.iter().map(|start| start - first).collect();
            for one in order {
                each_tile(&one.rect, band * band_rows, band_rows, columns, |at| {
                    part[places[at] as usize] = one.gaussian;
                    places[at] += 1;
                });
            }
        });
    }

    /// Returns the range of a tile's list in `pairs`.
    pub fn range(&self, tile: usize) -> std::ops::Range<usize> {
        self.starts[tile] as usize..self.starts[tile + 1] as usize
    }
}

/// Projection of the Gaussians from number `first` on.
struct ProjectChunk<'a, S> {
    projection: &'a Projection<'a>,
    gaussians: S,
    first: usize,
    splats: &'a mut [ProjectedSplat],
    visible: &'a mut Vec<Ranked>,
}

impl<S: Source> pulp::NullaryFnOnce for ProjectChunk<'_, S> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { projection, gaussians, first, splats, visible } = self;
        for (offset, splat) in splats.iter_mut().enumerate() {
            let i = first + offset;
            if let Some((drawn, rect)) = gaussians.splat(projection, i) {
                *splat = drawn;
                visible.push(Ranked { key: drawn.depth.to_bits(), gaussian: i as u32, rect });
            }
        }
    }
}

/// Drawn Gaussians of a chunk whose colours are wanted.
struct PaintChunk<'a> {
    harmonics: Harmonics<'a>,
    first: usize,
    painted: &'a mut [[f32; 4]],
    visible: &'a mut Vec<Ranked>,
}

impl pulp::NullaryFnOnce for PaintChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { harmonics, first, painted, visible } = self;
        visible.retain(
            #[inline(always)]
            |one| {
                let i = one.gaussian as usize;
                let color = harmonics.color(i);
                painted[i - first] = color.unwrap_or_default();
                color.is_some()
            },
        );
    }
}

/// Calls `with` with the index in the band of every tile of `rect`; the band has `rows` rows from `first_row` on.
#[inline]
fn each_tile(rect: &Rect, first_row: usize, rows: usize, columns: usize, mut with: impl FnMut(usize)) {
    let (top, bottom) =
        (usize::from(rect.first[1]).max(first_row), usize::from(rect.last[1]).min(first_row + rows - 1));
    for row in top..=bottom {
        let at = (row - first_row) * columns;
        for column in rect.first[0]..=rect.last[0] {
            with(at + usize::from(column));
        }
    }
}
