//! Prefix sums on the GPU.

use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer};
use wgpu::{BindGroup, BindingResource, ComputePass};

const SCAN_WGSL: &str = include_str!("scan.wgsl");
/// Workgroups that share a scan.
pub(crate) const SEGMENTS: u32 = 128;
/// Saturation of sums, such that two of them do not overflow.
const MOST: u32 = (1 << 31) - 1;

/// Exclusive prefix sum in place, in two kernels, with one contiguous segment per workgroup. Sums saturate at 2³¹ - 1.
#[derive(Debug)]
pub(crate) struct Scan {
    reduce: ComputeKernel,
    apply: ComputeKernel,
    sums: StorageBuffer<u32>,
}

impl Scan {
    pub(crate) fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let source = scan_wgsl();
        let kernel = |entry| ComputeKernel::new(gpu, entry, &[&source], entry);
        Ok(Self {
            reduce: kernel("reduce"),
            apply: kernel("apply"),
            sums: StorageBuffer::zeroed(gpu, "scan sums", SEGMENTS as usize)?,
        })
    }

    /// Records the scan of the first elements of `values`, whose number is in `length` (x of a `vec4<u32>`), and writes
    /// their sum to `total[0]`.
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
        run(gpu, pass, &self.reduce, &[length.clone(), values.clone(), sums.clone()], (SEGMENTS, 1));
        run(gpu, pass, &self.apply, &[length.clone(), values, sums, total], (SEGMENTS, 1));
    }
}

pub(crate) fn scan_wgsl() -> String {
    format!("const SEGMENTS: u32 = {SEGMENTS}u;\nconst MOST: u32 = {MOST}u;\n{SCAN_WGSL}")
}

/// Number of workgroups of a dispatch.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Workgroups<'a> {
    /// Number in x and y.
    Fixed(u32, u32),
    /// Three numbers in a buffer, from this byte on.
    Counted(&'a StorageBuffer<u32>, u64),
}

impl From<(u32, u32)> for Workgroups<'_> {
    fn from((x, y): (u32, u32)) -> Self {
        Self::Fixed(x, y)
    }
}

/// Binds a kernel's resources and records its dispatch.
pub(crate) fn run<'a>(
    gpu: &GpuContext,
    pass: &mut ComputePass<'_>,
    kernel: &ComputeKernel,
    resources: &[BindingResource<'_>],
    groups: impl Into<Workgroups<'a>>,
) {
    dispatch(gpu, pass, kernel, &kernel.bind(gpu, resources), groups.into());
}

/// Records a dispatch as [`run`] does, with explicit binding numbers.
pub(crate) fn run_at<'a>(
    gpu: &GpuContext,
    pass: &mut ComputePass<'_>,
    kernel: &ComputeKernel,
    resources: &[(u32, BindingResource<'_>)],
    groups: impl Into<Workgroups<'a>>,
) {
    dispatch(gpu, pass, kernel, &kernel.bind_at(gpu, resources), groups.into());
}

fn dispatch(
    gpu: &GpuContext,
    pass: &mut ComputePass<'_>,
    kernel: &ComputeKernel,
    group: &BindGroup,
    groups: Workgroups<'_>,
) {
    gpu.count_dispatch();
    pass.set_pipeline(&kernel.pipeline);
    pass.set_bind_group(0, group, &[]);
    match groups {
        Workgroups::Fixed(x, y) => pass.dispatch_workgroups(x, y, 1),
        Workgroups::Counted(counts, offset) => pass.dispatch_workgroups_indirect(counts.raw(), offset),
    }
}
