//! Pool of reusable byte buffers.

use std::sync::Arc;

use crossbeam::queue::ArrayQueue;
use flyrig_types::{PixelBuffer, Recycle};

/// Bounded pool of byte buffers, to which a dropped [`PixelBuffer`] returns.
#[derive(Debug)]
pub struct BufferPool {
    free: ArrayQueue<Vec<u8>>,
}

impl BufferPool {
    /// Creates a pool of at most `capacity` free buffers (at least one); any more are freed.
    #[must_use]
    pub fn new(capacity: usize) -> Arc<Self> {
        Arc::new(Self { free: ArrayQueue::new(capacity.max(1)) })
    }

    /// Returns an empty buffer, with the capacity of its last use.
    #[must_use]
    pub fn take(&self) -> Vec<u8> {
        self.free.pop().unwrap_or_default()
    }

    /// Wraps bytes such that their buffer returns to this pool on drop.
    #[must_use]
    pub fn lease(self: &Arc<Self>, bytes: Vec<u8>) -> PixelBuffer {
        PixelBuffer::leased(bytes, Arc::clone(self) as Arc<dyn Recycle>)
    }
}

impl Recycle for BufferPool {
    fn recycle(&self, mut bytes: Vec<u8>) {
        bytes.clear();
        // A full pool lets the buffer go.
        let _ = self.free.push(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_buffer_is_used_again_and_the_pool_stays_small() {
        let pool = BufferPool::new(2);
        let mut bytes = pool.take();
        bytes.resize(1000, 7);
        let address = bytes.as_ptr();
        drop(pool.lease(bytes));
        let again = pool.take();
        assert_eq!((again.as_ptr(), again.len()), (address, 0));
        for leased in (0..5).map(|_| pool.lease(vec![0; 10])).collect::<Vec<_>>() {
            drop(leased);
        }
        assert_eq!(pool.free.len(), 2);
    }
}
