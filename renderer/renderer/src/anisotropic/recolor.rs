//! Corrected colours of anisotropic Gaussians.

use flyrig_gpu::{ComputeKernel, GpuContext, StorageBuffer, dispatch_1d};
use glam::{Vec3, Vec4};
use rayon::prelude::*;
use wgpu::{CommandEncoder, ComputePassDescriptor};

use crate::SH_DEGREE_0;
use crate::anisotropic::buffers::AnisotropicBuffers;
use crate::anisotropic::order::HarmonicOrder;
use crate::schema::GaussianElement;
use crate::sort::scan::run;

const WGSL: &str = include_str!("recolor.wgsl");

/// Adds corrections to the colours of anisotropic Gaussians.
#[derive(Debug)]
pub struct Recolor {
    /// `None` on the processor.
    kernel: Option<ComputeKernel>,
}

/// Buffers of [`Recolor::encode`], one element per Gaussian.
#[derive(Debug, Clone, Copy)]
pub struct Corrected<'a> {
    /// Constant harmonics without correction; w unused.
    pub constant: &'a StorageBuffer<GaussianElement>,
    /// Corrections, linear RGB of any sign; w unused.
    pub correction: &'a StorageBuffer<GaussianElement>,
    /// Colours of the surface without correction, linear RGB; w unused.
    pub look: &'a StorageBuffer<GaussianElement>,
    /// Receives the corrected colours of the surface, linear RGB; w: 1.
    pub color: &'a StorageBuffer<GaussianElement>,
}

/// Returns the WGSL for colours of an order.
pub(crate) fn recolor_wgsl(order: HarmonicOrder) -> String {
    let coefficients = order.coefficients();
    format!("const C0: f32 = {SH_DEGREE_0:?};\nconst COEFFICIENTS: u32 = {coefficients}u;\n{WGSL}")
}

impl Recolor {
    /// Compiles the kernel for colours of an order.
    #[must_use]
    pub fn new(gpu: &GpuContext, order: HarmonicOrder) -> Self {
        let compile = || ComputeKernel::new(gpu, "recolor", &[&recolor_wgsl(order)], "recolor");
        Self { kernel: (!gpu.is_on_processor()).then(compile) }
    }

    /// Records the correction of the constant harmonics of `gaussians`, which have the order of [`Self::new`].
    pub fn encode(
        &self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: &AnisotropicBuffers,
        corrected: Corrected<'_>,
    ) {
        let Some(kernel) = &self.kernel else { return recolor(gaussians, corrected) };
        let Corrected { constant, correction, look, color } = corrected;
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("recolor"), ..Default::default() });
        let resources = [constant.raw(), correction.raw(), look.raw(), gaussians.harmonics.raw(), color.raw()];
        let resources = resources.map(wgpu::Buffer::as_entire_binding);
        run(gpu, &mut pass, kernel, &resources, dispatch_1d(gaussians.count() as u32, 64));
    }
}

/// Runs the kernel on the processor.
fn recolor(gaussians: &AnisotropicBuffers, Corrected { constant, correction, look, color }: Corrected<'_>) {
    let (Some(constant), Some(correction), Some(look)) = (constant.slice(), correction.slice(), look.slice()) else {
        return;
    };
    let (Some(mut harmonics), Some(mut color)) = (gaussians.harmonics.slice_mut(), color.slice_mut()) else { return };
    let rgb = |row: &GaussianElement| Vec4::from(*row).truncate();
    let rows = harmonics.par_chunks_mut(gaussians.order().coefficients()).zip(color.par_iter_mut());
    let from = constant.par_iter().zip(correction.par_iter()).zip(look.par_iter());
    rows.zip(from).with_min_len(4096).for_each(|((harmonics, color), ((constant, correction), look))| {
        let by = rgb(correction);
        harmonics[0] = (rgb(constant) + by / SH_DEGREE_0).extend(0.0).to_array();
        *color = (rgb(look) + by).max(Vec3::ZERO).extend(1.0).to_array();
    });
}
