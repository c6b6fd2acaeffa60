//! Compute kernels with derived layouts.

use wgpu::{BindGroup, BindingResource, ComputePipeline};

use crate::GpuContext;

/// Largest number of workgroups per dimension, which wgpu guarantees on all adapters.
pub const MAX_WORKGROUPS_PER_DIMENSION: u32 = 65_535;

/// Compute pipeline whose layout is derived from its WGSL; all bindings are in group 0.
#[derive(Debug)]
pub struct ComputeKernel {
    /// wgpu's pipeline.
    pub pipeline: ComputePipeline,
}

impl ComputeKernel {
    /// Compiles `entry` of the concatenated `sources`, or returns the pipeline that this device has already compiled from them. Errors in
    /// the WGSL reach wgpu's error handler; each crate's naga test finds them earlier.
    #[must_use]
    pub fn new(gpu: &GpuContext, label: &str, sources: &[&str], entry: &str) -> Self {
        let compile = |source: &str| Self::compile(gpu, label, source, entry);
        Self { pipeline: gpu.shared.pipeline(sources.concat(), entry, compile) }
    }

    fn compile(gpu: &GpuContext, label: &str, source: &str, entry: &str) -> ComputePipeline {
        let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(label),
            source: wgpu::ShaderSource::Wgsl(source.into()),
        });
        gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: None,
            module: &module,
            entry_point: Some(entry),
            compilation_options: Default::default(),
            cache: None,
        })
    }

    /// Returns bind group 0 with the resources at bindings 0, 1, 2, ...; from the cache where an earlier call had the same resources.
    #[must_use]
    pub fn bind(&self, gpu: &GpuContext, resources: &[BindingResource<'_>]) -> BindGroup {
        bind(gpu, &self.pipeline, resources)
    }

    /// Returns a group as [`Self::bind`] does, with explicit binding numbers. A kernel's layout has only the bindings that its entry point
    /// uses.
    #[must_use]
    pub fn bind_at(&self, gpu: &GpuContext, resources: &[(u32, BindingResource<'_>)]) -> BindGroup {
        gpu.shared.bind_groups.get(&gpu.device, &gpu.shared.counters, &self.pipeline, resources)
    }
}

/// Returns a group as [`ComputeKernel::bind`] does, for any pipeline with derived layout.
#[must_use]
pub fn bind(gpu: &GpuContext, pipeline: &ComputePipeline, resources: &[BindingResource<'_>]) -> BindGroup {
    let numbered: Vec<_> = (0..).zip(resources.iter().cloned()).collect();
    gpu.shared.bind_groups.get(&gpu.device, &gpu.shared.counters, pipeline, &numbered)
}

/// Returns workgroup counts (x, y) for `items` at `group_size` per workgroup. The kernel's linear workgroup index is
/// `workgroup_id.y * num_workgroups.x + workgroup_id.x`, and it must check its item against the count.
///
/// ```
/// use flyrig_gpu::dispatch_1d;
///
/// assert_eq!(dispatch_1d(100, 64), (2, 1));
/// let (x, y) = dispatch_1d(1 << 24, 64);
/// assert!(x <= 65_535 && u64::from(x) * u64::from(y) * 64 >= 1 << 24);
/// ```
#[must_use]
pub fn dispatch_1d(items: u32, group_size: u32) -> (u32, u32) {
    let groups = items.div_ceil(group_size).max(1);
    let rows = groups.div_ceil(MAX_WORKGROUPS_PER_DIMENSION);
    (groups.div_ceil(rows), rows)
}
