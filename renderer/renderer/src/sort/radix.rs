//! Stable radix sort on the GPU.

use bytemuck::{Pod, Zeroable};
use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer};
use wgpu::{BindingResource, CommandEncoder, ComputePass};

use crate::sort::scan::{Scan, Workgroups, run};

const SORT_WGSL: &str = include_str!("radix.wgsl");
/// Elements with this key are left out of the result.
pub(crate) const INVALID_KEY: u32 = u32::MAX;
/// Bits per pass.
pub(crate) const DIGIT_BITS: u32 = 8;
/// Bits of the key range to which scaled keys are compared.
pub(crate) const KEY_BITS: u32 = 24;
/// Elements per workgroup.
pub(crate) const BLOCK: usize = 1024;
/// Largest number of elements, bounded by the workgroups of a dispatch.
pub(crate) const MOST_ELEMENTS: usize = flyrig_gpu::MAX_WORKGROUPS_PER_DIMENSION as usize * BLOCK;

/// Interpretation of the keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Keys {
    /// Comparison of `(key - smallest) >> shift`, with the smallest shift that fits the range of the keys into
    /// [`KEY_BITS`]: exact for ranges up to `2^KEY_BITS`, else keys closer than `2^shift` may compare equal. Elements
    /// with [`INVALID_KEY`] are dropped.
    Scaled,
    /// Keys below this number, compared exactly. [`RadixSort::valid`] holds the number of elements beforehand.
    Below(u32),
}

impl Keys {
    /// Returns the number of passes of a sort of such keys.
    pub(crate) fn passes(self) -> u32 {
        match self {
            Self::Scaled => KEY_BITS.div_ceil(DIGIT_BITS),
            Self::Below(end) => (u32::BITS - end.saturating_sub(1).leading_zeros()).div_ceil(DIGIT_BITS).max(1),
        }
    }
}

/// Constants of one pass.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct SortPass {
    count: u32,
    index: u32,
    scaled: u32,
    unused: u32,
}

impl SortPass {
    /// Returns the constants of pass `index` of a sort of at most `count` elements.
    pub(crate) fn new(count: usize, keys: Keys, index: u32) -> Self {
        Self { count: count as u32, index, scaled: (keys == Keys::Scaled).into(), unused: 0 }
    }
}

/// Returns the number of workgroups that sort this many elements.
pub(crate) fn blocks(count: usize) -> u32 {
    count.div_ceil(BLOCK).max(1) as u32
}

/// Returns the number of table entries for a sort of at most this many elements.
pub(crate) fn table_len(count: usize) -> u32 {
    blocks(count) << DIGIT_BITS
}

/// Stable least-significant-digit radix sort of `(key, payload)`, smallest key first. Equal input gives equal bytes; no
/// assumption is made about the progress of other workgroups.
#[derive(Debug)]
pub(crate) struct RadixSort {
    find_range: ComputeKernel,
    count_digits: ComputeKernel,
    scatter: ComputeKernel,
    extremes: StorageBuffer<u32>,
    table: StorageBuffer<u32>,
    valid: StorageBuffer<u32>,
    /// Input, then every second pass's output.
    elements: StorageBuffer<[u32; 2]>,
    other: StorageBuffer<[u32; 2]>,
}

impl RadixSort {
    pub(crate) fn new(gpu: &GpuContext, capacity: usize) -> Result<Self, GpuError> {
        let source = sort_wgsl();
        let kernel = |entry| ComputeKernel::new(gpu, entry, &[&source], entry);
        Ok(Self {
            find_range: kernel("find_range"),
            count_digits: kernel("count_digits"),
            scatter: kernel("scatter"),
            extremes: StorageBuffer::zeroed(gpu, "sort extremes", 2)?,
            table: StorageBuffer::zeroed(gpu, "sort table", table_len(capacity) as usize)?,
            valid: StorageBuffer::zeroed(gpu, "sort valid count", 1)?,
            elements: StorageBuffer::zeroed(gpu, "sort elements", capacity)?,
            other: StorageBuffer::zeroed(gpu, "sort elements, other", capacity)?,
        })
    }

    /// Grows to a capacity of `capacity` elements.
    pub(crate) fn grow(&mut self, gpu: &GpuContext, capacity: usize) -> Result<(), GpuError> {
        if capacity > self.elements.len() {
            *self = Self::new(gpu, capacity)?;
        }
        Ok(())
    }

    /// Returns the capacity in elements.
    pub(crate) fn capacity(&self) -> usize {
        self.elements.len()
    }

    /// Returns the buffer that holds the elements before [`Self::encode`].
    pub(crate) fn input(&self) -> &StorageBuffer<[u32; 2]> {
        &self.elements
    }

    /// Returns the buffer that holds them afterwards; only the first [`Self::valid`] are defined.
    pub(crate) fn output(&self, keys: Keys) -> &StorageBuffer<[u32; 2]> {
        if keys.passes().is_multiple_of(2) { &self.elements } else { &self.other }
    }

    /// Returns the buffer with the number of sorted elements.
    pub(crate) fn valid(&self) -> &StorageBuffer<u32> {
        &self.valid
    }

    /// Records the commands that a sort needs before its compute pass.
    pub(crate) fn prepare(&self, encoder: &mut CommandEncoder) {
        self.extremes.encode_clear(encoder);
    }

    /// Records the sort. `groups` is at least the [`blocks`] of the sorted elements, `passes` the constants of each
    /// [`SortPass`], `scan_length` the [`table_len`] of their number.
    pub(crate) fn encode(
        &self,
        gpu: &GpuContext,
        pass: &mut ComputePass<'_>,
        (groups, keys): (Workgroups<'_>, Keys),
        scan: &Scan,
        passes: &[BindingResource<'_>],
        scan_length: &BindingResource<'_>,
    ) {
        let extremes = self.extremes.raw().as_entire_binding();
        let table = self.table.raw().as_entire_binding();
        let valid = self.valid.raw().as_entire_binding();
        let (mut from, mut to) = (&self.elements, &self.other);
        for (index, constants) in passes.iter().enumerate() {
            let source = from.raw().as_entire_binding();
            let target = to.raw().as_entire_binding();
            if index == 0 && keys == Keys::Scaled {
                run(gpu, pass, &self.find_range, &[constants.clone(), source.clone(), extremes.clone()], groups);
            }
            let mut resources = vec![constants.clone(), source, extremes.clone(), table.clone(), valid.clone()];
            run(gpu, pass, &self.count_digits, &resources, groups);
            scan.encode(gpu, pass, scan_length, &self.table, &self.valid);
            resources.push(target);
            run(gpu, pass, &self.scatter, &resources, groups);
            (from, to) = (to, from);
        }
    }
}

pub(crate) fn sort_wgsl() -> String {
    format!(
        "const BLOCK: u32 = {BLOCK}u;\nconst DIGIT_BITS: u32 = {DIGIT_BITS}u;\nconst KEY_BITS: u32 = {KEY_BITS}u;\n\
         const INVALID_KEY: u32 = {INVALID_KEY}u;\n{SORT_WGSL}"
    )
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
