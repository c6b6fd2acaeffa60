//! Buffer queue against a scripted device.

use std::collections::VecDeque;

use super::*;

/// Next action of a scripted device.
#[derive(Debug, Clone)]
pub(crate) enum Step {
    /// The oldest queued buffer comes back with this sequence number and these bytes.
    Frame(u32, Vec<u8>),
    /// The oldest queued buffer comes back flagged as damaged.
    Broken(u32),
    /// A buffer that was never queued.
    Stranger,
    /// DQBUF fails.
    Fail(i32),
    /// QBUF fails this many times from now on.
    RefuseBack(u32),
    /// Nothing arrives during one wait.
    Silence,
}

/// Scripted device. Checks that driver and reader never use a buffer at once.
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
    assert_eq!(queue.device.log.last().map(String::as_str), Some("allocate 0"), "too few buffers are given back");
}
