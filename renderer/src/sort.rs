//! Stable radix sort on the GPU.

use bytemuck::{Pod, Zeroable};
use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer};
use wgpu::{BindingResource, ComputePass};

use crate::scan::{CHUNK_GROUP, Scan, run};

pub(crate) const SORT_WGSL: &str = include_str!("sort.wgsl");
/// Elements with this key are left out of the result.
pub(crate) const INVALID_KEY: u32 = u32::MAX;

/// How the work is cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct SortShape {
    /// Invocations, a multiple of [`CHUNK_GROUP`].
    pub chunks: u32,
    /// Bits a pass.
    pub digit_bits: u32,
    /// Passes. Keys are compared to `digit_bits * digit_passes` bits of their range.
    pub digit_passes: u32,
}

/// Constants of one pass.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct SortPass {
    count: u32,
    index: u32,
    unused: [u32; 2],
}

impl SortPass {
    pub(crate) fn new(count: u32, index: u32) -> Self {
        Self { count, index, unused: [0; 2] }
    }
}

/// Stable least-significant-digit radix sort of `(key, payload)`, smallest key first. Equal input gives
/// equal bytes: no atomics, and no assumption about when other workgroups make progress.
///
/// Keys are sorted by `(key - smallest) >> shift`, the shift being the least that fits the range of the
/// keys into the digits: exact for ranges up to `2^(digit_bits * digit_passes)`, else keys closer than
/// `2^shift` may count as equal.
#[derive(Debug)]
pub(crate) struct RadixSort {
    shape: SortShape,
    find_range: ComputeKernel,
    count_digits: ComputeKernel,
    scatter: ComputeKernel,
    ranges: StorageBuffer<[u32; 2]>,
    table: StorageBuffer<u32>,
    valid: StorageBuffer<u32>,
    /// Input, then every second pass's output.
    elements: StorageBuffer<[u32; 2]>,
    other: StorageBuffer<[u32; 2]>,
}

impl RadixSort {
    pub(crate) fn new(gpu: &GpuContext, capacity: usize, shape: SortShape) -> Result<Self, GpuError> {
        let prefix = shape.wgsl();
        let kernel = |entry| ComputeKernel::new(gpu, entry, &[&prefix, SORT_WGSL], entry);
        Ok(Self {
            shape,
            find_range: kernel("find_range"),
            count_digits: kernel("count_digits"),
            scatter: kernel("scatter"),
            ranges: StorageBuffer::zeroed(gpu, "sort key ranges", shape.chunks as usize)?,
            table: StorageBuffer::zeroed(gpu, "sort table", shape.table_len() as usize)?,
            valid: StorageBuffer::zeroed(gpu, "sort valid count", 1)?,
            elements: StorageBuffer::zeroed(gpu, "sort elements", capacity)?,
            other: StorageBuffer::zeroed(gpu, "sort elements, other", capacity)?,
        })
    }

    /// Room for `capacity` elements from now on.
    pub(crate) fn grow(&mut self, gpu: &GpuContext, capacity: usize) -> Result<(), GpuError> {
        if capacity > self.elements.len() {
            self.elements = StorageBuffer::zeroed(gpu, "sort elements", capacity)?;
            self.other = StorageBuffer::zeroed(gpu, "sort elements, other", capacity)?;
        }
        Ok(())
    }

    /// Where the elements must be before [`Self::encode`].
    pub(crate) fn input(&self) -> &StorageBuffer<[u32; 2]> {
        &self.elements
    }

    /// Where they are after it; only the first [`Self::valid`] mean anything.
    pub(crate) fn output(&self) -> &StorageBuffer<[u32; 2]> {
        if self.shape.digit_passes.is_multiple_of(2) { &self.elements } else { &self.other }
    }

    /// Number of elements whose key was valid.
    pub(crate) fn valid(&self) -> &StorageBuffer<u32> {
        &self.valid
    }

    /// Sorts; `passes` holds one [`SortPass`] constants a pass, `scan_length` the length of the table.
    pub(crate) fn encode(
        &self,
        gpu: &GpuContext,
        pass: &mut ComputePass<'_>,
        scan: &Scan,
        passes: &[BindingResource<'_>],
        scan_length: &BindingResource<'_>,
    ) {
        let ranges = self.ranges.raw().as_entire_binding();
        let table = self.table.raw().as_entire_binding();
        let valid = self.valid.raw().as_entire_binding();
        let groups = (self.shape.chunks.div_ceil(CHUNK_GROUP), 1);
        let (mut from, mut to) = (&self.elements, &self.other);
        for (index, constants) in passes.iter().enumerate() {
            let source = from.raw().as_entire_binding();
            let target = to.raw().as_entire_binding();
            if index == 0 {
                run(gpu, pass, &self.find_range, &[constants.clone(), source.clone(), ranges.clone()], groups);
            }
            let mut resources = vec![constants.clone(), source, ranges.clone(), table.clone(), valid.clone()];
            run(gpu, pass, &self.count_digits, &resources, groups);
            scan.encode(gpu, pass, scan_length, &self.table, &self.valid);
            resources.push(target);
            // The scatter reads its column of the table only; the count of elements stays untouched.
            run(gpu, pass, &self.scatter, &resources, groups);
            (from, to) = (to, from);
        }
    }
}

impl SortShape {
    pub(crate) fn table_len(self) -> u32 {
        self.chunks << self.digit_bits
    }

    pub(crate) fn wgsl(self) -> String {
        let Self { chunks, digit_bits, digit_passes } = self;
        format!(
            "const CHUNKS: u32 = {chunks}u;\nconst DIGIT_BITS: u32 = {digit_bits}u;\n\
             const DIGIT_PASSES: u32 = {digit_passes}u;\nconst INVALID_KEY: u32 = {INVALID_KEY}u;\n"
        )
    }
}

#[cfg(test)]
#[path = "sort_tests.rs"]
mod tests;
