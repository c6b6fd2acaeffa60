//! Buffers of the rasteriser whose size follows the picture.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};

use crate::raster_kernels::RasterShape;

/// Room for pairs of a Gaussian and a tile. A body-like surface needs about three a Gaussian; the share
/// of the tiles is for a few Gaussians that cover the whole picture.
const PAIRS_PER_GAUSSIAN: u64 = 16;
const PAIRS_PER_TILE: u64 = 64;
const MIN_PAIRS: u64 = 1 << 18;

#[derive(Debug)]
pub(crate) struct PictureBuffers {
    size: [u32; 2],
    gaussians: usize,
    /// Columns and rows of tiles.
    pub tiles: [u32; 2],
    /// Columns of the tile table.
    pub bin_chunks: u32,
    pub table: StorageBuffer<u32>,
    pub pairs: StorageBuffer<u32>,
}

impl PictureBuffers {
    pub(crate) fn new(
        gpu: &GpuContext,
        shape: RasterShape,
        size: [u32; 2],
        gaussians: usize,
    ) -> Result<Self, GpuError> {
        let (tiles, bin_chunks) = layout(shape, size);
        let count = u64::from(tiles[0]) * u64::from(tiles[1]);
        let limits = gpu.device.limits();
        let limit = limits.max_buffer_size.min(u64::from(limits.max_storage_buffer_binding_size)) / 4;
        // One above the capacity must fit u32 with any one Gaussian's tiles added (see add_pairs).
        let limit = limit.min(1 << 30);
        let pairs = (PAIRS_PER_GAUSSIAN * gaussians as u64 + PAIRS_PER_TILE * count).max(MIN_PAIRS).min(limit);
        Ok(Self {
            size,
            gaussians,
            tiles,
            bin_chunks,
            table: StorageBuffer::zeroed(gpu, "tile table", count as usize * bin_chunks as usize)?,
            pairs: StorageBuffer::zeroed(gpu, "tile lists", pairs as usize)?,
        })
    }

    /// Ready for pictures of `size`; allocates only when the room does not suffice.
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
        let (tiles, bin_chunks) = layout(shape, size);
        let needed = tiles[0] as usize * tiles[1] as usize * bin_chunks as usize;
        if gaussians > self.gaussians || needed > self.table.len() {
            *self = Self::new(gpu, shape, size, gaussians)?;
        } else {
            (self.size, self.tiles, self.bin_chunks) = (size, tiles, bin_chunks);
        }
        Ok(())
    }

    /// Elements of the table in use.
    pub(crate) fn table_len(&self) -> u32 {
        self.tiles[0] * self.tiles[1] * self.bin_chunks
    }
}

fn layout(shape: RasterShape, size: [u32; 2]) -> ([u32; 2], u32) {
    let tiles = size.map(|side| side.div_ceil(shape.tile));
    let count = tiles[0].saturating_mul(tiles[1]).max(1);
    (tiles, (shape.max_tile_table / count).clamp(1, shape.max_bin_chunks))
}
