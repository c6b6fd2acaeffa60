//! Buffers of the rasteriser whose size follows the image.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};

use crate::raster_kernels::RasterShape;
use crate::scan::MAX_LOOP;

/// Room for pairs of a Gaussian and a tile. A body-like surface needs about three a Gaussian; the share
/// of the tiles is for a few Gaussians that cover the whole image.
const PAIRS_PER_GAUSSIAN: u64 = 16;
const PAIRS_PER_TILE: u64 = 64;
const MIN_PAIRS: u64 = 1 << 18;

/// Pairs that an image has room for, at most `limit`.
pub(crate) fn pair_capacity(gaussians: usize, tiles: u64, limit: u64) -> u32 {
    let wanted = PAIRS_PER_GAUSSIAN * gaussians as u64 + PAIRS_PER_TILE * tiles;
    wanted.max(MIN_PAIRS).min(limit).min(u64::from(u32::MAX)) as u32
}

#[derive(Debug)]
pub(crate) struct ImageBuffers {
    layout: Layout,
    size: [u32; 2],
    gaussians: usize,
    pub table: StorageBuffer<u32>,
    pub pairs: StorageBuffer<u32>,
}

/// Buffers for an image of one size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Layout {
    /// Columns and rows of tiles.
    pub tiles: [u32; 2],
    /// Columns of the tile table.
    pub bin_chunks: u32,
    /// Elements of the tile table.
    pub table_len: u32,
    /// Pairs of a Gaussian and a tile that can be listed.
    pub pair_capacity: u32,
}

impl ImageBuffers {
    pub(crate) fn new(
        gpu: &GpuContext,
        shape: RasterShape,
        size: [u32; 2],
        gaussians: usize,
    ) -> Result<Self, GpuError> {
        let layout = Layout::new(gpu, shape, size, gaussians);
        Ok(Self {
            layout,
            size,
            gaussians,
            table: StorageBuffer::zeroed(gpu, "tile table", layout.table_len as usize)?,
            pairs: StorageBuffer::zeroed(gpu, "tile lists", layout.pair_capacity as usize)?,
        })
    }

    /// Ready for images of `size`; allocates only when the room does not suffice.
    pub(crate) fn fit(
        &mut self,
        gpu: &GpuContext,
        shape: RasterShape,
        size: [u32; 2],
        gaussians: usize,
    ) -> Result<(), GpuError> {
        if (self.size, self.gaussians) == (size, gaussians) {
            return Ok(());
        }
        let layout = Layout::new(gpu, shape, size, gaussians);
        if layout.table_len as usize > self.table.len() || layout.pair_capacity as usize > self.pairs.len() {
            *self = Self::new(gpu, shape, size, gaussians)?;
        } else {
            (self.layout, self.size, self.gaussians) = (layout, size, gaussians);
        }
        Ok(())
    }

    pub(crate) fn layout(&self) -> Layout {
        self.layout
    }
}

impl Layout {
    fn new(gpu: &GpuContext, shape: RasterShape, size: [u32; 2], gaussians: usize) -> Self {
        let tiles = size.map(|side| side.div_ceil(shape.tile));
        let count = tiles[0].saturating_mul(tiles[1]).max(1);
        let bin_chunks = (shape.max_tile_table / count).clamp(1, shape.max_bin_chunks);
        let limits = gpu.device.limits();
        let limit = limits.max_buffer_size.min(limits.max_storage_buffer_binding_size) / 4;
        // Each invocation of the binning walks over its share of the pairs.
        let limit = limit.min(u64::from(bin_chunks) * MAX_LOOP);
        let pair_capacity = pair_capacity(gaussians, u64::from(count), limit);
        Self { tiles, bin_chunks, table_len: count.saturating_mul(bin_chunks), pair_capacity }
    }
}
