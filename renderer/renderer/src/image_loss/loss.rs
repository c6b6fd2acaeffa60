//! Comparison of rendered and wanted images, with the derivatives that the backward rasteriser takes.

use bytemuck::bytes_of;
use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer};
use wgpu::{CommandEncoder, ComputePassDescriptor};

use crate::backward::gradients::ImageGradients;
use crate::buffers::RenderTarget;
use crate::color::linear_from_srgb;
use crate::constants::Constants;
use crate::image_loss::processor;
use crate::image_loss::settings::{LANES, LossConstants, LossSettings, ROWS, SUMS, UNKNOWN_RGBA};
use crate::sort::scan::{run, run_at};

const WGSL: &str = include_str!("image_loss.wgsl");
/// Sums of one image over its area.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ImageSums {
    /// Weighted loss.
    pub loss: f64,
    /// Squared difference of alpha, pixels.
    pub mask: f64,
    /// Squared difference of colour, weighted by the wanted coverage.
    pub color: f64,
    /// Sum of the wanted coverage, pixels.
    pub wanted: f64,
}

/// Target image of a comparison.
#[derive(Debug)]
pub struct WantedImage {
    /// Size of the source in pixels; `shrink` is the number of source pixels along the side of a compared pixel.
    source: [u32; 2],
    shrink: u32,
    width: u32,
    height: u32,
    color: StorageBuffer<[f32; 4]>,
    partials: StorageBuffer<[f32; 4]>,
    constants: Constants,
}

impl WantedImage {
    /// Largest level: an eighth of the width and height.
    pub const MAX_LEVEL: u32 = 3;

    /// Allocates a target for images of `source` pixels, compared at `1 / 2^level` of that in each direction (rounded
    /// down, at least a pixel): colours are coverage-weighted means in linear light.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(gpu: &GpuContext, source: [u32; 2], level: u32) -> Result<Self, GpuError> {
        let level = level.min(source[0].min(source[1]).max(1).ilog2()).min(Self::MAX_LEVEL);
        let [width, height] = source.map(|side| side >> level);
        let pixels = width as usize * height as usize;
        let partials = width.div_ceil(LANES) as usize * height.div_ceil(ROWS) as usize;
        Ok(Self {
            source,
            shrink: 1 << level,
            width,
            height,
            color: StorageBuffer::zeroed(gpu, "wanted colour", pixels)?,
            partials: StorageBuffer::zeroed(gpu, "partial losses", partials)?,
            constants: Constants::new(gpu, &[size_of::<LossConstants>()])?,
        })
    }

    /// Returns width and height of the compared image, pixels.
    #[must_use]
    pub fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }
}

#[derive(Debug)]
struct LossKernels {
    unpack: ComputeKernel,
    compare: ComputeKernel,
    add_up: ComputeKernel,
}

/// Comparison of images on the device. Sums run in a fixed order: equal input gives equal bytes on one device.
///
/// # Examples
/// ```
/// use flyrig_gpu::{AdapterChoice, GpuContext, StorageBuffer};
/// use flyrig_renderer::{ImageGradients, ImageLoss, LossSettings, RenderTarget, WantedImage};
///
/// let gpu = GpuContext::new(&AdapterChoice::Best)?.on_processor();
/// let settings = LossSettings { color_weight: 1.0, mask_weight: 1.0, area: [0, 0, 4, 4], with_unknown: false };
/// let mut loss = ImageLoss::new(&gpu)?;
/// loss.reserve(&gpu, 1)?;
/// // An opaque black person in every pixel, compared with an empty rendering.
/// let image = StorageBuffer::from_slice(&gpu, "image", &[u32::from_le_bytes([0, 0, 0, 255]); 16])?;
/// let wanted = WantedImage::zeroed(&gpu, [4, 4], 0)?;
/// let (rendered, slopes) = (RenderTarget::new(&gpu, 4, 4)?, ImageGradients::zeroed(&gpu, 4, 4)?);
///
/// let mut encoder = gpu.device.create_command_encoder(&Default::default());
/// loss.prepare(&gpu, &mut encoder, &wanted, &image, &settings);
/// loss.encode(&gpu, &mut encoder, 0, &rendered, &wanted, &settings, &slopes);
/// gpu.queue.submit([encoder.finish()]);
/// assert_eq!(loss.read(&gpu, 1)?[0].mask, 16.0);
/// # Ok::<(), flyrig_gpu::GpuError>(())
/// ```
#[derive(Debug)]
pub struct ImageLoss {
    /// `None` on the processor.
    kernels: Option<LossKernels>,
    linear: StorageBuffer<f32>,
    sums: StorageBuffer<[f32; 4]>,
}

impl ImageLoss {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let kernels = (!gpu.is_on_processor()).then(|| {
            let source = wgsl();
            let kernel = |entry| ComputeKernel::new(gpu, entry, &[&source], entry);
            LossKernels { unpack: kernel("unpack_wanted"), compare: kernel("compare"), add_up: kernel("add_up") }
        });
        let linear: Vec<f32> = (0..=255u8).map(|byte| linear_from_srgb(f32::from(byte) / 255.0)).collect();
        Ok(Self {
            kernels,
            linear: StorageBuffer::from_slice(gpu, "linear of sRGB", &linear)?,
            sums: StorageBuffer::zeroed(gpu, "losses", 0)?,
        })
    }

    /// Grows the buffer of sums to `pictures` images.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn reserve(&mut self, gpu: &GpuContext, pictures: usize) -> Result<(), GpuError> {
        let needed = pictures.saturating_mul(SUMS as usize);
        if self.sums.len() < needed {
            self.sums = StorageBuffer::zeroed(gpu, "losses", needed)?;
        }
        Ok(())
    }

    /// Records the conversion of `image` (sRGB bytes with coverage, one element per pixel, row by row) to linear light
    /// at the compared size, within `settings.area`. Needed once per image and area. An image with too few pixels is
    /// ignored.
    pub fn prepare(
        &self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        wanted: &WantedImage,
        image: &StorageBuffer<u32>,
        settings: &LossSettings,
    ) {
        let enough = image.len() >= wanted.source[0] as usize * wanted.source[1] as usize;
        let Some((constants, groups)) = constants(wanted, 0, settings).filter(|_| enough) else { return };
        let Some(LossKernels { unpack, .. }) = &self.kernels else {
            return processor::unpack(&constants, image, &self.linear, &wanted.color);
        };
        wanted.constants.encode(gpu, encoder, &[bytes_of(&constants)]);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("wanted image"), ..Default::default() });
        let resources = [
            wanted.constants.get(0),
            image.raw().as_entire_binding(),
            self.linear.raw().as_entire_binding(),
            wanted.color.raw().as_entire_binding(),
        ];
        run(gpu, &mut pass, unpack, &resources, groups);
    }

    /// Records the comparison of a rendered image as number `index`, and writes its derivatives to `out`, both within
    /// `settings.area`. Images of another size than the wanted one are not compared.
    #[allow(clippy::too_many_arguments)]
    pub fn encode(
        &self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        index: usize,
        rendered: &RenderTarget,
        wanted: &WantedImage,
        settings: &LossSettings,
        out: &ImageGradients,
    ) {
        let pixels = wanted.width as usize * wanted.height as usize;
        let fits = (rendered.width, rendered.height) == (wanted.width, wanted.height)
            && out.color.len().min(out.depth_carry.len()) >= pixels
            && self.sums.len() >= (index + 1).saturating_mul(SUMS as usize);
        let sums_at = index as u64 * u64::from(SUMS) * 16;
        if fits {
            match self.sums.slice_mut() {
                Some(mut sums) => sums[index * SUMS as usize..][..SUMS as usize].fill([0.0; 4]),
                None => encoder.clear_buffer(self.sums.raw(), sums_at, Some(u64::from(SUMS) * 16)),
            }
        }
        let Some((constants, groups)) = constants(wanted, index as u32, settings).filter(|_| fits) else { return };
        let Some(LossKernels { compare, add_up, .. }) = &self.kernels else {
            return processor::compare(&constants, &wanted.color, &rendered.color, out, &self.sums);
        };
        wanted.constants.encode(gpu, encoder, &[bytes_of(&constants)]);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("image loss"), ..Default::default() });
        let partials = wanted.partials.raw().as_entire_binding();
        let resources = [
            (0, wanted.constants.get(0)),
            (3, wanted.color.raw().as_entire_binding()),
            (4, rendered.color.raw().as_entire_binding()),
            (5, out.color.raw().as_entire_binding()),
            (6, out.depth_carry.raw().as_entire_binding()),
            (7, partials.clone()),
        ];
        run_at(gpu, &mut pass, compare, &resources, groups);
        let resources = [(0, wanted.constants.get(0)), (7, partials), (8, self.sums.raw().as_entire_binding())];
        run_at(gpu, &mut pass, add_up, &resources, (1, 1));
    }

    /// Waits for the GPU and reads the sums of the first `pictures` images.
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn read(&self, gpu: &GpuContext, pictures: usize) -> Result<Vec<ImageSums>, GpuError> {
        let len = pictures.saturating_mul(SUMS as usize).min(self.sums.len());
        let sums = self.sums.read_first(gpu, len)?;
        let total = |one: &[[f32; 4]]| {
            let [loss, mask, color, wanted] =
                one.iter().fold([0.0; 4], |sum, s| std::array::from_fn(|i| sum[i] + f64::from(s[i])));
            ImageSums { loss, mask, color, wanted }
        };
        Ok(sums.chunks(SUMS as usize).map(total).collect())
    }
}

/// Returns the constants of a comparison and its workgroups; `None` for an empty area.
fn constants(wanted: &WantedImage, index: u32, settings: &LossSettings) -> Option<(LossConstants, (u32, u32))> {
    let [left, top, right, bottom] = settings.area;
    let (right, bottom) = (right.min(wanted.width), bottom.min(wanted.height));
    if left >= right || top >= bottom {
        return None;
    }
    let area = [right - left, bottom - top];
    let constants = LossConstants {
        size: wanted.size(),
        first: [left, top],
        area,
        sums_at: index * SUMS,
        color_weight: settings.color_weight,
        mask_weight: settings.mask_weight,
        source_width: wanted.source[0],
        shrink: wanted.shrink,
        with_unknown: settings.with_unknown.into(),
    };
    Some((constants, (area[0].div_ceil(LANES), area[1].div_ceil(ROWS))))
}

fn wgsl() -> String {
    let unknown = u32::from_le_bytes(UNKNOWN_RGBA);
    format!(
        "const ROWS: u32 = {ROWS}u;\nconst SUMS: u32 = {SUMS}u;\nconst LANES: u32 = {LANES}u;\nconst UNKNOWN: u32 = {unknown}u;\n{WGSL}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernels_are_valid_and_the_constants_have_their_layout() {
        let source = wgsl();
        assert!(!source.contains("var<uniform>"), "see constants.rs");
        let module = naga::front::wgsl::parse_str(&source).unwrap();
        let flags = naga::valid::ValidationFlags::all();
        naga::valid::Validator::new(flags, naga::valid::Capabilities::empty()).validate(&module).unwrap();
        let loss = module.types.iter().find(|(_, t)| t.name.as_deref() == Some("Loss")).unwrap().1;
        let naga::TypeInner::Struct { span, .. } = loss.inner else { panic!("Loss is a struct") };
        assert_eq!(span as usize, size_of::<LossConstants>());
    }
}
