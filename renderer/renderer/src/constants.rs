//! Constants of one encoding.
//!
//! They lie in a storage buffer because Mesa's software adapter (22.3) specialises shaders that branch on uniform
//! buffers for their values at every dispatch and never frees the result: a leak of about 30 to 130 KiB per dispatch.
//! Tests reject `var<uniform>`.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use wgpu::{BindingResource, BufferBinding, BufferSize, CommandEncoder};

/// Alignment of binding offsets that every adapter supports (WebGPU's default limit), bytes.
const ALIGNMENT: usize = 256;

/// Several constants in one buffer. Each encoding records their upload among its own commands: a queued write would
/// take effect before all images of a submission, not between them.
#[derive(Debug)]
pub(crate) struct Constants {
    buffer: StorageBuffer<u32>,
    /// Bytes of each constant.
    sizes: Vec<usize>,
}

impl Constants {
    /// Allocates constants of these sizes, bytes: multiples of 4, at most [`ALIGNMENT`].
    pub(crate) fn new(gpu: &GpuContext, sizes: &[usize]) -> Result<Self, GpuError> {
        let buffer = StorageBuffer::zeroed(gpu, "constants", sizes.len() * ALIGNMENT / size_of::<u32>())?;
        Ok(Self { buffer, sizes: sizes.to_vec() })
    }

    /// Records the upload of all constants, in the order of their sizes.
    pub(crate) fn encode(&self, gpu: &GpuContext, encoder: &mut CommandEncoder, values: &[&[u8]]) {
        let mut words = vec![0u32; self.buffer.len()];
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
        for ((slot, value), &size) in bytes.chunks_exact_mut(ALIGNMENT).zip(values).zip(&self.sizes) {
            let size = size.min(value.len()).min(ALIGNMENT);
            slot[..size].copy_from_slice(&value[..size]);
        }
        self.buffer.encode_write(gpu, encoder, &words);
    }

    /// Returns the binding of constant number `index`.
    pub(crate) fn get(&self, index: usize) -> BindingResource<'_> {
        let size = self.sizes.get(index).and_then(|&size| BufferSize::new(size as u64));
        let offset = if size.is_some() { (index * ALIGNMENT) as u64 } else { 0 };
        BindingResource::Buffer(BufferBinding { buffer: self.buffer.raw(), offset, size })
    }
}
