//! Colours for fewer Gaussians than there are.

use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer, dispatch_1d};
use wgpu::{CommandEncoder, ComputePassDescriptor};

use crate::scan::run;

const WGSL: &str = include_str!("color_means.wgsl");

/// Gives coarse Gaussians the mean colour and opacity of the fine ones that they stand for.
#[derive(Debug)]
pub struct ColorMeans {
    kernel: ComputeKernel,
    first_child: StorageBuffer<u32>,
    children: StorageBuffer<u32>,
    rate: StorageBuffer<f32>,
}

impl ColorMeans {
    /// `first_child` holds for each coarse Gaussian where its part of `children` (indices of fine ones) begins, and at
    /// the end where the last one's ends. At most 10,000 children count.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, first_child: &[u32], children: &[u32]) -> Result<Self, GpuError> {
        Ok(Self {
            kernel: ComputeKernel::new(gpu, "mean colours", &[WGSL], "mean_colors"),
            first_child: StorageBuffer::from_slice(gpu, "first children", first_child)?,
            children: StorageBuffer::from_slice(gpu, "children", children)?,
            rate: StorageBuffer::zeroed(gpu, "rate", 1)?,
        })
    }

    /// Records the means of `fine` into `coarse`; `rate` is their share there, 0..=1, and what was there keeps the rest.
    pub fn encode(
        &self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        fine: &StorageBuffer<[f32; 4]>,
        coarse: &StorageBuffer<[f32; 4]>,
        rate: f32,
    ) {
        self.rate.encode_write(gpu, encoder, &[rate]);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("mean colours"), ..Default::default() });
        let resources = [self.first_child.raw(), self.children.raw(), fine.raw(), coarse.raw(), self.rate.raw()];
        let resources = resources.map(wgpu::Buffer::as_entire_binding);
        run(gpu, &mut pass, &self.kernel, &resources, dispatch_1d(coarse.len() as u32, 64));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flyrig_gpu::AdapterChoice;

    #[test]
    fn the_kernel_is_valid() {
        let module = naga::front::wgsl::parse_str(WGSL).unwrap();
        let flags = naga::valid::ValidationFlags::all();
        naga::valid::Validator::new(flags, naga::valid::Capabilities::empty()).validate(&module).unwrap();
        assert!(!WGSL.contains("var<uniform>"));
    }

    #[test]
    fn means_of_one_several_and_no_children() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        let means = ColorMeans::new(&gpu, &[0, 1, 1, 4], &[2, 0, 1, 3]).unwrap();
        let fine: Vec<[f32; 4]> = (0..4u8).map(|i| [f32::from(i), 0.5, 0.0, 1.0]).collect();
        let fine = StorageBuffer::from_slice(&gpu, "fine", &fine).unwrap();
        let coarse = StorageBuffer::zeroed(&gpu, "coarse", 3).unwrap();
        let record = |rate: f32| {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            means.encode(&gpu, &mut encoder, &fine, &coarse, rate);
            gpu.queue.submit([encoder.finish()]);
            coarse.read(&gpu).unwrap()
        };
        let found = record(1.0);
        let close = |a: [f32; 4], b: [f32; 4]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(close(found[0], [2.0, 0.5, 0.0, 1.0]) && close(found[1], [0.0; 4]), "{found:?}");
        assert!(close(found[2], [4.0 / 3.0, 0.5, 0.0, 1.0]), "{found:?}");
        coarse.write(&gpu, &[[0.0; 4], [1.0; 4], [0.0, 0.5, 1.0, 1.0]]);
        let found = record(0.25);
        assert!(close(found[0], [0.5, 0.125, 0.0, 0.25]) && close(found[1], [0.75; 4]), "{found:?}");
        assert!(close(found[2], [1.0 / 3.0, 0.5, 0.75, 1.0]), "{found:?}");
        coarse.write(&gpu, &[[f32::NAN; 4]; 3]);
        assert!(record(1.0).iter().flatten().all(|v| v.is_finite()), "what goes leaves nothing behind");
    }
}
