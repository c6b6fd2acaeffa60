//! Writing a recording beside a running rig.

use std::{
    fs::OpenOptions,
    io::{BufWriter, Seek, Write},
    path::Path,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread::{Builder, JoinHandle},
    time::{Duration, Instant},
};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use flyrig_types::Frame;
use mcap::{McapError, WriteOptions, Writer, records::MessageHeader};

use super::{
    compress::Compression,
    message::{self, Channel},
    tap::{MessageTap, Recording},
};
use crate::{CameraSource, CaptureError, CaptureErrorKind};

/// A chunk ends after so many bytes or so long: what a killed process loses at most.
const CHUNK_BYTES: u64 = 8 << 20;
const CHUNK_TIME: Duration = Duration::from_millis(500);
/// Frames and bytes that may wait for the disk.
const WAITING_FRAMES: usize = 512;
const WAITING_BYTES: usize = 512 << 20;

/// Something to find in the file before the first frame, like a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct Note {
    /// Topic of the message.
    pub topic: String,
    /// Name, encoding and content of the message's schema.
    pub schema: (String, String, Vec<u8>),
    /// The message, protobuf.
    pub payload: Vec<u8>,
}

/// How a recording stands.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recorded {
    /// Frames in the file.
    pub frames: u64,
    /// Their bytes in the file.
    pub bytes: u64,
    /// Their bytes as the cameras sent them.
    pub bytes_sent: u64,
    /// Frames that were not recorded because compressing them took too long.
    pub dropped: u64,
    /// Why it has stopped, if it has. What was written before is readable.
    pub problem: Option<String>,
}

/// A message on its way to the file.
#[derive(Debug)]
struct Item {
    channel: Arc<Channel>,
    nanos: i64,
    sequence: u64,
    payload: Vec<u8>,
    /// Bytes of the frame as its camera sent it; none for what is no frame.
    bytes_sent: Option<usize>,
}

#[derive(Debug, Default)]
pub(super) struct Shared {
    waiting_bytes: AtomicUsize,
    state: Mutex<Recorded>,
    /// The file ends with what waits now.
    is_ending: AtomicBool,
}

/// Writes frames to a file in a thread of its own. It never drops a frame silently: when the disk is full, gone or too
/// slow, the recording stops and says so, and the rig goes on; what could not be compressed in time is counted.
#[derive(Debug)]
pub struct Recorder {
    outlet: Outlet,
    compression: Option<Compression>,
    thread: Option<JoinHandle<()>>,
}

/// A way into the file.
#[derive(Debug, Clone)]
pub(super) struct Outlet {
    /// None once the recording has stopped.
    sender: Option<Sender<Item>>,
    pub shared: Arc<Shared>,
}

impl Shared {
    pub fn lock(&self) -> MutexGuard<'_, Recorded> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Frames that are in the file now.
    fn add(&self, fresh: &Recorded) {
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
}

impl Recorder {
    /// Makes a file, which must not be there yet, and writes the notes into it. Without compression every picture is
    /// recorded as it came.
    ///
    /// # Errors
    /// `Io` says what the system refused.
    pub fn create(path: &Path, notes: &[Note], compression: Option<Compression>) -> Result<Self, CaptureError> {
        let io = |error: &dyn std::fmt::Display| {
            CaptureError::general(CaptureErrorKind::Io, format!("{} cannot be recorded to: {error}", path.display()))
        };
        let file = OpenOptions::new().write(true).create_new(true).open(path).map_err(|error| io(&error))?;
        Self::start(BufWriter::with_capacity(1 << 20, file), notes, compression).map_err(|error| io(&cause(error)))
    }

    pub(super) fn start<W: Write + Seek + Send + 'static>(
        target: W,
        notes: &[Note],
        compression: Option<Compression>,
    ) -> mcap::McapResult<Self> {
        // Chunks are made in memory and written whole: a killed process leaves no half of one behind.
        let options = WriteOptions::new().compression(None).chunk_size(None).disable_seeking(true);
        let mut writer = Writer::with_options(target, options.library(concat!("flyrig ", env!("CARGO_PKG_VERSION"))))?;
        for (sequence, note) in (0..).zip(notes) {
            let (name, encoding, data) = &note.schema;
            let schema = writer.add_schema(name, encoding, data)?;
            let channel_id = writer.add_channel(schema, &note.topic, "protobuf", &Default::default())?;
            let header = MessageHeader { channel_id, sequence, log_time: 0, publish_time: 0 };
            writer.write_to_known_channel(&header, &note.payload)?;
        }
        writer.flush()?;
        let (sender, receiver) = bounded(WAITING_FRAMES);
        let shared = Arc::new(Shared::default());
        let of_thread = Arc::clone(&shared);
        let thread = Builder::new().name("recorder".to_owned()).spawn(move || {
            if let Err(error) = write(writer, &receiver, &of_thread) {
                of_thread.stop(format!("{}; free space on the disk and record into a new file", cause(error)));
            }
        });
        let outlet = Outlet { sender: Some(sender), shared };
        Ok(Self { outlet, compression, thread: Some(thread.map_err(McapError::Io)?) })
    }

    /// How it stands.
    #[must_use]
    pub fn state(&self) -> Recorded {
        self.outlet.shared.lock().clone()
    }

    /// Records what a source gives, on its way.
    ///
    /// # Errors
    /// `Io` when the system gives no thread for the compression.
    pub fn tap<S: CameraSource>(&self, source: S) -> Result<Recording<S>, CaptureError> {
        Recording::new(source, self.outlet.clone(), self.compression)
    }

    /// Records messages of one kind beside the frames: topic, and name, encoding and content of their schema.
    #[must_use]
    pub fn messages(&self, topic: &str, schema: (String, String, Vec<u8>)) -> MessageTap {
        MessageTap::new(self.outlet.clone(), topic, schema)
    }

    /// Waits until everything is on the disk and closes the file with its index. What a [`Recording`] or [`MessageTap`] gives
    /// after that is not recorded.
    #[must_use]
    pub fn finish(mut self) -> Recorded {
        self.end();
        self.state()
    }

    fn end(&mut self) {
        self.outlet.sender = None;
        self.outlet.shared.is_ending.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            self.outlet.shared.stop("it failed inside".to_owned());
        }
    }
}

impl Drop for Recorder {
    /// A rig that ends with an error leaves a whole file too.
    fn drop(&mut self) {
        self.end();
    }
}

impl Outlet {
    /// Hands a message to the disk's thread, without waiting for it.
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
            // The thread has told why it ended.
            Err(TrySendError::Disconnected(_)) => self.sender = None,
        }
    }

    /// Whether anything is still recorded.
    pub fn is_open(&mut self) -> bool {
        if self.sender.is_some() && self.shared.lock().problem.is_some() {
            self.sender = None;
        }
        self.sender.is_some()
    }

    /// Records what is no frame.
    pub fn message(&mut self, channel: &Arc<Channel>, nanos: i64, sequence: u64, payload: Vec<u8>) {
        self.send(Item { channel: Arc::clone(channel), nanos, sequence, payload, bytes_sent: None });
    }

    /// Records a picture of a frame, by its channel. `bytes_sent` is its length as the camera sent it.
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

/// The library's own text says nothing of what the system said.
fn cause(error: McapError) -> String {
    match error {
        McapError::Io(error) => error.to_string(),
        other => other.to_string(),
    }
}

fn write<W: Write + Seek>(mut writer: Writer<W>, items: &Receiver<Item>, shared: &Shared) -> mcap::McapResult<()> {
    let (mut flushed, mut unflushed) = (Instant::now(), 0u64);
    // Of frames that are in the chunk in memory: they count once it is in the file.
    let mut fresh = Recorded::default();
    loop {
        match items.recv_timeout(CHUNK_TIME) {
            Ok(item) => {
                let (name, encoding, data) = &item.channel.schema;
                let schema = writer.add_schema(name, encoding, data)?;
                let channel_id = writer.add_channel(schema, &item.channel.topic, "protobuf", &item.channel.metadata)?;
                let log_time = u64::try_from(item.nanos).unwrap_or(0);
                let sequence = item.sequence as u32;
                let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
                writer.write_to_known_channel(&header, &item.payload)?;
                shared.waiting_bytes.fetch_sub(item.payload.len(), Ordering::Relaxed);
                unflushed += item.payload.len() as u64;
                if let Some(bytes_sent) = item.bytes_sent {
                    fresh.frames += 1;
                    fresh.bytes += item.payload.len() as u64;
                    fresh.bytes_sent += bytes_sent as u64;
                }
                // A frame that could not wait has ended it.
                if shared.lock().problem.is_some() {
                    break;
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        if shared.is_ending.load(Ordering::Relaxed) && items.is_empty() {
            break;
        }
        if unflushed >= CHUNK_BYTES || (unflushed > 0 && flushed.elapsed() >= CHUNK_TIME) {
            writer.flush()?;
            shared.add(&std::mem::take(&mut fresh));
            (flushed, unflushed) = (Instant::now(), 0);
        }
    }
    writer.finish()?;
    writer.into_inner().flush()?;
    shared.add(&fresh);
    Ok(())
}
