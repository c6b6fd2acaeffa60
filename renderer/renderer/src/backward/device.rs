//! Backward rasteriser on the device.

use std::sync::OnceLock;

use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer, dispatch_1d};
use wgpu::{CommandEncoder, ComputePass, ComputePassDescriptor};

use crate::anisotropic::order::HarmonicOrder;
use crate::backward::gradients::{Carry, ImageGradients};
use crate::backward::kernels::{self, Depths};
use crate::backward::target::GradientTarget;
use crate::buffers::RenderTarget;
use crate::raster::buffers::ImageBuffers;
use crate::raster::device::{DeviceRasterizer, FRAME};
use crate::raster::kernels::Tile;
use crate::raster::settings::Latest;
use crate::sort::radix::Keys;
use crate::sort::scan::{run, run_at};

/// [`BackwardRasterizer`](crate::BackwardRasterizer) on the device.
#[derive(Debug)]
pub(crate) struct DeviceBackward {
    place: ComputeKernel,
    /// Without and with depth, as in all arrays of blending kernels.
    blend: [ComputeKernel; 2],
    sum: ComputeKernel,
    project: [ComputeKernel; 2],
    /// Compiled on first use.
    anisotropic: OnceLock<AnisotropicKernels>,
    /// Compiled on first use.
    planes: OnceLock<PlaneKernels>,
    places: StorageBuffer<[u32; 4]>,
    tile_limits: StorageBuffer<u32>,
    /// Three or five elements per pair, [`kernels::vectors`].
    pair_sums: StorageBuffer<[f32; 4]>,
    /// Number of pairs that `pair_sums` has room for, in x; reallocated with it.
    room: StorageBuffer<[u32; 4]>,
    pairs: usize,
    /// Sums per Gaussian, as many elements as per pair.
    sums: StorageBuffer<[f32; 4]>,
}

/// Depths by index of the kernels for images without derivatives by planes.
const CENTER_DEPTHS: [Depths; 2] = [Depths::None, Depths::Centers];

#[derive(Debug)]
struct AnisotropicKernels {
    blend: [ComputeKernel; 2],
    project: ComputeKernel,
    /// One kernel per harmonic order.
    paint: [ComputeKernel; 3],
}

impl AnisotropicKernels {
    fn new(gpu: &GpuContext) -> Self {
        let tile = Tile::for_adapter(gpu);
        Self {
            blend: CENTER_DEPTHS.map(|depths| kernel(gpu, "blend_backward", &kernels::blend_wgsl(tile, depths, true))),
            project: kernel(gpu, "project_backward", &kernels::project_anisotropic_wgsl(false)),
            paint: HarmonicOrder::ALL.map(|order| kernel(gpu, "paint_backward", &kernels::paint_wgsl(order, false))),
        }
    }
}

/// Kernels for images with derivatives by planes.
#[derive(Debug)]
struct PlaneKernels {
    blend: ComputeKernel,
    sum: ComputeKernel,
    project: ComputeKernel,
    /// One kernel per harmonic order.
    paint: [ComputeKernel; 3],
}

impl PlaneKernels {
    fn new(gpu: &GpuContext) -> Self {
        let blend = kernels::blend_wgsl(Tile::for_adapter(gpu), Depths::Planes, true);
        Self {
            blend: kernel(gpu, "blend_backward", &blend),
            sum: kernel(gpu, "sum_tiles", &kernels::sums_wgsl(true)),
            project: kernel(gpu, "project_backward", &kernels::project_anisotropic_wgsl(true)),
            paint: HarmonicOrder::ALL.map(|order| kernel(gpu, "paint_backward", &kernels::paint_wgsl(order, true))),
        }
    }
}

fn kernel(gpu: &GpuContext, entry: &str, source: &str) -> ComputeKernel {
    ComputeKernel::new(gpu, entry, &[source], entry)
}

/// Image whose derivative is recorded.
struct View<'a> {
    gpu: &'a GpuContext,
    rasterizer: &'a DeviceRasterizer,
    picture: &'a ImageBuffers,
    latest: Latest,
    target: &'a RenderTarget,
    incoming: &'a ImageGradients,
    /// Drawn planes and dL/d planes, where the derivatives are by planes as well.
    planes: Option<[&'a StorageBuffer<[f32; 4]>; 2]>,
}

impl DeviceBackward {
    pub(crate) fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let tile = Tile::for_adapter(gpu);
        Ok(Self {
            place: kernel(gpu, "place_gaussians", &kernels::places_wgsl()),
            blend: CENTER_DEPTHS.map(|depths| kernel(gpu, "blend_backward", &kernels::blend_wgsl(tile, depths, false))),
            sum: kernel(gpu, "sum_tiles", &kernels::sums_wgsl(false)),
            project: [false, true].map(|lift| kernel(gpu, "project_backward", &kernels::project_wgsl(lift))),
            anisotropic: OnceLock::new(),
            planes: OnceLock::new(),
            places: StorageBuffer::zeroed(gpu, "places of sums", 0)?,
            tile_limits: StorageBuffer::zeroed(gpu, "walked tiles", 0)?,
            pair_sums: StorageBuffer::zeroed(gpu, "sums of pairs", 0)?,
            room: StorageBuffer::zeroed(gpu, "room for sums of pairs", 1)?,
            pairs: 0,
            sums: StorageBuffer::zeroed(gpu, "sums of Gaussians", 0)?,
        })
    }

    pub(crate) fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        rasterizer: &DeviceRasterizer,
        target: &RenderTarget,
        incoming: &ImageGradients,
        to: GradientTarget<'_>,
    ) -> Result<(), GpuError> {
        let (Some(picture), Some(latest)) = (&rasterizer.picture, rasterizer.latest) else { return Ok(()) };
        let layout = picture.layout();
        let tiles = layout.tiles[0] as usize * layout.tiles[1] as usize;
        let planes = match (&target.planes, &incoming.planes) {
            (Some(drawn), Some(incoming)) if latest.outputs.planes => Some([drawn, incoming]),
            _ => None,
        };
        self.grow(gpu, &latest, tiles, (layout.pair_capacity, kernels::vectors(planes.is_some())))?;

        encoder.clear_buffer(self.places.raw(), 0, None);
        // Tiles that are not blended have walked nothing.
        encoder.clear_buffer(self.tile_limits.raw(), 0, None);
        let view = View { gpu, rasterizer, picture, latest, target, incoming, planes };
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("backward"), ..Default::default() });
        self.place(&view, &mut pass);
        self.blend(&view, &mut pass, to);
        self.sum(&view, &mut pass);
        self.project(&view, &mut pass, to);
        Ok(())
    }

    fn place(&self, view: &View<'_>, pass: &mut ComputePass<'_>) {
        let r = view.rasterizer;
        let resources = [
            r.constants.get(FRAME),
            self.room.raw().as_entire_binding(),
            r.sort.output(Keys::Scaled).raw().as_entire_binding(),
            r.sort.valid().raw().as_entire_binding(),
            r.rects.raw().as_entire_binding(),
            r.pairs_before.raw().as_entire_binding(),
            self.places.raw().as_entire_binding(),
        ];
        run(view.gpu, pass, &self.place, &resources, view.by_gaussian());
    }

    fn blend(&self, view: &View<'_>, pass: &mut ComputePass<'_>, to: GradientTarget<'_>) {
        let (kernels, color) = match to {
            GradientTarget::Isotropic { gaussians, .. } => (&self.blend, &gaussians.color),
            GradientTarget::Anisotropic { .. } => (&self.anisotropic(view.gpu).blend, &view.rasterizer.painted),
        };
        let resources = [
            view.rasterizer.constants.get(FRAME),
            view.rasterizer.splats.raw().as_entire_binding(),
            color.raw().as_entire_binding(),
            view.picture.ends.raw().as_entire_binding(),
            view.picture.lists().raw().as_entire_binding(),
            self.places.raw().as_entire_binding(),
            view.target.color.raw().as_entire_binding(),
            view.target.depth.raw().as_entire_binding(),
            view.incoming.color.raw().as_entire_binding(),
            view.incoming.depth_carry.raw().as_entire_binding(),
            self.pair_sums.raw().as_entire_binding(),
            self.tile_limits.raw().as_entire_binding(),
        ];
        if let Some([drawn, incoming]) = view.planes {
            let planes = [&view.rasterizer.planes.raw(), &drawn.raw(), &incoming.raw()].map(|b| b.as_entire_binding());
            let numbered = (0..).zip(resources).filter(|(binding, _)| ![7, 9].contains(binding));
            let resources: Vec<_> = numbered.chain((12..).zip(planes)).collect();
            let kernel = &self.planes(view.gpu).blend;
            return run_at(view.gpu, pass, kernel, &resources, <(u32, u32)>::from(view.latest.blended));
        }
        let kernel = &kernels[usize::from(view.latest.outputs.depth)];
        run(view.gpu, pass, kernel, &resources, <(u32, u32)>::from(view.latest.blended));
    }

    fn sum(&self, view: &View<'_>, pass: &mut ComputePass<'_>) {
        let resources = [
            view.rasterizer.constants.get(FRAME),
            self.places.raw().as_entire_binding(),
            self.tile_limits.raw().as_entire_binding(),
            self.pair_sums.raw().as_entire_binding(),
            self.sums.raw().as_entire_binding(),
        ];
        let kernel = if view.planes.is_some() { &self.planes(view.gpu).sum } else { &self.sum };
        run(view.gpu, pass, kernel, &resources, view.by_gaussian());
    }

    fn project(&self, view: &View<'_>, pass: &mut ComputePass<'_>, to: GradientTarget<'_>) {
        let (gpu, groups, frame) = (view.gpu, view.by_gaussian(), view.rasterizer.constants.get(FRAME));
        let sums = self.sums.raw().as_entire_binding();
        match to {
            GradientTarget::Isotropic { gaussians, carry, out } => {
                let kernel = &self.project[usize::from(carry == Carry::Lift)];
                let buffers = [&gaussians.center_scale, &out.center, &out.carried];
                let [center_scale, center, carried] = buffers.map(|buffer| buffer.raw().as_entire_binding());
                run(gpu, pass, kernel, &[frame, sums, center_scale, center, carried], groups);
            }
            GradientTarget::Anisotropic { gaussians, out } => {
                let (project, paint) = if view.planes.is_some() {
                    let kernels = self.planes(gpu);
                    (&kernels.project, &kernels.paint)
                } else {
                    let kernels = self.anisotropic(gpu);
                    (&kernels.project, &kernels.paint)
                };
                let [center, scale, rotation, harmonics] =
                    gaussians.attributes().map(|buffer| buffer.raw().as_entire_binding());
                let [center_out, scale_out, rotation_out, harmonics_out] =
                    out.attributes().map(|buffer| buffer.raw().as_entire_binding());
                let inputs = [frame.clone(), sums.clone(), center.clone(), scale, rotation];
                let resources: Vec<_> =
                    inputs.into_iter().chain([center_out.clone(), scale_out, rotation_out]).collect();
                run(gpu, pass, project, &resources, groups);
                let kernel = &paint[gaussians.order() as usize];
                let resources = [frame, center, harmonics, sums, center_out, harmonics_out];
                run(gpu, pass, kernel, &resources, groups);
            }
        }
    }

    fn anisotropic(&self, gpu: &GpuContext) -> &AnisotropicKernels {
        self.anisotropic.get_or_init(|| AnisotropicKernels::new(gpu))
    }

    fn planes(&self, gpu: &GpuContext) -> &PlaneKernels {
        self.planes.get_or_init(|| PlaneKernels::new(gpu))
    }

    fn grow(
        &mut self,
        gpu: &GpuContext,
        latest: &Latest,
        tiles: usize,
        (pairs, vectors): (u32, usize),
    ) -> Result<(), GpuError> {
        if self.places.len() < latest.gaussians {
            self.places = StorageBuffer::zeroed(gpu, "places of sums", latest.gaussians)?;
        }
        if self.sums.len() < vectors * latest.gaussians {
            self.sums = StorageBuffer::zeroed(gpu, "sums of Gaussians", vectors * latest.gaussians)?;
        }
        if self.tile_limits.len() < tiles {
            self.tile_limits = StorageBuffer::zeroed(gpu, "walked tiles", tiles)?;
        }
        let limits = gpu.device.limits();
        let most = limits.max_buffer_size.min(limits.max_storage_buffer_binding_size)
            / (vectors as u64 * kernels::VECTOR_BYTES);
        let wanted = u64::from(pairs).min(most) as usize;
        if self.pairs < wanted || self.pair_sums.len() < vectors * self.pairs.max(wanted) {
            self.pair_sums = StorageBuffer::zeroed(gpu, "sums of pairs", vectors * wanted)?;
            self.room = StorageBuffer::from_slice(gpu, "room for sums of pairs", &[[wanted as u32, 0, 0, 0]])?;
            self.pairs = wanted;
        }
        Ok(())
    }
}

impl View<'_> {
    fn by_gaussian(&self) -> (u32, u32) {
        dispatch_1d(self.latest.gaussians as u32, 64)
    }
}
