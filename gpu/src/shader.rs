//! Compute kernels with fewer words.

use wgpu::{BindGroup, BindGroupEntry, BindingResource, ComputePipeline};

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

    /// Bind group 0 with the resources at bindings 0, 1, 2, ...
    #[must_use]
    pub fn bind(&self, gpu: &GpuContext, resources: &[BindingResource<'_>]) -> BindGroup {
        bind(gpu, &self.pipeline, resources)
    }
}

/// Bind group 0 of a pipeline with derived layout, resources at bindings 0, 1, 2, ...
#[must_use]
pub fn bind(gpu: &GpuContext, pipeline: &ComputePipeline, resources: &[BindingResource<'_>]) -> BindGroup {
    let entries: Vec<_> = resources
        .iter()
        .zip(0..)
        .map(|(resource, binding)| BindGroupEntry { binding, resource: resource.clone() })
        .collect();
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &entries,
    })
}

/// Workgroup counts (x, y) for `items` at `group_size` a workgroup. The kernel's linear workgroup index is
/// `workgroup_id.y * num_workgroups.x + workgroup_id.x`, and it must check its item against the count.
#[must_use]
pub fn dispatch_1d(items: u32, group_size: u32) -> (u32, u32) {
    let groups = items.div_ceil(group_size).max(1);
    let rows = groups.div_ceil(MAX_WORKGROUPS_PER_DIMENSION);
    (groups.div_ceil(rows), rows)
}
