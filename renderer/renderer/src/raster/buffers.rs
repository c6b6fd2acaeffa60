//! Buffers of the rasteriser whose size follows the image.

use flyrig_gpu::{GpuContext, GpuError, MAX_WORKGROUPS_PER_DIMENSION, StorageBuffer};

use crate::raster::kernels::{BINS_LANES, Tile};
use crate::sort::radix::{Keys, RadixSort};

/// Capacity for (tile, Gaussian) pairs per Gaussian. A body-like surface needs about three; the capacity per tile
/// serves a few Gaussians that cover the whole image.
pub(crate) const PAIRS_PER_GAUSSIAN: u64 = 16;
pub(crate) const PAIRS_PER_TILE: u64 = 64;
pub(crate) const MIN_PAIRS: u64 = 1 << 18;
/// Largest number of pairs that one dispatch of the kernel that writes them can reach.
const MOST_PAIRS: u64 = MAX_WORKGROUPS_PER_DIMENSION as u64 * BINS_LANES as u64;

/// Returns the number of pairs that an image has room for, at most `limit`.
pub(crate) fn pair_capacity(gaussians: usize, tiles: u64, limit: u64) -> u32 {
    let wanted = PAIRS_PER_GAUSSIAN * gaussians as u64 + PAIRS_PER_TILE * tiles;
    wanted.max(MIN_PAIRS).min(limit).min(u64::from(u32::MAX)) as u32
}

#[derive(Debug)]
pub(crate) struct ImageBuffers {
    layout: Layout,
    size: [u32; 2],
    gaussians: usize,
    /// End of each tile's list, elements of [`Self::lists`].
    pub ends: StorageBuffer<u32>,
    /// Sort of (tile, Gaussian) by tile.
    pub sort: RadixSort,
}

/// Buffers for an image of one size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Layout {
    /// Columns and rows of tiles.
    pub tiles: [u32; 2],
    /// Pairs of a Gaussian and a tile that can be listed.
    pub pair_capacity: u32,
}

impl ImageBuffers {
    pub(crate) fn new(gpu: &GpuContext, tile: Tile, size: [u32; 2], gaussians: usize) -> Result<Self, GpuError> {
        let layout = Layout::new(gpu, tile, size, gaussians);
        Ok(Self {
            layout,
            size,
            gaussians,
            ends: StorageBuffer::zeroed(gpu, "ends of tile lists", layout.tile_count() as usize)?,
            sort: RadixSort::new(gpu, layout.pair_capacity as usize)?,
        })
    }

    /// Prepares for images of `size`; reallocates only where the capacity does not suffice.
    pub(crate) fn fit(
        &mut self,
        gpu: &GpuContext,
        tile: Tile,
        size: [u32; 2],
        gaussians: usize,
    ) -> Result<(), GpuError> {
        if (self.size, self.gaussians) == (size, gaussians) {
            return Ok(());
        }
        let layout = Layout::new(gpu, tile, size, gaussians);
        if layout.tile_count() as usize > self.ends.len() || layout.pair_capacity as usize > self.sort.capacity() {
            *self = Self::new(gpu, tile, size, gaussians)?;
        } else {
            (self.layout, self.size, self.gaussians) = (layout, size, gaussians);
        }
        Ok(())
    }

    pub(crate) fn layout(&self) -> Layout {
        self.layout
    }

    /// Returns the concatenated lists, elements (tile, Gaussian).
    pub(crate) fn lists(&self) -> &StorageBuffer<[u32; 2]> {
        self.sort.output(self.layout.keys())
    }
}

impl Layout {
    fn new(gpu: &GpuContext, tile: Tile, size: [u32; 2], gaussians: usize) -> Self {
        let tiles = size.map(|side| side.div_ceil(tile.0));
        let limits = gpu.device.limits();
        let limit = limits.max_buffer_size.min(limits.max_storage_buffer_binding_size) / size_of::<[u32; 2]>() as u64;
        let limit = limit.min(MOST_PAIRS);
        let mut layout = Self { tiles, pair_capacity: 0 };
        layout.pair_capacity = pair_capacity(gaussians, u64::from(layout.tile_count()), limit);
        layout
    }

    pub(crate) fn tile_count(self) -> u32 {
        self.tiles[0].saturating_mul(self.tiles[1]).max(1)
    }

    /// Returns the key range of the sort by tile.
    pub(crate) fn keys(self) -> Keys {
        Keys::Below(self.tile_count())
    }
}
