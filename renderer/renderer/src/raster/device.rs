//! Forward rasteriser on the device: projection through the camera's lens (EWA splatting), stable sort by depth, lists
//! by tile, and front-to-back blending, without waiting for the device.

use std::sync::Arc;

use bytemuck::bytes_of;
use flyrig_gpu::{CameraConstants, ComputeKernel, GpuContext, GpuError, GpuTimer, StorageBuffer, dispatch_1d};
use flyrig_types::Camera;
use wgpu::{BindingResource, BufferBinding, BufferSize, CommandEncoder, ComputePass, ComputePassDescriptor};

use crate::anisotropic::buffers::Gaussians;
use crate::buffers::RenderTarget;
use crate::constants::Constants;
use crate::raster::buffers::{ImageBuffers, Layout};
use crate::raster::kernels::{BINS_LANES, FrameConstants, RasterKernels, Tile};
use crate::raster::settings::{Latest, tile_range};
use crate::raster::settings::{Outputs, RasterSettings, RasterStats};
use crate::sort::radix::{DIGIT_BITS, KEY_BITS, Keys, MOST_ELEMENTS, RadixSort, SortPass, blocks, table_len};
use crate::sort::scan::{Scan, Workgroups, run, run_at};

/// [`Rasterizer`](crate::Rasterizer) on the device. Buffers and pipelines are created once and grow with the image and
/// the number of Gaussians.
#[derive(Debug)]
pub(crate) struct DeviceRasterizer {
    pub(crate) kernels: RasterKernels,
    scan: Scan,
    pub(crate) sort: RadixSort,
    pub(crate) splats: StorageBuffer<[f32; 8]>,
    pub(crate) rects: StorageBuffer<[u32; 2]>,
    /// Colours of anisotropic Gaussians as seen from the camera; allocated with the first image of such Gaussians.
    pub(crate) painted: StorageBuffer<[f32; 4]>,
    /// Planes of anisotropic Gaussians; allocated with the first image that draws them.
    pub(crate) planes: StorageBuffer<[f32; 8]>,
    pub(crate) pairs_before: StorageBuffer<u32>,
    pair_total: StorageBuffer<u32>,
    /// `struct Work` of bins.wgsl.
    work: StorageBuffer<u32>,
    stats: StorageBuffer<u32>,
    /// Constants of the image recorded last.
    pub(crate) constants: Constants,
    pub(crate) picture: Option<ImageBuffers>,
    pub(crate) latest: Option<Latest>,
}

impl DeviceRasterizer {
    pub(crate) fn new(gpu: &GpuContext, max_gaussians: usize) -> Result<Self, GpuError> {
        Self::with_tile(gpu, max_gaussians, Tile::for_adapter(gpu))
    }

    pub(crate) fn with_tile(gpu: &GpuContext, max_gaussians: usize, tile: Tile) -> Result<Self, GpuError> {
        check_count(max_gaussians)?;
        let mut constants = vec![size_of::<FrameConstants>()];
        constants.resize(DEPTH_PASSES, size_of::<[u32; 4]>());
        constants.resize(TILE_PASSES + MOST_TILE_PASSES, size_of::<SortPass>());
        Ok(Self {
            constants: Constants::new(gpu, &constants)?,
            kernels: RasterKernels::new(gpu, tile),
            scan: Scan::new(gpu)?,
            sort: RadixSort::new(gpu, max_gaussians)?,
            splats: StorageBuffer::zeroed(gpu, "splats", max_gaussians)?,
            rects: StorageBuffer::zeroed(gpu, "splat rectangles", max_gaussians)?,
            painted: StorageBuffer::zeroed(gpu, "painted splats", 0)?,
            planes: StorageBuffer::zeroed(gpu, "planes", 0)?,
            pairs_before: StorageBuffer::zeroed(gpu, "pairs before", max_gaussians)?,
            pair_total: StorageBuffer::zeroed(gpu, "pair total", 1)?,
            work: StorageBuffer::zeroed(gpu, "work on pairs", 12)?,
            stats: StorageBuffer::zeroed(gpu, "raster statistics", 3)?,
            picture: None,
            latest: None,
        })
    }

    pub(crate) fn encode_timed(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: Gaussians<'_>,
        (camera, settings): (&Camera, &RasterSettings),
        target: &RenderTarget,
        mut timer: Option<&mut GpuTimer>,
    ) -> Result<(), GpuError> {
        self.latest = None;
        if target.width == 0 || target.height == 0 {
            return Ok(());
        }
        self.grow(gpu, gaussians, target)?;
        if settings.outputs.planes && gaussians.count() > self.planes.len() {
            self.planes = StorageBuffer::zeroed(gpu, "planes", gaussians.count())?;
        }
        let Some(picture) = &self.picture else { return Ok(()) };
        let layout = picture.layout();
        let (first_tile, blended) = tile_range(settings.area, layout.tiles, self.kernels.tile.0);
        let frame = FrameConstants {
            camera: CameraConstants::from(camera),
            size: [target.width, target.height],
            tiles: layout.tiles,
            gaussians: gaussians.count() as u32,
            cull_backfacing: settings.cull_backfacing.into(),
            with_canonical: settings.outputs.canonical.into(),
            pair_capacity: layout.pair_capacity,
            near_m: settings.near_m,
            filter_variance_px2: settings.filter_variance_px2,
            filter_keeps_opacity: settings.filter_keeps_opacity.into(),
            unused: 0,
            first_tile,
            unused_too: [0; 2],
        };
        self.encode_constants(gpu, encoder, &frame, layout);
        self.sort.prepare(encoder);
        let blend = self.kernels.blend(gpu, settings.outputs);
        let outputs = settings.outputs;
        let stages = Stages { gpu, rasterizer: self, gaussians, target, picture, blended, outputs };
        let mut pass = |name, record: &dyn Fn(&mut ComputePass<'_>)| {
            let timestamp_writes = timer.as_mut().and_then(|timer| timer.stage(name));
            record(&mut encoder.begin_compute_pass(&ComputePassDescriptor { label: Some(name), timestamp_writes }));
        };
        pass("project", &|pass| stages.project(pass));
        pass("depth sort", &|pass| stages.depth_sort(pass));
        pass("tile lists", &|pass| stages.tile_lists(pass));
        pass("blend", &|pass| stages.blend(pass, &blend));
        let (count, order) = (gaussians.count(), gaussians.order());
        self.latest = Some(Latest { gaussians: count, order, size: frame.size, blended, outputs });
        Ok(())
    }

    pub(crate) fn stats(&self, gpu: &GpuContext) -> Result<RasterStats, GpuError> {
        let stats = self.stats.read(gpu)?;
        let get = |i: usize| stats.get(i).copied().unwrap_or_default();
        Ok(RasterStats { visible_gaussians: get(0), pairs: get(1), overflowed_images: get(2) })
    }

    fn grow(&mut self, gpu: &GpuContext, gaussians: Gaussians<'_>, target: &RenderTarget) -> Result<(), GpuError> {
        let count = gaussians.count();
        check_count(count)?;
        if gaussians.order().is_some() && count > self.painted.len() {
            self.painted = StorageBuffer::zeroed(gpu, "painted splats", count)?;
        }
        if count > self.splats.len() {
            self.sort.grow(gpu, count)?;
            self.rects = StorageBuffer::zeroed(gpu, "splat rectangles", count)?;
            self.pairs_before = StorageBuffer::zeroed(gpu, "pairs before", count)?;
            self.splats = StorageBuffer::zeroed(gpu, "splats", count)?;
        }
        let size = [target.width, target.height];
        let tile = self.kernels.tile;
        match &mut self.picture {
            Some(picture) => picture.fit(gpu, tile, size, self.splats.len()),
            none => {
                *none = Some(ImageBuffers::new(gpu, tile, size, self.splats.len())?);
                Ok(())
            }
        }
    }

    fn encode_constants(&self, gpu: &GpuContext, encoder: &mut CommandEncoder, frame: &FrameConstants, layout: Layout) {
        let (count, pairs) = (frame.gaussians as usize, layout.pair_capacity as usize);
        let lengths = [frame.gaussians, table_len(count)].map(|length| [length, 0, 0, 0]);
        let passes = |count, keys: Keys| (0..keys.passes()).map(move |index| SortPass::new(count, keys, index));
        let passes: Vec<SortPass> = passes(count, Keys::Scaled).chain(passes(pairs, layout.keys())).collect();
        let mut values = vec![bytes_of(frame)];
        values.extend(lengths.iter().map(bytes_of));
        values.extend(passes.iter().map(bytes_of));
        self.constants.encode(gpu, encoder, &values);
    }
}

/// Rejects more Gaussians than can be sorted.
fn check_count(count: usize) -> Result<(), GpuError> {
    let bytes = |count: usize| count as u64 * size_of::<[u32; 2]>() as u64;
    if count > MOST_ELEMENTS {
        let what = format!("the depth sort of {count} Gaussians");
        return Err(GpuError::TooLarge { what, needed: bytes(count), limit: bytes(MOST_ELEMENTS) });
    }
    Ok(())
}

/// Indices into the [`Constants`] of one encoding: the frame, lengths of the scanned arrays, passes of the sorts.
pub(crate) const FRAME: usize = 0;
const RANKS: usize = 1;
const DEPTH_TABLE: usize = 2;
const DEPTH_PASSES: usize = 3;
const TILE_PASSES: usize = DEPTH_PASSES + KEY_BITS.div_ceil(DIGIT_BITS) as usize;
const MOST_TILE_PASSES: usize = u32::BITS.div_ceil(DIGIT_BITS) as usize;

/// Resources that the kernels of one image are bound to.
struct Stages<'a> {
    gpu: &'a GpuContext,
    rasterizer: &'a DeviceRasterizer,
    gaussians: Gaussians<'a>,
    target: &'a RenderTarget,
    picture: &'a ImageBuffers,
    blended: [u32; 2],
    outputs: Outputs,
}

impl Stages<'_> {
    fn project(&self, pass: &mut ComputePass<'_>) {
        let r = self.rasterizer;
        let (gpu, groups) = (self.gpu, dispatch_1d(self.gaussians.count() as u32, 64));
        let (frame, keyed) = (r.constants.get(FRAME), r.sort.input().raw().as_entire_binding());
        let (splats, rects) = (r.splats.raw().as_entire_binding(), r.rects.raw().as_entire_binding());
        match self.gaussians {
            Gaussians::Isotropic(g) => {
                let [center_scale, normal, color, canonical] = g.attributes().map(|a| a.raw().as_entire_binding());
                let resources = [frame, center_scale, normal, color, canonical, splats, rects, keyed];
                run(gpu, pass, &r.kernels.project, &resources, groups);
            }
            Gaussians::Anisotropic(g) => {
                let [center, scale, rotation, harmonics] = g.attributes().map(|a| a.raw().as_entire_binding());
                // Bound, and not read, where there is no surface.
                let normal = g.surface.as_ref().map_or(&g.center, |surface| &surface.normal).raw().as_entire_binding();
                let (frame_, center_, keyed_) = (frame.clone(), center.clone(), keyed.clone());
                let (scale_, rotation_) = (scale.clone(), rotation.clone());
                let resources = [frame_, center_, scale_, rotation_, normal, splats, rects, keyed_];
                run(gpu, pass, r.kernels.project_anisotropic(gpu), &resources, groups);
                let painted = r.painted.raw().as_entire_binding();
                let resources = [frame.clone(), center.clone(), harmonics, keyed.clone(), painted];
                run(gpu, pass, r.kernels.paint(gpu, g.order()), &resources, groups);
                if self.outputs.planes {
                    let planes = r.planes.raw().as_entire_binding();
                    let resources = [frame, center, scale, rotation, keyed, planes];
                    run(gpu, pass, r.kernels.planes(gpu), &resources, groups);
                }
            }
        }
    }

    fn depth_sort(&self, pass: &mut ComputePass<'_>) {
        let (r, sorted) = (self.rasterizer, ((blocks(self.gaussians.count()), 1).into(), Keys::Scaled));
        let passes = self.passes(DEPTH_PASSES, Keys::Scaled);
        r.sort.encode(self.gpu, pass, sorted, &r.scan, &passes, &r.constants.get(DEPTH_TABLE));
    }

    fn passes(&self, first: usize, keys: Keys) -> Vec<BindingResource<'_>> {
        (0..keys.passes() as usize).map(|index| self.rasterizer.constants.get(first + index)).collect()
    }

    fn tile_lists(&self, pass: &mut ComputePass<'_>) {
        let (r, p) = (self.rasterizer, self.picture);
        let layout = p.layout();
        let mut resources: [BindingResource<'_>; 11] = [
            r.constants.get(FRAME),
            r.sort.output(Keys::Scaled).raw().as_entire_binding(),
            r.sort.valid().raw().as_entire_binding(),
            r.rects.raw().as_entire_binding(),
            r.pairs_before.raw().as_entire_binding(),
            r.pair_total.raw().as_entire_binding(),
            p.sort.valid().raw().as_entire_binding(),
            p.sort.input().raw().as_entire_binding(),
            p.ends.raw().as_entire_binding(),
            r.stats.raw().as_entire_binding(),
            r.work.raw().as_entire_binding(),
        ];
        let k = &r.kernels;
        let ranks = dispatch_1d(self.gaussians.count() as u32, BINS_LANES);
        run_at(self.gpu, pass, &k.count_pairs, &numbered(&resources, &[0, 1, 2, 3, 4]), ranks);
        r.scan.encode(self.gpu, pass, &r.constants.get(RANKS), &r.pairs_before, &r.pair_total);
        run_at(self.gpu, pass, &k.keep_pairs, &numbered(&resources, &[0, 2, 4, 5, 6, 9, 10]), (1, 1));
        let pairs = Workgroups::Counted(&r.work, 16);
        run_at(self.gpu, pass, &k.write_pairs, &numbered(&resources, &[0, 1, 2, 3, 4, 6, 7]), pairs);
        let passes = self.passes(TILE_PASSES, layout.keys());
        let length = BufferBinding { buffer: r.work.raw(), offset: 0, size: BufferSize::new(16) };
        let sorted = (Workgroups::Counted(&r.work, 32), layout.keys());
        p.sort.encode(self.gpu, pass, sorted, &r.scan, &passes, &BindingResource::Buffer(length));
        resources[7] = p.lists().raw().as_entire_binding();
        let tiles = dispatch_1d(layout.tile_count(), BINS_LANES);
        run_at(self.gpu, pass, &k.end_lists, &numbered(&resources, &[0, 6, 7, 8]), tiles);
    }

    fn blend(&self, pass: &mut ComputePass<'_>, kernels: &[(Outputs, Arc<ComputeKernel>)]) {
        let (r, p, t) = (self.rasterizer, self.picture, self.target);
        let (color, canonical) = match self.gaussians {
            Gaussians::Isotropic(g) => (&g.color, &g.canonical),
            // No kernel binds canonical positions where there is no surface.
            Gaussians::Anisotropic(g) => {
                (&r.painted, g.surface.as_ref().map_or(&r.painted, |surface| &surface.canonical))
            }
        };
        let resources = [
            r.constants.get(FRAME),
            r.splats.raw().as_entire_binding(),
            color.raw().as_entire_binding(),
            canonical.raw().as_entire_binding(),
            p.ends.raw().as_entire_binding(),
            p.lists().raw().as_entire_binding(),
            t.color.raw().as_entire_binding(),
            t.depth.raw().as_entire_binding(),
            t.canonical.raw().as_entire_binding(),
            r.planes.raw().as_entire_binding(),
            // No kernel binds planes where there is no image of them.
            t.planes.as_ref().unwrap_or(&t.color).raw().as_entire_binding(),
        ];
        for (outputs, kernel) in kernels {
            let mut used = vec![0, 1, 4, 5];
            used.extend(if outputs.color { &[2, 6][..] } else { &[] });
            used.extend(if outputs.depth { &[7][..] } else { &[] });
            used.extend(if outputs.canonical { &[3, 8][..] } else { &[] });
            used.extend(if outputs.planes { &[9, 10][..] } else { &[] });
            run_at(self.gpu, pass, kernel, &numbered(&resources, &used), <(u32, u32)>::from(self.blended));
        }
    }
}

/// Selects the resources that a kernel uses, with their binding numbers.
fn numbered<'a>(resources: &[BindingResource<'a>], used: &[u32]) -> Vec<(u32, BindingResource<'a>)> {
    used.iter().filter_map(|&binding| Some((binding, resources.get(binding as usize)?.clone()))).collect()
}

#[cfg(test)]
#[path = "list_tests.rs"]
mod tests;
