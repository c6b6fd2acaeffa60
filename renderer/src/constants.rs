//! Constants of one encoding.
//!
//! They lie in a storage buffer on purpose. Mesa's software adapter (22.3) specialises a shader anew for the values of
//! a uniform buffer at every dispatch and never frees what it made: about 30 to 130 KiB a dispatch, for ever.

use bytemuck::Pod;
use wgpu::{BindingResource, Buffer, BufferBinding, BufferDescriptor, BufferSize, BufferUsages};

use flyrig_gpu::GpuContext;

/// Offsets in a storage buffer may be any multiple of this on every adapter (WebGPU's default limit).
const ALIGNMENT: usize = 256;

/// Several constants in one buffer. It is made anew for every encoding: a queued write to a shared
/// buffer would land before all pictures of a submission, not between them.
#[derive(Debug, Default)]
pub(crate) struct ConstantWriter {
    bytes: Vec<u8>,
    ranges: Vec<(u64, BufferSize)>,
}

impl ConstantWriter {
    pub(crate) fn push<T: Pod>(&mut self, value: &T) {
        let offset = self.bytes.len();
        if let Some(size) = BufferSize::new(size_of::<T>() as u64) {
            self.ranges.push((offset as u64, size));
            self.bytes.extend_from_slice(bytemuck::bytes_of(value));
            self.bytes.resize(self.bytes.len().next_multiple_of(ALIGNMENT), 0);
        }
    }

    pub(crate) fn finish(self, gpu: &GpuContext) -> Constants {
        let contents = if self.bytes.is_empty() { &[0; ALIGNMENT] } else { self.bytes.as_slice() };
        // Not mapped at creation, which panics on a device that is lost.
        let buffer = gpu.device.create_buffer(&BufferDescriptor {
            label: Some("raster constants"),
            size: contents.len() as u64,
            usage: BufferUsages::STORAGE | BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        gpu.queue.write_buffer(&buffer, 0, contents);
        Constants { buffer, ranges: self.ranges }
    }
}

#[derive(Debug)]
pub(crate) struct Constants {
    buffer: Buffer,
    ranges: Vec<(u64, BufferSize)>,
}

impl Constants {
    /// The constant pushed as number `index`.
    pub(crate) fn get(&self, index: usize) -> BindingResource<'_> {
        let (offset, size) = self.ranges.get(index).map_or((0, None), |&(offset, size)| (offset, Some(size)));
        BindingResource::Buffer(BufferBinding { buffer: &self.buffer, offset, size })
    }
}
