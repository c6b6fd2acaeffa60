//! Conversion of rendered views to bytes on the device.

use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer, dispatch_1d};
use flyrig_model::srgb;
use wgpu::{CommandEncoder, ComputePassDescriptor};

use crate::buffers::RenderTarget;
use crate::color::rgba8_from_target;
use crate::sort::scan::run;

pub(crate) const WGSL: &str = include_str!("view_bytes.wgsl");

/// Converter of rendered views to bytes on the device, so that a quarter of the data is read back.
#[derive(Debug)]
pub struct ViewBytes {
    /// `None` on the processor.
    kernel: Option<ComputeKernel>,
    /// One element per pixel; as many as the largest view so far.
    bytes: StorageBuffer<u32>,
    count: StorageBuffer<[u32; 4]>,
}

impl ViewBytes {
    /// Compiles the kernel.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let on_device = !gpu.is_on_processor();
        Ok(Self {
            kernel: on_device.then(|| ComputeKernel::new(gpu, "view bytes", &[srgb::WGSL, WGSL], "write_bytes")),
            bytes: StorageBuffer::zeroed(gpu, "view bytes", 0)?,
            count: StorageBuffer::zeroed(gpu, "pixels of a view", 1)?,
        })
    }

    /// Records the conversion of a view, for [`Self::read`].
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        target: &RenderTarget,
    ) -> Result<(), GpuError> {
        let Some(kernel) = &self.kernel else { return Ok(()) };
        let pixels = target.color.len();
        if self.bytes.len() < pixels {
            self.bytes = StorageBuffer::zeroed(gpu, "view bytes", pixels)?;
        }
        self.count.encode_write(gpu, encoder, &[[pixels as u32, 0, 0, 0]]);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("view bytes"), ..Default::default() });
        let resources = [target.color.raw(), self.bytes.raw(), self.count.raw()].map(wgpu::Buffer::as_entire_binding);
        run(gpu, &mut pass, kernel, &resources, dispatch_1d(pixels as u32, 256));
        Ok(())
    }

    /// Waits for the device and returns the view recorded last, which must be `target`: straight-alpha sRGB, RGBA of 8
    /// bits, row by row ([`rgba8_from_target`]; on the device a byte may be off by one).
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn read(&self, gpu: &GpuContext, target: &RenderTarget) -> Result<Vec<u8>, GpuError> {
        match target.color.slice() {
            Some(color) => {
                gpu.check()?;
                Ok(rgba8_from_target(&color))
            }
            None => Ok(bytemuck::pod_collect_to_vec(&self.bytes.read_first(gpu, target.color.len())?)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flyrig_gpu::testing::on_both;

    #[test]
    fn bytes_are_those_of_the_plain_conversion_for_any_number() {
        let special = [0.0, -0.0, 1.0, -1.0, 0.5, 0.002, 2.0, 1e-30, f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
        let mut colors: Vec<[f32; 4]> =
            special.iter().flat_map(|&a| special.iter().map(move |&c| [c, 0.3 * c, a, a])).collect();
        colors.extend((0..=255u8).map(|i| [f32::from(i) / 400.0, 0.1, 0.6, 0.7]));
        let expected = rgba8_from_target(&colors);
        on_both(|gpu| {
            let mut view_bytes = ViewBytes::new(gpu).unwrap();
            let target = RenderTarget::of_color(gpu, colors.len() as u32, 1).unwrap();
            target.color.write(gpu, &colors);
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            view_bytes.encode(gpu, &mut encoder, &target).unwrap();
            gpu.queue.submit([encoder.finish()]);
            let found = view_bytes.read(gpu, &target).unwrap();
            assert_eq!(found.len(), expected.len());
            for (i, (a, b)) in found.iter().zip(&expected).enumerate() {
                assert!(a.abs_diff(*b) <= 1, "byte {i} of {:?}: {a}, not {b}", colors[i / 4]);
            }
        });
    }
}
