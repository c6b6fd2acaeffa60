//! Typed storage buffers.

use std::{
    marker::PhantomData,
    sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard, Weak, atomic::Ordering},
};

use bytemuck::Pod;
use wgpu::{Buffer, BufferDescriptor, BufferUsages, CommandEncoder};

use crate::{GpuContext, GpuError, shared::Shared};

/// Array of `T` on the device, usable as storage, copy source and copy target; or in the processor's memory for a context whose
/// kernels run there ([`GpuContext::on_processor`]). Clones share the array.
///
/// ```no_run
/// use flyrig_gpu::{AdapterChoice, GpuContext, StorageBuffer};
///
/// let gpu = GpuContext::new(&AdapterChoice::Best)?;
/// let centers = StorageBuffer::from_slice(&gpu, "centres", &[[0.0f32; 4]; 100])?;
/// centers.write(&gpu, &[[1.0, 2.0, 3.0, 0.0]]);
/// assert_eq!(centers.read_first(&gpu, 1)?, [[1.0, 2.0, 3.0, 0.0]]);
/// # Ok::<(), flyrig_gpu::GpuError>(())
/// ```
#[derive(Debug, Clone)]
pub struct StorageBuffer<T> {
    owner: Arc<Owner>,
    /// Elements, where the kernels run on the processor.
    content: Option<Arc<RwLock<Vec<T>>>>,
    len: usize,
    element: PhantomData<T>,
}

/// Size of the device's stand-in for an array in the processor's memory, bytes.
const STAND_IN_BYTES: u64 = 16;

/// Buffer of all clones; the last one dropped removes the bind groups.
#[derive(Debug)]
struct Owner {
    buffer: Buffer,
    shared: Weak<Shared>,
}

impl Drop for Owner {
    fn drop(&mut self) {
        if let Some(shared) = self.shared.upgrade() {
            shared.bind_groups.forget(&self.buffer);
        }
    }
}

impl<T: Pod> StorageBuffer<T> {
    /// Creates `len` zeroed elements (room for at least one, since empty buffers cannot be bound).
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] when the adapter cannot bind that many.
    pub fn zeroed(gpu: &GpuContext, label: &str, len: usize) -> Result<Self, GpuError> {
        let needed = (len.max(1) as u64 * size_of::<T>() as u64).next_multiple_of(16);
        let limits = gpu.device.limits();
        let limit = limits.max_buffer_size.min(limits.max_storage_buffer_binding_size);
        if needed > limit {
            return Err(GpuError::TooLarge { what: label.to_owned(), needed, limit });
        }
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST | BufferUsages::INDIRECT;
        gpu.shared.counters.storage_buffers.fetch_add(1, Ordering::Relaxed);
        let content = gpu.is_on_processor().then(|| Arc::new(RwLock::new(vec![T::zeroed(); len])));
        let buffer = gpu.device.create_buffer(&BufferDescriptor {
            label: Some(label),
            size: if content.is_some() { STAND_IN_BYTES } else { needed },
            usage,
            mapped_at_creation: false,
        });
        let owner = Arc::new(Owner { buffer, shared: Arc::downgrade(&gpu.shared) });
        Ok(Self { owner, content, len, element: PhantomData })
    }

    /// Locks the elements for reading; `None` for an array on the device.
    #[must_use]
    pub fn slice(&self) -> Option<RwLockReadGuard<'_, Vec<T>>> {
        self.content.as_ref().map(|content| content.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Locks the elements for writing; `None` for an array on the device. Waits for other holders: one thread at a time records the
    /// kernels of an array.
    #[must_use]
    pub fn slice_mut(&self) -> Option<RwLockWriteGuard<'_, Vec<T>>> {
        self.content.as_ref().map(|content| content.write().unwrap_or_else(PoisonError::into_inner))
    }

    /// Creates a buffer with the given content.
    ///
    /// # Errors
    /// As [`Self::zeroed`].
    pub fn from_slice(gpu: &GpuContext, label: &str, content: &[T]) -> Result<Self, GpuError> {
        let buffer = Self::zeroed(gpu, label, content.len())?;
        buffer.write(gpu, content);
        Ok(buffer)
    }

    /// Queues a write of the first elements (extra ones are ignored).
    pub fn write(&self, gpu: &GpuContext, content: &[T]) {
        let count = content.len().min(self.len);
        if let Some(mut elements) = self.slice_mut() {
            elements[..count].copy_from_slice(&content[..count]);
        } else if count > 0 {
            let bytes: &[u8] = bytemuck::cast_slice(&content[..count]);
            gpu.shared.traffic.upload(bytes.len());
            gpu.queue.write_buffer(self.raw(), 0, bytes);
        }
    }

    /// Records a write of the first elements (extra ones are ignored): commands recorded before see the old content, later ones the
    /// new one. Reuses staging buffers. The size of an element must be a multiple of 4 bytes.
    pub fn encode_write(&self, gpu: &GpuContext, encoder: &mut CommandEncoder, content: &[T]) {
        let count = content.len().min(self.len);
        if self.content.is_some() {
            self.write(gpu, content);
        } else if count > 0 {
            let bytes: &[u8] = bytemuck::cast_slice(&content[..count]);
            gpu.shared.traffic.upload(bytes.len());
            gpu.shared.uploads.record(&gpu.device, &gpu.shared.counters, encoder, bytes, (self.raw(), 0));
        }
    }

    /// Queues a write of little-endian bytes to the start of the buffer (extra ones are ignored). The bytes need no alignment; their
    /// number must be a multiple of 4. Reuses staging buffers for contents of one size.
    pub fn write_bytes(&self, gpu: &GpuContext, bytes: &[u8]) {
        let count = bytes.len().min(self.len * size_of::<T>()) & !3;
        if let Some(mut elements) = self.slice_mut() {
            bytemuck::cast_slice_mut::<T, u8>(&mut elements)[..count].copy_from_slice(&bytes[..count]);
        } else if count > 0 {
            gpu.shared.traffic.upload(count);
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            gpu.shared.uploads.record(
                &gpu.device,
                &gpu.shared.counters,
                &mut encoder,
                &bytes[..count],
                (self.raw(), 0),
            );
            gpu.queue.submit([encoder.finish()]);
        }
    }

    /// Queues a copy of as many elements as both arrays have room for.
    pub fn copy_to(&self, gpu: &GpuContext, other: &Self) {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        self.encode_copy(&mut encoder, other, 0);
        gpu.queue.submit([encoder.finish()]);
    }

    /// Records a copy to another array, from its element `first` on, of as many elements as there is room for.
    pub fn encode_copy(&self, encoder: &mut CommandEncoder, other: &Self, first: usize) {
        let count = self.len.min(other.len.saturating_sub(first));
        if let Some((from, to)) = self.content.as_ref().zip(other.content.as_ref()) {
            if count > 0 && !Arc::ptr_eq(from, to) {
                let from = from.read().unwrap_or_else(PoisonError::into_inner);
                let mut to = to.write().unwrap_or_else(PoisonError::into_inner);
                to[first..first + count].copy_from_slice(&from[..count]);
            }
            return;
        }
        let element = size_of::<T>() as u64;
        encoder.copy_buffer_to_buffer(self.raw(), 0, other.raw(), first as u64 * element, count as u64 * element);
    }

    /// Records setting all elements to zero.
    pub fn encode_clear(&self, encoder: &mut CommandEncoder) {
        match self.slice_mut() {
            Some(mut elements) => elements.fill(T::zeroed()),
            None => encoder.clear_buffer(self.raw(), 0, None),
        }
    }

    /// Returns the number of elements.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns wgpu's buffer; a stand-in without content for an array in the processor's memory.
    #[must_use]
    pub fn raw(&self) -> &Buffer {
        &self.owner.buffer
    }

    /// Waits for the GPU and copies the elements out. For tests, exports and published images.
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn read(&self, gpu: &GpuContext) -> Result<Vec<T>, GpuError> {
        self.read_first(gpu, self.len)
    }

    /// Reads at most `count` elements from the start, as [`Self::read`].
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn read_first(&self, gpu: &GpuContext, count: usize) -> Result<Vec<T>, GpuError> {
        let count = count.min(self.len);
        match self.slice() {
            Some(elements) => {
                gpu.check()?;
                Ok(elements[..count].to_vec())
            }
            None => read_back(gpu, self.raw(), count),
        }
    }
}

/// Waits once for the GPU and copies the elements of several arrays out.
///
/// # Errors
/// [`GpuError::Lost`].
pub fn read_all<T: Pod>(gpu: &GpuContext, arrays: &[&StorageBuffer<T>]) -> Result<Vec<Vec<T>>, GpuError> {
    if arrays.iter().any(|array| array.content.is_some()) {
        return arrays.iter().map(|array| array.read(gpu)).collect();
    }
    let element = size_of::<T>() as u64;
    let ranges: Vec<(&Buffer, u64)> = arrays.iter().map(|array| (array.raw(), array.len as u64 * element)).collect();
    read_back_ranges(gpu, &ranges)
}

impl StorageBuffer<u32> {
    /// Creates a buffer of little-endian words; up to three bytes at the end that fill no word are ignored.
    ///
    /// # Errors
    /// As [`Self::zeroed`].
    pub fn from_bytes(gpu: &GpuContext, label: &str, bytes: &[u8]) -> Result<Self, GpuError> {
        let buffer = Self::zeroed(gpu, label, bytes.len() / size_of::<u32>())?;
        buffer.write_bytes(gpu, bytes);
        Ok(buffer)
    }
}

/// Waits for the GPU and copies the first `len` elements of `buffer` (needs `COPY_SRC`).
///
/// # Errors
/// [`GpuError::Lost`].
pub fn read_back<T: Pod>(gpu: &GpuContext, buffer: &Buffer, len: usize) -> Result<Vec<T>, GpuError> {
    Ok(read_back_ranges(gpu, &[(buffer, len as u64 * size_of::<T>() as u64)])?.pop().unwrap_or_default())
}

/// Waits for the GPU and copies the first bytes of each buffer. Where there are several, their sizes are multiples of 4 bytes.
fn read_back_ranges<T: Pod>(gpu: &GpuContext, ranges: &[(&Buffer, u64)]) -> Result<Vec<Vec<T>>, GpuError> {
    let bytes: u64 = ranges.iter().map(|(_, bytes)| bytes).sum();
    if bytes == 0 {
        return Ok(vec![Vec::new(); ranges.len()]);
    }
    let size = bytes.next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
    gpu.shared.traffic.read_back(bytes);
    let staging = gpu.shared.take_read_back(&gpu.device, size);
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    let mut at = 0;
    for (buffer, bytes) in ranges {
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, at, bytes.next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT));
        at += bytes;
    }
    gpu.queue.submit([encoder.finish()]);
    let (sender, receiver) = std::sync::mpsc::sync_channel(1);
    staging.map_async(wgpu::MapMode::Read, .., move |result| {
        let _ = sender.try_send(result);
    });
    gpu.wait()?;
    // Another thread's wait may hold our callback and be about to call it.
    match receiver.recv_timeout(std::time::Duration::from_secs(10)) {
        Ok(Ok(())) => {}
        Ok(Err(error)) => return Err(GpuError::Lost(error.to_string())),
        Err(_) => return Err(GpuError::Lost("a buffer was not mapped after the wait".to_owned())),
    }
    let content = {
        let view = staging.get_mapped_range(..bytes).map_err(|error| GpuError::Lost(error.to_string()))?;
        let mut rest = &view[..];
        let mut take = |bytes: u64| {
            let (first, others) = rest.split_at((bytes as usize).min(rest.len()));
            rest = others;
            bytemuck::pod_collect_to_vec(first)
        };
        ranges.iter().map(|(_, bytes)| take(*bytes)).collect()
    };
    staging.unmap();
    gpu.shared.give_read_back(staging);
    Ok(content)
}
