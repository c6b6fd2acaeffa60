//! Staging buffers for constants and images that are uploaded within a command encoder.

use std::sync::{Arc, Mutex, atomic::Ordering};

use flyrig_types::lock;
use wgpu::{Buffer, BufferDescriptor, BufferUsages, CommandEncoder, Device, MapMode};

use crate::objects::Counters;

/// Granularity of sizes, bytes; the constants of most encodings fit one step.
const STEP: u64 = 2048;
/// Bytes that are created together when no buffer is idle, in [`BATCHES`] buffers, so that whether a frame creates one does not depend
/// on the exact moment at which the GPU finishes.
const BATCH_BYTES: u64 = 1 << 20;
/// Smallest and largest number of buffers that are created together: for images, and for constants.
const BATCHES: [u64; 2] = [2, 16];
/// Largest number of idle buffers.
const IDLE: usize = 256;

/// Pool of staging buffers that are mapped for writing while idle.
///
/// A buffer belongs to one encoder from [`Uploads::record`] until the GPU has executed that encoder: the submission itself maps it
/// again, and it returns to the pool once the mapping is granted. A dropped encoder drops its buffers. Therefore neither the order of
/// submissions nor the number of threads matters, and wgpu rejects a submission that reads a mapped buffer.
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
