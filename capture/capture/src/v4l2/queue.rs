//! Ring of buffers between a driver and this process.

use std::{
    io,
    time::{Duration, Instant},
};

use crate::stamps::StampSource;

/// Most memory planes of a buffer (`VIDEO_MAX_PLANES`).
pub(crate) const MAX_PLANES: usize = 8;

/// Fewest queued buffers for a continuous stream; a driver without a free buffer drops frames.
const MIN_QUEUED: usize = 2;

/// Buffer returned by the driver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Delivered {
    pub index: u32,
    /// Driver's sequence number, modulo 2^32.
    pub sequence: u32,
    /// Whether the driver flags its content as damaged.
    pub is_broken: bool,
    pub stamp_nanos: i64,
    pub stamp_source: StampSource,
    /// Start and length of the payload in each plane, bytes, as reported by the driver.
    pub ranges: [(usize, usize); MAX_PLANES],
}

/// Streaming calls of a device; tests use a scripted one.
pub(crate) trait BufferDevice {
    /// Allocates buffers (0 frees them) and returns their number.
    fn allocate(&mut self, count: u32) -> io::Result<u32>;
    fn enqueue(&mut self, index: u32) -> io::Result<()>;
    fn dequeue(&mut self) -> io::Result<Delivered>;
    fn start(&mut self) -> io::Result<()>;
    /// Stops the stream and removes every buffer from the driver's queue.
    fn stop(&mut self) -> io::Result<()>;
    /// Waits until a buffer or an error can be dequeued; returns false on timeout.
    fn wait(&mut self, timeout: Duration) -> io::Result<bool>;
    /// Returns the memory of a buffer's plane; empty for a nonexistent one.
    fn plane(&self, index: u32, plane: usize) -> &[u8];
}

/// Streaming device with all buffers queued in the driver but for the leased one.
///
/// Frames are copied out of a [`Lease`], which is dropped immediately. Passing leases down the pipeline would save a
/// copy (a tenth of a millisecond for 640x360) and starve the driver: a synchronizer may hold dozens of frames, a
/// driver has four to eight buffers.
#[derive(Debug)]
pub(crate) struct BufferQueue<D: BufferDevice> {
    device: D,
    /// Whether the driver holds each buffer.
    queued: Vec<bool>,
    is_streaming: bool,
    /// Error of returning a buffer, reported by the next call.
    fault: Option<io::Error>,
}

impl<D: BufferDevice> BufferQueue<D> {
    pub fn new(device: D) -> Self {
        Self { device, queued: Vec::new(), is_streaming: false, fault: None }
    }

    /// Returns the device, for settings.
    pub fn device(&mut self) -> &mut D {
        &mut self.device
    }

    /// Allocates and queues the buffers and starts the stream. After an error nothing is allocated.
    pub fn start(&mut self, count: u32) -> io::Result<()> {
        self.stop();
        let started = self.try_start(count);
        if started.is_err() {
            let is_freed = !self.queued.is_empty();
            self.stop();
            if !is_freed {
                let _ = self.device.allocate(0);
            }
        }
        started
    }

    fn try_start(&mut self, count: u32) -> io::Result<()> {
        let count = self.device.allocate(count)?;
        if (count as usize) < MIN_QUEUED {
            return Err(io::Error::new(io::ErrorKind::OutOfMemory, format!("the driver has only {count} buffers")));
        }
        self.queued = vec![false; count as usize];
        for index in 0..count {
            self.device.enqueue(index)?;
            self.queued[index as usize] = true;
        }
        self.device.start()?;
        self.is_streaming = true;
        Ok(())
    }

    /// Stops the stream and frees the buffers, ignoring errors.
    pub fn stop(&mut self) {
        if self.is_streaming {
            let _ = self.device.stop();
        }
        if !self.queued.is_empty() {
            let _ = self.device.allocate(0);
        }
        self.is_streaming = false;
        self.queued.clear();
        self.fault = None;
    }

    /// Returns the next buffer, `None` on timeout. Any error ends the stream: [`Self::start`] it again.
    pub fn next(&mut self, timeout: Duration) -> io::Result<Option<Lease<'_, D>>> {
        if let Some(fault) = self.fault.take() {
            return Err(fault);
        }
        if !self.is_streaming {
            return Err(io::Error::new(io::ErrorKind::NotConnected, "the stream is not running"));
        }
        let deadline = Instant::now().checked_add(timeout);
        loop {
            let left = deadline.map_or(timeout, |deadline| deadline.saturating_duration_since(Instant::now()));
            if !self.device.wait(left)? {
                return Ok(None);
            }
            match self.device.dequeue() {
                Ok(buffer) => match self.queued.get_mut(buffer.index as usize) {
                    Some(queued) if *queued => {
                        *queued = false;
                        return Ok(Some(Lease { queue: self, buffer }));
                    }
                    _ => {
                        let text = format!("the driver gave buffer {}, which it did not have", buffer.index);
                        return Err(io::Error::new(io::ErrorKind::InvalidData, text));
                    }
                },
                // A wake-up without a buffer; poll cannot turn for ever on it, since the time runs out.
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    if left.is_zero() {
                        return Ok(None);
                    }
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn give_back(&mut self, index: u32) {
        match self.device.enqueue(index) {
            Ok(()) => self.queued[index as usize] = true,
            Err(error) => {
                let left = self.queued.iter().filter(|&&queued| queued).count();
                tracing::debug!(index, left, "a buffer was not taken back: {error}");
                if left < MIN_QUEUED {
                    self.fault = Some(error);
                }
            }
        }
    }
}

impl<D: BufferDevice> Drop for BufferQueue<D> {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Buffer held by the reader; dropping it returns it to the driver.
#[derive(Debug)]
pub(crate) struct Lease<'a, D: BufferDevice> {
    queue: &'a mut BufferQueue<D>,
    pub buffer: Delivered,
}

impl<D: BufferDevice> Lease<'_, D> {
    /// Returns the payload of a plane; shorter than reported where the report exceeds the memory.
    pub fn plane(&self, plane: usize) -> &[u8] {
        let memory = self.queue.device.plane(self.buffer.index, plane);
        let (start, length) = self.buffer.ranges.get(plane).copied().unwrap_or_default();
        // For several planes the length includes what lies before the data.
        let end = length.min(memory.len());
        memory.get(start..end).unwrap_or(&[])
    }
}

impl<D: BufferDevice> Drop for Lease<'_, D> {
    fn drop(&mut self) {
        self.queue.give_back(self.buffer.index);
    }
}

#[cfg(test)]
#[path = "queue_tests.rs"]
pub(crate) mod tests;
