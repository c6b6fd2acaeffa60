//! Compute kernels with fewer words.

use wgpu::{BindGroup, BindingResource, ComputePipeline};

use crate::GpuContext;

/// wgpu's promise on every adapter.
pub const MAX_WORKGROUPS_PER_DIMENSION: u32 = 65_535;

/// A compute pipeline whose layout is derived from its WGSL; all bindings stand in group 0.
#[derive(Debug)]
pub struct ComputeKernel {
    /// wgpu's pipeline.
    pub pipeline: ComputePipeline,
}

impl ComputeKernel {
    /// Compiles `entry` of the concatenated `sources`, or returns the pipeline that this device has compiled from them
    /// before. A mistake in our own WGSL reaches wgpu's error handler; the naga test of each crate catches it before.
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

    /// Returns bind group 0 with the resources at bindings 0, 1, 2, ...; the one of an earlier call with the same resources
    /// where there is one.
    #[must_use]
    pub fn bind(&self, gpu: &GpuContext, resources: &[BindingResource<'_>]) -> BindGroup {
        bind(gpu, &self.pipeline, resources)
    }

    /// As [`Self::bind`], with the number of each binding. A kernel's layout has only the bindings that its entry point uses.
    #[must_use]
    pub fn bind_at(&self, gpu: &GpuContext, resources: &[(u32, BindingResource<'_>)]) -> BindGroup {
        gpu.shared.bind_groups.get(&gpu.device, &gpu.shared.counters, &self.pipeline, resources)
    }
}

/// As [`ComputeKernel::bind`], for any pipeline with derived layout.
#[must_use]
pub fn bind(gpu: &GpuContext, pipeline: &ComputePipeline, resources: &[BindingResource<'_>]) -> BindGroup {
    let numbered: Vec<_> = (0..).zip(resources.iter().cloned()).collect();
    gpu.shared.bind_groups.get(&gpu.device, &gpu.shared.counters, pipeline, &numbered)
}

/// Workgroup counts (x, y) for `items` at `group_size` a workgroup. The kernel's linear workgroup index is
/// `workgroup_id.y * num_workgroups.x + workgroup_id.x`, and it must check its item against the count.
#[must_use]
pub fn dispatch_1d(items: u32, group_size: u32) -> (u32, u32) {
    let groups = items.div_ceil(group_size).max(1);
    let rows = groups.div_ceil(MAX_WORKGROUPS_PER_DIMENSION);
    (groups.div_ceil(rows), rows)
}
