//! Bounded queue of messages to the writer's thread, which never blocks on the disk.

use std::{
    path::PathBuf,
    sync::{
        Arc, Mutex, MutexGuard, OnceLock,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use crossbeam::channel::{Sender, TrySendError};
use flyrig_types::{Frame, lock};

use super::message::{self, Channel};

/// Frames and bytes that may wait for the disk, which stalls while it makes bytes durable.
pub(super) const WAITING_FRAMES: usize = 4096;
const WAITING_BYTES: usize = 512 << 20;

/// Message before the first frame of the file, such as a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct Note {
    /// Topic of the message.
    pub topic: String,
    /// Name, encoding and content of the message's schema.
    pub schema: (String, String, Vec<u8>),
    /// Payload, protobuf.
    pub payload: Vec<u8>,
}

/// State of a recording; counts are over all of its files.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recorded {
    /// Newest file.
    pub file: PathBuf,
    /// Number of files begun.
    pub files: u32,
    /// Frames in the files.
    pub frames: u64,
    /// Bytes of those frames in the files.
    pub bytes: u64,
    /// Bytes of those frames as the cameras sent them.
    pub bytes_sent: u64,
    /// Frames that were not recorded because compression was too slow or the disk was full.
    pub dropped: u64,
    /// Time since the start; the duration of a recording that has ended.
    pub elapsed: Duration,
    /// Free space of the file system at the last check, bytes; `None` where that is unknown.
    pub free_bytes: Option<u64>,
    /// Missing space, while the recording waits for it.
    pub paused: Option<String>,
    /// Reason why the recording stopped by itself, if it did. Everything written before is readable.
    pub problem: Option<String>,
}

/// Message on its way to the file.
#[derive(Debug)]
pub(super) struct Item {
    pub channel: Arc<Channel>,
    pub nanos: i64,
    pub sequence: u64,
    pub payload: Vec<u8>,
    /// Bytes of the frame as its camera sent it; `None` for other messages.
    pub bytes_sent: Option<usize>,
}

#[derive(Debug)]
pub(super) struct OutletState {
    pub waiting_bytes: AtomicUsize,
    pub state: Mutex<Recorded>,
    pub started: Instant,
    /// Duration of the recording, once it has ended.
    pub took: OnceLock<Duration>,
    /// Whether the file ends with the messages queued now.
    pub is_ending: AtomicBool,
}

/// Sender of messages to the file.
#[derive(Debug, Clone)]
pub(super) struct Outlet {
    /// Queue to the writer; `None` once the recording has stopped.
    pub sender: Option<Sender<Item>>,
    pub shared: Arc<OutletState>,
}

impl OutletState {
    pub fn lock(&self) -> MutexGuard<'_, Recorded> {
        lock(&self.state)
    }

    /// Adds frames that are in the file now.
    pub fn add(&self, fresh: &Recorded) {
        let mut state = self.lock();
        state.frames += fresh.frames;
        state.bytes += fresh.bytes;
        state.bytes_sent += fresh.bytes_sent;
    }

    pub fn stop(&self, problem: String) {
        let mut state = self.lock();
        if state.problem.is_none() {
            tracing::error!("the recording has stopped after {} frames: {problem}", state.frames);
            state.problem = Some(problem);
        }
    }

    pub fn begin_file(&self, file: PathBuf) {
        let mut state = self.lock();
        state.file = file;
        state.files += 1;
    }
}

impl Outlet {
    /// Queues a message without blocking.
    fn send(&mut self, item: Item) {
        let Some(sender) = &self.sender else { return };
        let too_slow = || {
            let text = "the disk is slower than the cameras; record to a faster one, or send MJPEG";
            self.shared.stop(text.to_owned());
        };
        let length = item.payload.len();
        if self.shared.waiting_bytes.fetch_add(length, Ordering::Relaxed) > WAITING_BYTES {
            return too_slow();
        }
        match sender.try_send(item) {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => too_slow(),
            // The thread has logged why it ended.
            Err(TrySendError::Disconnected(_)) => self.sender = None,
        }
    }

    /// Returns whether the recording still accepts messages.
    pub fn is_open(&mut self) -> bool {
        if self.sender.is_some() && self.shared.lock().problem.is_some() {
            self.sender = None;
        }
        self.sender.is_some()
    }

    /// Records a message other than a frame.
    pub fn message(&mut self, channel: &Arc<Channel>, nanos: i64, sequence: u64, payload: Vec<u8>) {
        self.send(Item { channel: Arc::clone(channel), nanos, sequence, payload, bytes_sent: None });
    }

    /// Records an image of a frame on its channel. `bytes_sent` is its length as the camera sent it.
    pub fn frame(&mut self, channel: &mut Option<Arc<Channel>>, frame: &Frame, bytes_sent: usize) {
        if !self.is_open() {
            return;
        }
        let fresh = Channel::of(frame);
        let channel = match channel {
            // The exposure is that of the camera's first frame: automatic ones would make channels without end.
            Some(before) if before.topic == fresh.topic && before.schema == fresh.schema => Arc::clone(before),
            _ => Arc::clone(channel.insert(Arc::new(fresh))),
        };
        match message::encode(frame) {
            Ok(payload) => {
                let (nanos, sequence, bytes_sent) = (frame.capture_nanos, frame.sequence, Some(bytes_sent));
                self.send(Item { channel, nanos, sequence, payload, bytes_sent });
            }
            Err(error) => self.shared.stop(error.to_string()),
        }
    }
}
