//! Buffers that carry constants and images from the processor into a command encoder.

use std::sync::{Arc, Mutex, atomic::Ordering};

use wgpu::{Buffer, BufferDescriptor, BufferUsages, CommandEncoder, Device, MapMode};

use crate::objects::Counters;

/// Sizes are multiples of this, bytes; the constants of most encodings fit one.
const STEP: u64 = 2048;
/// Bytes that are created together when no buffer is idle, in [`BATCHES`] buffers, so that the exact moment at which the GPU
/// finishes does not decide whether a frame creates one.
const BATCH_BYTES: u64 = 1 << 20;
/// Least and most buffers that are created together: images, and constants.
const BATCHES: [u64; 2] = [2, 16];
/// Idle buffers kept.
const IDLE: usize = 256;

/// Staging buffers that are mapped for writing whenever they are idle.
///
/// A buffer belongs to one encoder from [`Uploads::record`] until the GPU has executed that encoder: it is mapped again by
/// the submission itself, and comes back when the mapping is granted. An encoder that is dropped drops its buffers. So
/// neither the order of submissions nor the number of threads matters, and wgpu rejects a submission that reads a buffer
/// which somebody can write.
#[derive(Debug, Default)]
pub(crate) struct Uploads(Arc<Mutex<Vec<Buffer>>>);

impl Uploads {
    /// Records a copy of `bytes` (a multiple of 4) to `target` at `offset`, ordered with the encoder's other commands.
    pub fn record(
        &self,
        device: &Device,
        counters: &Counters,
        encoder: &mut CommandEncoder,
        bytes: &[u8],
        (target, offset): (&Buffer, u64),
    ) {
        let len = bytes.len() as u64;
        let Some(staging) = self.take(device, counters, len.next_multiple_of(STEP)) else { return };
        match staging.get_mapped_range_mut(..len) {
            Ok(mut view) => view.copy_from_slice(bytes),
            Err(error) => {
                // Only on a lost device, whose fault is recorded elsewhere.
                tracing::debug!("constants were not uploaded: {error}");
                return;
            }
        }
        staging.unmap();
        encoder.copy_buffer_to_buffer(&staging, 0, target, offset, len);
        let idle = Arc::downgrade(&self.0);
        let returned = staging.clone();
        encoder.map_buffer_on_submit(&staging, MapMode::Write, .., move |mapped| {
            if let (Ok(()), Some(idle)) = (mapped, idle.upgrade()) {
                let mut idle = lock(&idle);
                if idle.len() < IDLE {
                    idle.push(returned);
                }
            }
        });
    }

    fn take(&self, device: &Device, counters: &Counters, size: u64) -> Option<Buffer> {
        let mut idle = lock(&self.0);
        if let Some(index) = idle.iter().rposition(|buffer| buffer.size() == size) {
            return Some(idle.swap_remove(index));
        }
        let batch = (BATCH_BYTES / size.max(1)).clamp(BATCHES[0], BATCHES[1]);
        counters.uploads.fetch_add(batch, Ordering::Relaxed);
        idle.extend((0..batch).map(|_| {
            device.create_buffer(&BufferDescriptor {
                label: Some("upload"),
                size,
                usage: BufferUsages::MAP_WRITE | BufferUsages::COPY_SRC,
                mapped_at_creation: true,
            })
        }));
        idle.pop()
    }
}
