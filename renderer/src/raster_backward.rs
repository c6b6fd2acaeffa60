//! Backward splat rasteriser: what a change of the Gaussians does to a loss on the images.

use flyrig_gpu::{CAMERA_WGSL, ComputeKernel, GpuContext, GpuError, StorageBuffer, dispatch_1d};
use wgpu::{CommandEncoder, ComputePassDescriptor};

use crate::processor::ProcessorBackward;
use crate::raster::RasterizerOn;
use crate::raster_device::{DeviceRasterizer, FRAME};
use crate::raster_kernels::{BUSY_WGSL, FRAME_WGSL, Tile};
use crate::scan::run;
use crate::sort::Keys;
use crate::{Carry, GaussianBuffers, GaussianGradients, ImageGradients, Rasterizer, RenderTarget};

const BACKWARD_FRAME_WGSL: &str = include_str!("raster_backward_frame.wgsl");
const PLACES_WGSL: &str = include_str!("raster_backward_places.wgsl");
const BLEND_WGSL: &str = include_str!("raster_backward_blend.wgsl");
const PROJECT_WGSL: &str = include_str!("raster_backward_project.wgsl");

/// Bytes of `struct PairSum`.
const PAIR_SUM_BYTES: u64 = 48;
/// Pairs that one tile's invocations walk over; each costs them about two iterations, and Mesa's software adapter ends all loops
/// of an invocation after 65,535 iterations together, without a word.
const MAX_LIST: u32 = 24_576;
/// Tiles that one Gaussian adds up, for the same reason.
const MAX_TILES: u32 = 60_000;
/// Bytes of workgroup memory for partial sums; WebGPU promises 16 KiB.
const PARTIAL_BYTES: u32 = 12 << 10;

/// Why there is no derivative.
#[derive(Debug, thiserror::Error)]
pub enum BackwardError {
    /// Buffers must grow and cannot.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A buffer does not belong to the image that was drawn last.
    #[error("{what}: {found} elements where the image drawn last needs {needed}; make it for that image")]
    Buffer {
        /// Which buffer.
        what: &'static str,
        /// Its elements.
        found: usize,
        /// Elements needed.
        needed: usize,
    },
}

/// Derivatives of [`Rasterizer`]'s images with respect to the centres of the Gaussians (FlyHuman section 3.1).
///
/// - Complete where the image is smooth: place, depth, and the size and shape of the ellipse, through the lens and
///   the low-pass filter. What jumps passes nothing on: a splat that enters or leaves a pixel at alpha 1/255, a pixel
///   that is finished, the order by depth, back-face culling; at the clamp (alpha 0.99) alpha itself is constant. On
///   the built-in body the jumps are 4 to 6 % of the loss's true slope (`bench_backward`).
/// - No atomics: the sums of a tile go to a slot of their own and are added up row by row. Equal input gives equal
///   bytes on one device.
/// - A tile without a gradient costs the look at its pixels; a Gaussian without a pixel that matters costs nothing
///   but a look at its tiles.
/// - A Gaussian on more than 60,000 tiles, or behind the first 24,576 of a tile's list, gets nothing there. Sums that
///   are not finite are left out.
#[derive(Debug)]
pub struct BackwardRasterizer {
    on: BackwardOn,
}

#[derive(Debug)]
enum BackwardOn {
    Device(Box<DeviceBackward>),
    Processor(ProcessorBackward),
}

/// The kernels on the device.
#[derive(Debug)]
struct DeviceBackward {
    place: ComputeKernel,
    blend: [ComputeKernel; 2],
    project: [ComputeKernel; 2],
    places: StorageBuffer<[u32; 4]>,
    tile_limits: StorageBuffer<u32>,
    pair_sums: StorageBuffer<[[f32; 4]; 3]>,
    /// Elements of `pair_sums`, in x; made again with it.
    room: StorageBuffer<[u32; 4]>,
}

impl BackwardRasterizer {
    /// Compiles the kernels for images of any [`Rasterizer::new`] with this context; buffers grow with the images.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let on = if gpu.is_on_processor() {
            BackwardOn::Processor(ProcessorBackward::default())
        } else {
            BackwardOn::Device(Box::new(DeviceBackward::new(gpu)?))
        };
        Ok(Self { on })
    }

    /// Records the derivatives of the image that `rasterizer` recorded last, with the same `gaussians` and
    /// `target`, and adds them to `out`. Views of one submission: encode a view, its loss, its derivative, the next
    /// view. Without an image before, or with one without colour, nothing is recorded.
    ///
    /// # Errors
    /// [`BackwardError`]; nothing is recorded then.
    #[allow(clippy::too_many_arguments)]
    pub fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        rasterizer: &Rasterizer,
        gaussians: &GaussianBuffers,
        target: &RenderTarget,
        (incoming, carry): (&ImageGradients, Carry),
        out: &GaussianGradients,
    ) -> Result<(), BackwardError> {
        let Some(latest) = rasterizer.latest() else { return Ok(()) };
        if !latest.outputs.color || latest.gaussians == 0 {
            return Ok(());
        }
        let pixels = latest.size[0] as usize * latest.size[1] as usize;
        check("dL/d colour", incoming.color.len(), pixels)?;
        check("dL/d depth", incoming.depth_carry.len(), pixels)?;
        check("the drawn image", target.color.len().min(target.depth.len()), pixels)?;
        check("the Gaussians", gaussians.count(), latest.gaussians)?;
        check("dL/d centres", out.center.len().min(out.carried.len() / 2), latest.gaussians)?;
        match (&mut self.on, &rasterizer.on) {
            (BackwardOn::Device(device), RasterizerOn::Device(rasterizer)) => {
                device.encode(gpu, encoder, rasterizer, gaussians, target, (incoming, carry), out)
            }
            (BackwardOn::Processor(processor), RasterizerOn::Processor(rasterizer)) => {
                processor.add(rasterizer, gaussians, target, (incoming, carry), out);
                Ok(())
            }
            _ => Ok(()),
        }
    }
}

impl DeviceBackward {
    fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let tile = Tile::for_adapter(gpu);
        let kernel = |entry, source: String| ComputeKernel::new(gpu, entry, &[&source], entry);
        Ok(Self {
            place: kernel("place_gaussians", places_wgsl()),
            blend: [false, true].map(|depth| kernel("blend_backward", blend_wgsl(tile, depth))),
            project: [false, true].map(|lift| kernel("project_backward", project_wgsl(lift))),
            places: StorageBuffer::zeroed(gpu, "places of sums", 0)?,
            tile_limits: StorageBuffer::zeroed(gpu, "walked tiles", 0)?,
            pair_sums: StorageBuffer::zeroed(gpu, "sums of pairs", 0)?,
            room: StorageBuffer::zeroed(gpu, "room for sums of pairs", 1)?,
        })
    }

    #[allow(clippy::too_many_arguments)]
    fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        rasterizer: &DeviceRasterizer,
        gaussians: &GaussianBuffers,
        target: &RenderTarget,
        (incoming, carry): (&ImageGradients, Carry),
        out: &GaussianGradients,
    ) -> Result<(), BackwardError> {
        let (Some(picture), Some(latest)) = (&rasterizer.picture, &rasterizer.latest) else { return Ok(()) };
        let layout = picture.layout();
        let tiles = layout.tiles[0] as usize * layout.tiles[1] as usize;
        self.grow(gpu, latest.gaussians, tiles, layout.pair_capacity)?;

        encoder.clear_buffer(self.places.raw(), 0, None);
        // Tiles that are not blended have walked nothing.
        encoder.clear_buffer(self.tile_limits.raw(), 0, None);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("backward"), ..Default::default() });
        let by_gaussian = dispatch_1d(latest.gaussians as u32, 64);
        run(
            gpu,
            &mut pass,
            &self.place,
            &[
                rasterizer.constants.get(FRAME),
                self.room.raw().as_entire_binding(),
                rasterizer.sort.output(Keys::Scaled).raw().as_entire_binding(),
                rasterizer.sort.valid().raw().as_entire_binding(),
                rasterizer.rects.raw().as_entire_binding(),
                rasterizer.pairs_before.raw().as_entire_binding(),
                self.places.raw().as_entire_binding(),
            ],
            by_gaussian,
        );
        run(
            gpu,
            &mut pass,
            &self.blend[usize::from(latest.outputs.depth)],
            &[
                rasterizer.constants.get(FRAME),
                rasterizer.splats.raw().as_entire_binding(),
                gaussians.color.raw().as_entire_binding(),
                picture.ends.raw().as_entire_binding(),
                picture.lists().raw().as_entire_binding(),
                self.places.raw().as_entire_binding(),
                target.color.raw().as_entire_binding(),
                target.depth.raw().as_entire_binding(),
                incoming.color.raw().as_entire_binding(),
                incoming.depth_carry.raw().as_entire_binding(),
                self.pair_sums.raw().as_entire_binding(),
                self.tile_limits.raw().as_entire_binding(),
            ],
            <(u32, u32)>::from(latest.blended),
        );
        run(
            gpu,
            &mut pass,
            &self.project[usize::from(carry == Carry::Lift)],
            &[
                rasterizer.constants.get(FRAME),
                gaussians.center_scale.raw().as_entire_binding(),
                self.places.raw().as_entire_binding(),
                self.tile_limits.raw().as_entire_binding(),
                self.pair_sums.raw().as_entire_binding(),
                out.center.raw().as_entire_binding(),
                out.carried.raw().as_entire_binding(),
            ],
            by_gaussian,
        );
        Ok(())
    }

    fn grow(&mut self, gpu: &GpuContext, gaussians: usize, tiles: usize, pairs: u32) -> Result<(), GpuError> {
        if self.places.len() < gaussians {
            self.places = StorageBuffer::zeroed(gpu, "places of sums", gaussians)?;
        }
        if self.tile_limits.len() < tiles {
            self.tile_limits = StorageBuffer::zeroed(gpu, "walked tiles", tiles)?;
        }
        let limits = gpu.device.limits();
        let most = limits.max_buffer_size.min(limits.max_storage_buffer_binding_size) / PAIR_SUM_BYTES;
        let wanted = u64::from(pairs).min(most) as usize;
        if self.pair_sums.len() < wanted {
            self.pair_sums = StorageBuffer::zeroed(gpu, "sums of pairs", wanted)?;
            self.room = StorageBuffer::from_slice(gpu, "room for sums of pairs", &[[wanted as u32, 0, 0, 0]])?;
        }
        Ok(())
    }
}

fn check(what: &'static str, found: usize, needed: usize) -> Result<(), BackwardError> {
    if found >= needed { Ok(()) } else { Err(BackwardError::Buffer { what, found, needed }) }
}

pub(crate) fn places_wgsl() -> String {
    let constants = format!("const MAX_TILES: u32 = {MAX_TILES}u;\n");
    [&constants, CAMERA_WGSL, FRAME_WGSL, BACKWARD_FRAME_WGSL, PLACES_WGSL].concat()
}

pub(crate) fn blend_wgsl(tile: Tile, with_depth: bool) -> String {
    let invocations = tile.0 * tile.0 / 4;
    let batch = PARTIAL_BYTES / (invocations * PAIR_SUM_BYTES as u32);
    let constants = format!(
        "{}const WITH_DEPTH: bool = {with_depth};\nconst BATCH: u32 = {batch}u;\nconst MAX_LIST: u32 = {MAX_LIST}u;\n",
        tile.wgsl()
    );
    [&constants, CAMERA_WGSL, FRAME_WGSL, BUSY_WGSL, BACKWARD_FRAME_WGSL, BLEND_WGSL].concat()
}

pub(crate) fn project_wgsl(lift: bool) -> String {
    let constants = format!("const LIFT: bool = {lift};\n");
    [&constants, CAMERA_WGSL, FRAME_WGSL, BACKWARD_FRAME_WGSL, PROJECT_WGSL].concat()
}
