//! The ring of buffers that a driver fills and we empty.

use std::{
    io,
    time::{Duration, Instant},
};

use super::sys::MAX_PLANES;
use crate::stamps::StampSource;

/// Fewest buffers in the driver's hands with which a stream flows; a driver without a free buffer drops frames.
const MIN_QUEUED: usize = 2;

/// A buffer that the driver has given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Delivered {
    pub index: u32,
    /// Of the driver, modulo 2^32.
    pub sequence: u32,
    /// Whether the driver says that its content is damaged.
    pub is_broken: bool,
    pub stamp_nanos: i64,
    pub stamp_source: StampSource,
    /// Start and length of the payload in each plane, bytes, as the driver says.
    pub ranges: [(usize, usize); MAX_PLANES],
}

/// The calls of a streaming device; a scripted one stands in for it in tests.
pub(crate) trait BufferDevice {
    /// Makes buffers (none: frees them) and gives how many there are.
    fn allocate(&mut self, count: u32) -> io::Result<u32>;
    fn enqueue(&mut self, index: u32) -> io::Result<()>;
    fn dequeue(&mut self) -> io::Result<Delivered>;
    fn start(&mut self) -> io::Result<()>;
    /// Also takes every buffer out of the driver's queue.
    fn stop(&mut self) -> io::Result<()>;
    /// Whether something is there to dequeue, an error included.
    fn wait(&mut self, timeout: Duration) -> io::Result<bool>;
    /// Memory of a buffer's plane; empty when there is no such one.
    fn plane(&self, index: u32, plane: usize) -> &[u8];
}

/// A streaming device with all buffers in the driver's hands but for the one that is leased.
///
/// Frames are copied out of a [`Lease`] and the lease is dropped at once. Handing leases themselves down the pipeline
/// would save a copy (a tenth of a millisecond for 640x360) and starve the driver: a synchronizer may hold dozens of
/// frames, a driver has four to eight buffers.
#[derive(Debug)]
pub(crate) struct BufferQueue<D: BufferDevice> {
    device: D,
    /// Whether a buffer is in the driver's hands.
    queued: Vec<bool>,
    is_streaming: bool,
    /// Why a buffer could not be given back; told by the next call.
    fault: Option<io::Error>,
}

impl<D: BufferDevice> BufferQueue<D> {
    pub fn new(device: D) -> Self {
        Self { device, queued: Vec::new(), is_streaming: false, fault: None }
    }

    /// The device, for settings.
    pub fn device(&mut self) -> &mut D {
        &mut self.device
    }

    /// Makes buffers, gives them to the driver and starts the stream. After an error nothing is allocated.
    pub fn start(&mut self, count: u32) -> io::Result<()> {
        self.stop();
        let started = self.try_start(count);
        if started.is_err() {
            self.stop();
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

    /// Stops the stream and frees the buffers; what the driver thinks of that no longer matters.
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

    /// The next buffer, `None` when none came in time. Any error ends the stream: [`Self::start`] it again.
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

/// A buffer in our hands; the driver gets it back when this is dropped.
#[derive(Debug)]
pub(crate) struct Lease<'a, D: BufferDevice> {
    queue: &'a mut BufferQueue<D>,
    pub buffer: Delivered,
}

impl<D: BufferDevice> Lease<'_, D> {
    /// Payload of a plane; shorter than the driver says where that is more than there is.
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
pub(crate) mod tests {
    use std::collections::VecDeque;

    use super::*;

    /// What a scripted device does next.
    #[derive(Debug, Clone)]
    pub(crate) enum Step {
        /// The oldest queued buffer comes back with this sequence number and these bytes.
        Frame(u32, Vec<u8>),
        /// The same, flagged as damaged.
        Broken(u32),
        /// A buffer that was never queued.
        Stranger,
        /// DQBUF fails.
        Fail(i32),
        /// QBUF fails from now on, so many times.
        RefuseBack(u32),
        /// Nothing comes for one wait.
        Silence,
    }

    /// A device out of a script. Checks that a buffer is never used by two.
    #[derive(Debug, Default)]
    pub(crate) struct Fake {
        pub script: VecDeque<Step>,
        pub memory: Vec<Vec<u8>>,
        pub queued: VecDeque<u32>,
        pub streaming: bool,
        /// Results of the next STREAMONs.
        pub start_errors: VecDeque<i32>,
        pub allocates: Option<u32>,
        pub refusals: u32,
        pub stamp_nanos: i64,
        pub log: Vec<String>,
    }

    impl BufferDevice for Fake {
        fn allocate(&mut self, count: u32) -> io::Result<u32> {
            assert!(!self.streaming, "REQBUFS while streaming");
            self.log.push(format!("allocate {count}"));
            let count = if count == 0 { 0 } else { self.allocates.unwrap_or(count) };
            self.memory = vec![vec![0; 64]; count as usize];
            self.queued.clear();
            Ok(count)
        }

        fn enqueue(&mut self, index: u32) -> io::Result<()> {
            assert!(!self.queued.contains(&index), "buffer {index} is queued twice");
            if self.refusals > 0 {
                self.refusals -= 1;
                return Err(io::Error::from_raw_os_error(libc::EIO));
            }
            self.queued.push_back(index);
            Ok(())
        }

        fn dequeue(&mut self) -> io::Result<Delivered> {
            let mut delivered = Delivered {
                index: 0,
                sequence: 0,
                is_broken: false,
                stamp_nanos: self.stamp_nanos,
                stamp_source: StampSource::EndOfFrame,
                ranges: [(0, 0); MAX_PLANES],
            };
            match self.script.pop_front() {
                Some(Step::Frame(sequence, bytes)) => {
                    delivered.index = self.queued.pop_front().expect("a frame needs a queued buffer");
                    delivered.sequence = sequence;
                    delivered.ranges[0] = (0, bytes.len());
                    self.memory[delivered.index as usize] = bytes;
                }
                Some(Step::Broken(sequence)) => {
                    delivered.index = self.queued.pop_front().expect("a frame needs a queued buffer");
                    (delivered.sequence, delivered.is_broken) = (sequence, true);
                }
                Some(Step::Stranger) => delivered.index = 77,
                Some(Step::Fail(errno)) => return Err(io::Error::from_raw_os_error(errno)),
                Some(Step::RefuseBack(times)) => {
                    self.refusals = times;
                    return Err(io::Error::from_raw_os_error(libc::EAGAIN));
                }
                Some(Step::Silence) | None => return Err(io::Error::from_raw_os_error(libc::EAGAIN)),
            }
            Ok(delivered)
        }

        fn start(&mut self) -> io::Result<()> {
            if let Some(errno) = self.start_errors.pop_front()
                && errno != 0
            {
                return Err(io::Error::from_raw_os_error(errno));
            }
            self.streaming = true;
            self.log.push("start".to_owned());
            Ok(())
        }

        fn stop(&mut self) -> io::Result<()> {
            self.streaming = false;
            self.queued.clear();
            self.log.push("stop".to_owned());
            Ok(())
        }

        fn wait(&mut self, _timeout: Duration) -> io::Result<bool> {
            match self.script.front() {
                Some(Step::Silence) => {
                    self.script.pop_front();
                    Ok(false)
                }
                other => Ok(other.is_some()),
            }
        }

        fn plane(&self, index: u32, plane: usize) -> &[u8] {
            if plane > 0 { &[] } else { self.memory.get(index as usize).map_or(&[], Vec::as_slice) }
        }
    }

    const LONG: Duration = Duration::from_secs(60);

    fn queue(script: Vec<Step>) -> BufferQueue<Fake> {
        let mut queue = BufferQueue::new(Fake { script: script.into(), ..Fake::default() });
        queue.start(4).unwrap();
        queue
    }

    #[test]
    fn a_lease_has_the_bytes_and_goes_back_when_dropped() {
        let mut queue = queue((0..100).map(|n| Step::Frame(n, vec![n as u8; 5])).collect());
        for n in 0..100 {
            let lease = queue.next(LONG).unwrap().unwrap();
            assert_eq!((lease.buffer.sequence, lease.plane(0)), (n, &[n as u8; 5][..]));
            assert_eq!((lease.plane(1), lease.plane(99)), (&[][..], &[][..]));
            assert_eq!(lease.queue.device.queued.len(), 3);
            drop(lease);
            assert_eq!(queue.device.queued.len(), 4);
        }
        assert!(queue.next(Duration::ZERO).unwrap().is_none());
    }

    #[test]
    fn payloads_longer_than_the_memory_are_cut() {
        let mut queue = queue(vec![Step::Frame(0, vec![1, 2, 3]), Step::Frame(1, vec![1, 2, 3])]);
        let mut lease = queue.next(LONG).unwrap().unwrap();
        lease.buffer.ranges[0] = (1, 1000);
        assert_eq!(lease.plane(0), [2, 3]);
        lease.buffer.ranges[0] = (usize::MAX, usize::MAX);
        assert!(lease.plane(0).is_empty());
    }

    #[test]
    fn silence_is_no_error_and_errors_come_through() {
        let mut queue = queue(vec![Step::Silence, Step::Broken(4), Step::Fail(libc::ENODEV)]);
        assert!(queue.next(LONG).unwrap().is_none());
        assert!(queue.next(LONG).unwrap().unwrap().buffer.is_broken);
        assert_eq!(queue.next(LONG).unwrap_err().raw_os_error(), Some(libc::ENODEV));
    }

    #[test]
    fn a_buffer_that_the_driver_did_not_have_ends_the_stream() {
        assert_eq!(queue(vec![Step::Stranger]).next(LONG).unwrap_err().kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn lost_buffers_are_borne_until_too_few_are_left() {
        let frames = |n| (0..n).map(|n| Step::Frame(n, vec![1]));
        let mut queue = queue([Step::RefuseBack(3)].into_iter().chain(frames(9)).collect());
        for _ in 0..2 {
            assert!(queue.next(LONG).unwrap().is_some());
        }
        assert!(queue.next(LONG).unwrap().is_some(), "two buffers are left, one of them leased");
        assert_eq!(queue.next(LONG).unwrap_err().raw_os_error(), Some(libc::EIO));
        queue.start(4).unwrap();
        assert!(queue.next(LONG).unwrap().is_some(), "a fresh start heals it");
    }

    #[test]
    fn a_failed_start_leaves_nothing_behind() {
        let mut queue = BufferQueue::new(Fake { start_errors: [libc::ENOSPC].into(), ..Fake::default() });
        assert_eq!(queue.start(4).unwrap_err().raw_os_error(), Some(libc::ENOSPC));
        assert!(queue.device.queued.is_empty() && queue.device.memory.is_empty());
        assert_eq!(queue.next(LONG).unwrap_err().kind(), io::ErrorKind::NotConnected);
        queue.start(4).unwrap();
        queue.stop();
        assert_eq!(queue.device.log, ["allocate 4", "allocate 0", "allocate 4", "start", "stop", "allocate 0"]);
        queue.device.allocates = Some(1);
        assert_eq!(queue.start(4).unwrap_err().kind(), io::ErrorKind::OutOfMemory);
    }
}
