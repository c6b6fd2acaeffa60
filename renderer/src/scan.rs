//! Prefix sums on the GPU.

use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer};
use wgpu::{BindGroup, BindingResource, ComputePass};

pub(crate) const SCAN_WGSL: &str = include_str!("scan.wgsl");
/// `@workgroup_size` of every kernel whose invocations own chunks; chunk counts are multiples of it.
pub(crate) const CHUNK_GROUP: u32 = 32;
/// Iterations that one invocation may spend in loops. Mesa's software adapter ends all loops of an invocation
/// after 65535 iterations together, without a word.
pub(crate) const MAX_LOOP: u64 = 60_000;

/// Exclusive prefix sum in place, in two kernels, with one contiguous segment an invocation.
#[derive(Debug)]
pub(crate) struct Scan {
    reduce: ComputeKernel,
    apply: ComputeKernel,
    sums: StorageBuffer<u32>,
    segments: u32,
}

impl Scan {
    /// `segments` invocations share the work (a multiple of [`CHUNK_GROUP`]).
    pub(crate) fn new(gpu: &GpuContext, segments: u32) -> Result<Self, GpuError> {
        let prefix = scan_prefix(segments);
        let kernel = |entry| ComputeKernel::new(gpu, entry, &[&prefix, SCAN_WGSL], entry);
        Ok(Self {
            reduce: kernel("reduce"),
            apply: kernel("apply"),
            sums: StorageBuffer::zeroed(gpu, "scan sums", segments as usize)?,
            segments,
        })
    }

    /// Scans the first elements of `values`, as many as the constants `length` says (a `vec4<u32>`, x),
    /// and writes their sum to `total[0]`.
    pub(crate) fn encode(
        &self,
        gpu: &GpuContext,
        pass: &mut ComputePass<'_>,
        length: &BindingResource<'_>,
        values: &StorageBuffer<u32>,
        total: &StorageBuffer<u32>,
    ) {
        let values = values.raw().as_entire_binding();
        let sums = self.sums.raw().as_entire_binding();
        let total = total.raw().as_entire_binding();
        let groups = self.segments.div_ceil(CHUNK_GROUP);
        run(gpu, pass, &self.reduce, &[length.clone(), values.clone(), sums.clone()], (groups, 1));
        run(gpu, pass, &self.apply, &[length.clone(), values, sums, total], (groups, 1));
    }
}

pub(crate) fn scan_prefix(segments: u32) -> String {
    format!("const SEGMENTS: u32 = {segments}u;\n")
}

/// Binds and dispatches one kernel.
pub(crate) fn run(
    gpu: &GpuContext,
    pass: &mut ComputePass<'_>,
    kernel: &ComputeKernel,
    resources: &[BindingResource<'_>],
    groups: (u32, u32),
) {
    dispatch(pass, kernel, &kernel.bind(gpu, resources), groups);
}

/// As [`run`], with bindings whose numbers do not follow each other.
pub(crate) fn run_at(
    gpu: &GpuContext,
    pass: &mut ComputePass<'_>,
    kernel: &ComputeKernel,
    resources: &[(u32, BindingResource<'_>)],
    groups: (u32, u32),
) {
    dispatch(pass, kernel, &kernel.bind_at(gpu, resources), groups);
}

fn dispatch(pass: &mut ComputePass<'_>, kernel: &ComputeKernel, group: &BindGroup, (x, y): (u32, u32)) {
    pass.set_pipeline(&kernel.pipeline);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups(x, y, 1);
}
