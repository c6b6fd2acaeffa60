//! Colours for fewer Gaussians than there are.

use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer, dispatch_1d};
use glam::Vec4;
use rayon::prelude::*;
use wgpu::{CommandEncoder, ComputePassDescriptor};

use crate::sort::scan::run;

const WGSL: &str = include_str!("color_means.wgsl");

/// Largest number of children of a Gaussian that are averaged.
const MAX_CHILDREN: usize = 10_000;

/// Transfer of mean colours and opacities of fine Gaussians to the coarse ones that represent them.
#[derive(Debug)]
pub struct ColorMeans {
    /// `None` on the processor.
    kernel: Option<ComputeKernel>,
    first_child: StorageBuffer<u32>,
    children: StorageBuffer<u32>,
    rate: StorageBuffer<f32>,
}

impl ColorMeans {
    /// Uploads the children. `first_child` holds the start of each coarse Gaussian's part of `children` (indices of fine
    /// ones), followed by the end of the last one's. At most 10,000 children are averaged.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, first_child: &[u32], children: &[u32]) -> Result<Self, GpuError> {
        Ok(Self {
            kernel: (!gpu.is_on_processor()).then(|| ComputeKernel::new(gpu, "mean colours", &[WGSL], "mean_colors")),
            first_child: StorageBuffer::from_slice(gpu, "first children", first_child)?,
            children: StorageBuffer::from_slice(gpu, "children", children)?,
            rate: StorageBuffer::zeroed(gpu, "rate", 1)?,
        })
    }

    /// Records the means of `fine` into `coarse`; `rate` in 0..=1 is their share, and the previous colours keep the
    /// remainder.
    pub fn encode(
        &self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        fine: &StorageBuffer<[f32; 4]>,
        coarse: &StorageBuffer<[f32; 4]>,
        rate: f32,
    ) {
        let Some(kernel) = &self.kernel else { return self.mean_colors(fine, coarse, rate) };
        self.rate.encode_write(gpu, encoder, &[rate]);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("mean colours"), ..Default::default() });
        let resources = [self.first_child.raw(), self.children.raw(), fine.raw(), coarse.raw(), self.rate.raw()];
        let resources = resources.map(wgpu::Buffer::as_entire_binding);
        run(gpu, &mut pass, kernel, &resources, dispatch_1d(coarse.len() as u32, 64));
    }

    /// Computes the means on the processor.
    fn mean_colors(&self, fine: &StorageBuffer<[f32; 4]>, coarse: &StorageBuffer<[f32; 4]>, rate: f32) {
        let (Some(first_child), Some(children)) = (self.first_child.slice(), self.children.slice()) else { return };
        let (Some(fine), Some(mut coarse)) = (fine.slice(), coarse.slice_mut()) else { return };
        let ranges = first_child.par_windows(2);
        coarse.par_iter_mut().zip(ranges).with_min_len(1024).for_each(|(color, range)| {
            let begin = range[0] as usize;
            let end = (range[1] as usize).min(begin + MAX_CHILDREN);
            let children = children.get(begin..end).unwrap_or_default();
            let sum: Vec4 =
                children.iter().filter_map(|&child| fine.get(child as usize)).copied().map(Vec4::from).sum();
            let mean = sum / children.len().max(1) as f32;
            let old = Vec4::from(*color);
            // Not a mix: what was there may be no number when all of it goes.
            *color = if rate < 1.0 { old + rate * (mean - old) } else { mean }.to_array();
        });
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
        let device = GpuContext::new(&AdapterChoice::Best).unwrap();
        for gpu in [device.on_processor(), device] {
            check_means(&gpu);
        }
    }

    fn check_means(gpu: &GpuContext) {
        let means = ColorMeans::new(gpu, &[0, 1, 1, 4], &[2, 0, 1, 3]).unwrap();
        let fine: Vec<[f32; 4]> = (0..4u8).map(|i| [f32::from(i), 0.5, 0.0, 1.0]).collect();
        let fine = StorageBuffer::from_slice(gpu, "fine", &fine).unwrap();
        let coarse = StorageBuffer::zeroed(gpu, "coarse", 3).unwrap();
        let record = |rate: f32| {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            means.encode(gpu, &mut encoder, &fine, &coarse, rate);
            gpu.queue.submit([encoder.finish()]);
            coarse.read(gpu).unwrap()
        };
        let found = record(1.0);
        let close = |a: [f32; 4], b: [f32; 4]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(close(found[0], [2.0, 0.5, 0.0, 1.0]) && close(found[1], [0.0; 4]), "{found:?}");
        assert!(close(found[2], [4.0 / 3.0, 0.5, 0.0, 1.0]), "{found:?}");
        coarse.write(gpu, &[[0.0; 4], [1.0; 4], [0.0, 0.5, 1.0, 1.0]]);
        let found = record(0.25);
        assert!(close(found[0], [0.5, 0.125, 0.0, 0.25]) && close(found[1], [0.75; 4]), "{found:?}");
        assert!(close(found[2], [1.0 / 3.0, 0.5, 0.75, 1.0]), "{found:?}");
        coarse.write(gpu, &[[f32::NAN; 4]; 3]);
        assert!(record(1.0).iter().flatten().all(|v| v.is_finite()), "what goes leaves nothing behind");
    }
}
