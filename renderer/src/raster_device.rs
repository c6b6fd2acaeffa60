//! The forward rasteriser on the device: projection through the camera's lens (EWA splatting), stable sort by depth, lists by
//! tile, and front-to-back blending, without a wait.

use std::sync::Arc;

use bytemuck::bytes_of;
use flyrig_gpu::{CameraConstants, ComputeKernel, GpuContext, GpuError, GpuTimer, StorageBuffer, dispatch_1d};
use flyrig_types::Camera;
use wgpu::{BindingResource, CommandEncoder, ComputePass, ComputePassDescriptor};

use crate::constants::Constants;
use crate::raster_buffers::{ImageBuffers, Layout};
use crate::raster_kernels::{Frame, RasterKernels, RasterShape};
use crate::raster_settings::{Latest, tile_range};
use crate::scan::{CHUNK_GROUP, MAX_LOOP, Scan, run, run_at};
use crate::sort::{RadixSort, SortPass};
use crate::{GaussianBuffers, Outputs, RasterSettings, RasterStats, RenderTarget};

/// [`Rasterizer`](crate::Rasterizer) on the device. Buffers and pipelines are made once; they grow with the image and the
/// number of Gaussians.
#[derive(Debug)]
pub(crate) struct DeviceRasterizer {
    pub(crate) kernels: RasterKernels,
    scan: Scan,
    pub(crate) sort: RadixSort,
    pub(crate) splats: StorageBuffer<[f32; 8]>,
    pub(crate) rects: StorageBuffer<[u32; 2]>,
    chunk_pairs: StorageBuffer<u32>,
    pub(crate) pairs_before: StorageBuffer<u32>,
    pair_total: StorageBuffer<u32>,
    stats: StorageBuffer<u32>,
    /// Of the image recorded last.
    pub(crate) constants: Constants,
    pub(crate) picture: Option<ImageBuffers>,
    pub(crate) latest: Option<Latest>,
}

impl DeviceRasterizer {
    pub(crate) fn new(gpu: &GpuContext, max_gaussians: usize) -> Result<Self, GpuError> {
        Self::with_shape(gpu, max_gaussians, RasterShape::for_adapter(gpu))
    }

    pub(crate) fn with_shape(gpu: &GpuContext, max_gaussians: usize, shape: RasterShape) -> Result<Self, GpuError> {
        check_count(max_gaussians, shape)?;
        let mut constants = vec![size_of::<Frame>(), size_of::<[u32; 4]>(), size_of::<[u32; 4]>()];
        constants.resize(SORT_PASSES + shape.sort.digit_passes as usize, size_of::<SortPass>());
        Ok(Self {
            constants: Constants::new(gpu, &constants)?,
            kernels: RasterKernels::new(gpu, shape),
            scan: Scan::new(gpu, shape.sort.chunks)?,
            sort: RadixSort::new(gpu, max_gaussians, shape.sort)?,
            splats: StorageBuffer::zeroed(gpu, "splats", max_gaussians)?,
            rects: StorageBuffer::zeroed(gpu, "splat rectangles", max_gaussians)?,
            chunk_pairs: StorageBuffer::zeroed(gpu, "pairs a chunk", shape.max_bin_chunks as usize)?,
            pairs_before: StorageBuffer::zeroed(gpu, "pairs before", max_gaussians)?,
            pair_total: StorageBuffer::zeroed(gpu, "pair total", 1)?,
            stats: StorageBuffer::zeroed(gpu, "raster statistics", 3)?,
            picture: None,
            latest: None,
        })
    }

    pub(crate) fn encode_timed(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: &GaussianBuffers,
        (camera, settings): (&Camera, &RasterSettings),
        target: &RenderTarget,
        mut timer: Option<&mut GpuTimer>,
    ) -> Result<(), GpuError> {
        self.latest = None;
        if target.width == 0 || target.height == 0 {
            return Ok(());
        }
        self.grow(gpu, gaussians.count(), target)?;
        let Some(picture) = &self.picture else { return Ok(()) };
        let layout = picture.layout();
        let (first_tile, blended) = tile_range(settings.area, layout.tiles, self.kernels.shape.tile);
        let frame = Frame {
            camera: CameraConstants::from(camera),
            size: [target.width, target.height],
            tiles: layout.tiles,
            gaussians: gaussians.count() as u32,
            cull_backfacing: settings.cull_backfacing.into(),
            with_canonical: settings.outputs.canonical.into(),
            pair_capacity: layout.pair_capacity,
            near_m: settings.near_m,
            filter_variance_px2: settings.filter_variance_px2,
            bin_chunks: layout.bin_chunks,
            unused: 0,
            first_tile,
            unused_too: [0; 2],
        };
        self.encode_constants(gpu, encoder, &frame, layout);
        encoder.clear_buffer(picture.table.raw(), 0, Some(u64::from(layout.table_len) * 4));
        let blend = self.kernels.blend(gpu, settings.outputs);
        let stages = Stages { gpu, rasterizer: self, gaussians, target, picture, blended };
        let mut pass = |name, record: &dyn Fn(&mut ComputePass<'_>)| {
            let timestamp_writes = timer.as_mut().and_then(|timer| timer.stage(name));
            record(&mut encoder.begin_compute_pass(&ComputePassDescriptor { label: Some(name), timestamp_writes }));
        };
        pass("project", &|pass| stages.project(pass));
        pass("depth sort", &|pass| stages.depth_sort(pass));
        pass("tile lists", &|pass| stages.tile_lists(pass));
        pass("blend", &|pass| stages.blend(pass, &blend));
        let (gaussians, size, outputs) = (gaussians.count(), frame.size, settings.outputs);
        self.latest = Some(Latest { gaussians, size, blended, outputs });
        Ok(())
    }

    pub(crate) fn stats(&self, gpu: &GpuContext) -> Result<RasterStats, GpuError> {
        let stats = self.stats.read(gpu)?;
        let get = |i: usize| stats.get(i).copied().unwrap_or_default();
        Ok(RasterStats { visible_gaussians: get(0), pairs: get(1), overflowed_images: get(2) })
    }

    fn grow(&mut self, gpu: &GpuContext, count: usize, target: &RenderTarget) -> Result<(), GpuError> {
        check_count(count, self.kernels.shape)?;
        if count > self.splats.len() {
            self.sort.grow(gpu, count)?;
            self.rects = StorageBuffer::zeroed(gpu, "splat rectangles", count)?;
            self.pairs_before = StorageBuffer::zeroed(gpu, "pairs before", count)?;
            self.splats = StorageBuffer::zeroed(gpu, "splats", count)?;
        }
        let size = [target.width, target.height];
        let shape = self.kernels.shape;
        match &mut self.picture {
            Some(picture) => picture.fit(gpu, shape, size, self.splats.len()),
            none => {
                *none = Some(ImageBuffers::new(gpu, shape, size, self.splats.len())?);
                Ok(())
            }
        }
    }

    fn encode_constants(&self, gpu: &GpuContext, encoder: &mut CommandEncoder, frame: &Frame, layout: Layout) {
        let sort = self.kernels.shape.sort;
        let lengths = [[sort.table_len(), 0, 0, 0], [layout.table_len, 0, 0, 0]];
        let passes: Vec<SortPass> = (0..sort.digit_passes).map(|index| SortPass::new(frame.gaussians, index)).collect();
        let mut values = vec![bytes_of(frame)];
        values.extend(lengths.iter().map(bytes_of));
        values.extend(passes.iter().map(bytes_of));
        self.constants.encode(gpu, encoder, &values);
    }
}

/// Refuses more Gaussians than the invocations of the sort may loop over.
fn check_count(count: usize, shape: RasterShape) -> Result<(), GpuError> {
    let limit = u64::from(shape.sort.chunks) * MAX_LOOP;
    let bytes = size_of::<[u32; 2]>() as u64;
    if count as u64 > limit {
        let what = format!("the depth sort of {count} Gaussians");
        return Err(GpuError::TooLarge { what, needed: count as u64 * bytes, limit: limit * bytes });
    }
    Ok(())
}

/// Places in the [`Constants`] of one encoding.
pub(crate) const FRAME: usize = 0;
const SORT_TABLE: usize = 1;
const TILE_TABLE: usize = 2;
const SORT_PASSES: usize = 3;

/// Everything that one image's kernels are bound to.
struct Stages<'a> {
    gpu: &'a GpuContext,
    rasterizer: &'a DeviceRasterizer,
    gaussians: &'a GaussianBuffers,
    target: &'a RenderTarget,
    picture: &'a ImageBuffers,
    blended: [u32; 2],
}

impl Stages<'_> {
    fn project(&self, pass: &mut ComputePass<'_>) {
        let (r, g) = (self.rasterizer, self.gaussians);
        let resources = [
            self.rasterizer.constants.get(FRAME),
            g.center_scale.raw().as_entire_binding(),
            g.normal.raw().as_entire_binding(),
            g.color.raw().as_entire_binding(),
            g.canonical.raw().as_entire_binding(),
            r.splats.raw().as_entire_binding(),
            r.rects.raw().as_entire_binding(),
            r.sort.input().raw().as_entire_binding(),
        ];
        run(self.gpu, pass, &r.kernels.project, &resources, dispatch_1d(g.count() as u32, 64));
    }

    fn depth_sort(&self, pass: &mut ComputePass<'_>) {
        let r = self.rasterizer;
        let passes: Vec<_> = (0..r.kernels.shape.sort.digit_passes as usize)
            .map(|i| self.rasterizer.constants.get(SORT_PASSES + i))
            .collect();
        r.sort.encode(self.gpu, pass, &r.scan, &passes, &self.rasterizer.constants.get(SORT_TABLE));
    }

    fn tile_lists(&self, pass: &mut ComputePass<'_>) {
        let (r, p) = (self.rasterizer, self.picture);
        let resources: [BindingResource<'_>; 9] = [
            r.constants.get(FRAME),
            r.sort.output().raw().as_entire_binding(),
            r.sort.valid().raw().as_entire_binding(),
            r.rects.raw().as_entire_binding(),
            r.chunk_pairs.raw().as_entire_binding(),
            r.pairs_before.raw().as_entire_binding(),
            p.table.raw().as_entire_binding(),
            p.pairs.raw().as_entire_binding(),
            r.stats.raw().as_entire_binding(),
        ];
        let groups = (p.layout().bin_chunks.div_ceil(CHUNK_GROUP), 1);
        run(self.gpu, pass, &r.kernels.count_pairs, &resources[..5], groups);
        run(self.gpu, pass, &r.kernels.place_pairs, &resources[..6], groups);
        run_at(self.gpu, pass, &r.kernels.count_tiles, &numbered(&resources, &[0, 1, 2, 3, 4, 5, 6, 8]), groups);
        r.scan.encode(self.gpu, pass, &self.rasterizer.constants.get(TILE_TABLE), &p.table, &r.pair_total);
        run(self.gpu, pass, &r.kernels.list_pairs, &resources[..8], groups);
    }

    fn blend(&self, pass: &mut ComputePass<'_>, kernels: &[(Outputs, Arc<ComputeKernel>)]) {
        let (r, p, t) = (self.rasterizer, self.picture, self.target);
        let resources = [
            r.constants.get(FRAME),
            r.splats.raw().as_entire_binding(),
            self.gaussians.color.raw().as_entire_binding(),
            self.gaussians.canonical.raw().as_entire_binding(),
            p.table.raw().as_entire_binding(),
            p.pairs.raw().as_entire_binding(),
            t.color.raw().as_entire_binding(),
            t.depth.raw().as_entire_binding(),
            t.canonical.raw().as_entire_binding(),
        ];
        for (outputs, kernel) in kernels {
            let mut used = vec![0, 1, 4, 5];
            used.extend(if outputs.color { &[2, 6][..] } else { &[] });
            used.extend(if outputs.depth { &[7][..] } else { &[] });
            used.extend(if outputs.canonical { &[3, 8][..] } else { &[] });
            run_at(self.gpu, pass, kernel, &numbered(&resources, &used), self.blended.into());
        }
    }
}

/// The resources that a kernel uses, with the numbers of their bindings.
fn numbered<'a>(resources: &[BindingResource<'a>], used: &[u32]) -> Vec<(u32, BindingResource<'a>)> {
    used.iter().filter_map(|&binding| Some((binding, resources.get(binding as usize)?.clone()))).collect()
}

#[cfg(test)]
#[path = "raster_list_tests.rs"]
mod tests;
