//! Writer of recordings, in a thread beside a running rig.

use std::{
    io,
    path::Path,
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread::{Builder, JoinHandle},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use crossbeam::channel::{Receiver, RecvTimeoutError, bounded};
use flyrig_types::caught;
use mcap::{McapError, McapResult};

use super::{
    compress::Compression,
    disk::{Disk, Folder},
    messages::cause,
    outlet::{Item, Note, Outlet, OutletState, Recorded, WAITING_FRAMES},
    part::{Link, RecordingPart},
    rotation::Rotation,
    tap::{MessageTap, Recording, SourceTap},
};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::source::CameraSource;

/// Free space that a recording leaves on its file system by default, bytes: room for its index and for other programs.
pub const RESERVE_BYTES: u64 = 1 << 30;

/// Size and duration at which a chunk ends. A killed process loses the chunk and what waits for it, together less than
/// half a second.
const CHUNK_BYTES: u64 = 8 << 20;
const CHUNK_TIME: Duration = Duration::from_millis(150);
/// Interval between syncs to the disk: the most that a power cut loses, besides a chunk.
const SYNC_TIME: Duration = Duration::from_secs(2);
/// Interval between looks at the free space of a full disk.
const PROBE_TIME: Duration = Duration::from_secs(1);

/// Settings of a [`Recorder`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecorderConfig {
    /// Compression of uncompressed images; without it every image is recorded unchanged.
    pub compression: Option<Compression>,
    /// Limits at which a new file begins.
    pub rotation: Rotation,
    /// Free space that is left on the file system, bytes: without it no recording starts, and a running one ends its
    /// file and begins the next one when there is space again.
    pub reserve_bytes: u64,
}

impl Default for RecorderConfig {
    fn default() -> Self {
        Self { compression: None, rotation: Rotation::default(), reserve_bytes: RESERVE_BYTES }
    }
}

/// Recorder of frames to a file, in a thread of its own. It never drops a frame silently: when the disk is gone or too
/// slow, the recording stops with a message and the rig continues; while the disk is full, and where compression is too
/// slow, frames are dropped and counted.
#[derive(Debug)]
pub struct Recorder {
    outlet: Outlet,
    compression: Option<Compression>,
    thread: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Starts a recording with default settings but for the compression; see [`Self::create_with`].
    ///
    /// # Errors
    /// As [`Self::create_with`].
    pub fn create(path: &Path, notes: &[Note], compression: Option<Compression>) -> Result<Self, CaptureError> {
        Self::create_with(path, notes, &RecorderConfig { compression, ..RecorderConfig::default() })
    }

    /// Creates a file, which must not exist yet, and writes the notes into it. With a [`Rotation`], and after the disk
    /// was full, it continues in `take-0001.mcap`, `take-0002.mcap` ... beside `take.mcap`, each complete by itself.
    ///
    /// # Errors
    /// `Io` names the system's error, an existing file, or the missing space.
    pub fn create_with(path: &Path, notes: &[Note], config: &RecorderConfig) -> Result<Self, CaptureError> {
        let io = |error: &dyn std::fmt::Display| {
            CaptureError::general(CaptureErrorKind::Io, format!("{} cannot be recorded to: {error}", path.display()))
        };
        let folder = Folder::new(path);
        let second = folder.path(1);
        // Found now rather than in the middle of the recording.
        if config.rotation.is_on() && second.exists() {
            return Err(io(&format!("{} is there already; name another file", second.display())));
        }
        Self::start(folder, notes, config).map_err(|error| io(&cause(&error)))
    }

    pub(super) fn start<D: Disk>(mut disk: D, notes: &[Note], config: &RecorderConfig) -> McapResult<Self> {
        let free_bytes = disk.free_bytes();
        if let Some(shortage) = shortage(free_bytes, config.reserve_bytes) {
            return Err(McapError::Io(io::Error::new(io::ErrorKind::StorageFull, shortage)));
        }
        let link = Link { recording: new_id(), part: 0 };
        let part = RecordingPart::create(&mut disk, notes, link.clone())?;
        let (sender, receiver) = bounded(WAITING_FRAMES);
        let shared = Arc::new(OutletState {
            waiting_bytes: AtomicUsize::new(0),
            state: Mutex::new(Recorded { free_bytes, ..Recorded::default() }),
            started: Instant::now(),
            took: OnceLock::new(),
            is_ending: AtomicBool::new(false),
        });
        shared.begin_file(disk.path(0));
        let of_thread = Arc::clone(&shared);
        let mut writing = Writing {
            disk,
            notes: notes.to_vec(),
            rotation: config.rotation,
            reserve_bytes: config.reserve_bytes,
            link,
            shared: Arc::clone(&shared),
            fresh: Recorded::default(),
            unflushed: 0,
            flushed: Instant::now(),
            is_dirty: false,
            synced: Instant::now(),
            probed: Instant::now(),
        };
        let thread = Builder::new().name("recorder".to_owned()).spawn(move || {
            match caught(move || writing.run(part, &receiver)) {
                Ok(Ok(())) => {}
                Ok(Err(error)) => {
                    let advice = if is_full(&error) { "free space on the disk and record" } else { "record" };
                    of_thread.stop(format!("{}; {advice} into a new file", cause(&error)));
                }
                Err(text) => of_thread.stop(format!("writing failed inside: {text}; record into a new file")),
            }
            of_thread.took.get_or_init(|| of_thread.started.elapsed());
        });
        let outlet = Outlet { sender: Some(sender), shared };
        Ok(Self { outlet, compression: config.compression, thread: Some(thread.map_err(McapError::Io)?) })
    }

    /// Returns the current state.
    #[must_use]
    pub fn state(&self) -> Recorded {
        let shared = &self.outlet.shared;
        let elapsed = shared.took.get().copied().unwrap_or_else(|| shared.started.elapsed());
        Recorded { elapsed, ..shared.lock().clone() }
    }

    /// Returns a tap to record sources that are opened elsewhere or later.
    #[must_use]
    pub fn source_tap(&self) -> SourceTap {
        SourceTap { outlet: self.outlet.clone(), compression: self.compression }
    }

    /// Records the frames of a source as they pass.
    ///
    /// # Errors
    /// `Io` when the system cannot start a thread for the compression.
    pub fn tap<S: CameraSource>(&self, source: S) -> Result<Recording<S>, CaptureError> {
        self.source_tap().tap(source)
    }

    /// Creates a channel for messages of one kind beside the frames: topic, and name, encoding and content of their
    /// schema.
    #[must_use]
    pub fn messages(&self, topic: &str, schema: (String, String, Vec<u8>)) -> MessageTap {
        MessageTap::new(self.outlet.clone(), topic, schema)
    }

    /// Waits until everything is on the disk and closes the file with its index. Later frames and messages of a
    /// [`Recording`] or [`MessageTap`] are not recorded.
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
    /// Completes the file of a rig that ends with an error.
    fn drop(&mut self) {
        self.end();
    }
}

fn is_full(error: &McapError) -> bool {
    matches!(error, McapError::Io(error) if error.kind() == io::ErrorKind::StorageFull)
}

/// Describes the missing space when less than the reserve is free.
fn shortage(free_bytes: Option<u64>, reserve_bytes: u64) -> Option<String> {
    let free_bytes = free_bytes.filter(|free| *free < reserve_bytes)?;
    let mb = |bytes: u64| bytes / 1_000_000;
    Some(format!(
        "only {} MB are free on its file system, and a recording leaves {} MB; free space or record to another disk",
        mb(free_bytes),
        mb(reserve_bytes)
    ))
}

/// Returns an identifier that is unique among the recordings of this machine.
fn new_id() -> String {
    let time = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    format!("{:x}-{:x}", time.as_nanos(), std::process::id())
}

/// State of the recorder's thread.
struct Writing<D: Disk> {
    disk: D,
    notes: Vec<Note>,
    rotation: Rotation,
    reserve_bytes: u64,
    /// Link of the current part.
    link: Link,
    shared: Arc<OutletState>,
    /// Frames of the chunk in memory, which count once they are in the file.
    fresh: Recorded,
    /// Bytes of that chunk.
    unflushed: u64,
    flushed: Instant,
    /// Whether the file has bytes that are not durable yet.
    is_dirty: bool,
    synced: Instant,
    /// Time of the last look at the free space.
    probed: Instant,
}

impl<D: Disk> Writing<D> {
    /// Writes items until the recording ends. While the disk is full there is no part, and items are dropped.
    fn run(&mut self, part: RecordingPart<D>, items: &Receiver<Item>) -> McapResult<()> {
        let mut part = Some(part);
        loop {
            let until_due =
                if self.unflushed > 0 { CHUNK_TIME.saturating_sub(self.flushed.elapsed()) } else { CHUNK_TIME };
            let written = match items.recv_timeout(until_due) {
                Ok(item) => self.write(&mut part, &item),
                Err(RecvTimeoutError::Timeout) => Ok(()),
                Err(RecvTimeoutError::Disconnected) => break,
            };
            // A frame that could not wait has ended it, or all that waited is written.
            let is_ending = self.shared.is_ending.load(Ordering::Relaxed);
            if self.shared.lock().problem.is_some() || (is_ending && items.is_empty()) {
                written?;
                break;
            }
            match written.and_then(|()| self.make_durable(&mut part)) {
                Err(error) if is_full(&error) => self.pause_after(error, &mut part)?,
                done => done?,
            }
        }
        let paused = self.shared.lock().paused.take();
        if let Some(shortage) = paused {
            self.shared.stop(shortage);
        }
        part.map_or(Ok(()), |part| self.finish(part))
    }

    fn write(&mut self, part: &mut Option<RecordingPart<D>>, item: &Item) -> McapResult<()> {
        self.shared.waiting_bytes.fetch_sub(item.payload.len(), Ordering::Relaxed);
        let is_due = |(bytes, begun): (u64, Instant)| self.rotation.is_due(bytes, begun.elapsed());
        if part.as_ref().and_then(|part| part.with(item)).is_some_and(is_due)
            && let Some(ended) = part.take()
        {
            self.finish(ended)?;
            if self.has_space() {
                *part = Some(self.next()?);
            }
        }
        if part.is_none() && self.probed.elapsed() >= PROBE_TIME && self.has_space() {
            *part = Some(self.next()?);
            tracing::warn!("there is space again: the recording goes on in {}", self.shared.lock().file.display());
        }
        let written = part.as_mut().map(|part| part.write(item));
        match &written {
            Some(Ok(())) => self.count(item),
            Some(Err(_)) | None => self.shared.lock().dropped += u64::from(item.bytes_sent.is_some()),
        }
        written.unwrap_or(Ok(()))
    }

    /// Flushes a chunk that is due, and syncs the file to the disk; ends the file when the disk is nearly full.
    fn make_durable(&mut self, part: &mut Option<RecordingPart<D>>) -> McapResult<()> {
        let is_due = self.unflushed >= CHUNK_BYTES || (self.unflushed > 0 && self.flushed.elapsed() >= CHUNK_TIME);
        if let Some(file) = part.as_mut().filter(|_| is_due) {
            file.flush()?;
            self.is_dirty = true;
            self.now_in_file();
            if !self.has_space()
                && let Some(ended) = part.take()
            {
                return self.finish(ended);
            }
        }
        if self.is_dirty && self.synced.elapsed() >= SYNC_TIME {
            self.disk.sync()?;
            (self.is_dirty, self.synced) = (false, Instant::now());
        }
        Ok(())
    }

    /// Pauses after a write that did not fit on the disk. The file breaks off, but everything before is readable.
    fn pause_after(&mut self, error: McapError, part: &mut Option<RecordingPart<D>>) -> McapResult<()> {
        drop(part.take());
        let lost = std::mem::take(&mut self.fresh).frames;
        self.shared.lock().dropped += lost;
        (self.is_dirty, self.unflushed) = (false, 0);
        // Without a measure of free space nothing says when to go on; a quota leaves space that cannot be used.
        if self.disk.free_bytes().is_none() || self.has_space() { Err(error) } else { Ok(()) }
    }

    fn count(&mut self, item: &Item) {
        let length = item.payload.len();
        self.unflushed += length as u64;
        if let Some(bytes_sent) = item.bytes_sent {
            self.fresh.frames += 1;
            self.fresh.bytes += length as u64;
            self.fresh.bytes_sent += bytes_sent as u64;
        }
    }

    fn now_in_file(&mut self) {
        self.shared.add(&std::mem::take(&mut self.fresh));
        (self.flushed, self.unflushed) = (Instant::now(), 0);
    }

    /// Returns whether the reserve is free; pauses the recording otherwise.
    fn has_space(&mut self) -> bool {
        self.probed = Instant::now();
        let free_bytes = self.disk.free_bytes();
        let shortage = shortage(free_bytes, self.reserve_bytes);
        let has_space = shortage.is_none();
        let mut state = self.shared.lock();
        state.free_bytes = free_bytes;
        if let Some(shortage) = shortage.as_ref().filter(|_| state.paused.is_none()) {
            tracing::error!("the recording pauses after {} frames: {shortage}", state.frames);
        }
        state.paused = shortage;
        has_space
    }

    fn finish(&mut self, part: RecordingPart<D>) -> McapResult<()> {
        part.finish(&mut self.disk)?;
        self.now_in_file();
        (self.is_dirty, self.synced) = (false, Instant::now());
        Ok(())
    }

    /// Begins the next file.
    fn next(&mut self) -> McapResult<RecordingPart<D>> {
        let link = Link { part: self.link.part.saturating_add(1), ..self.link.clone() };
        let path = self.disk.path(link.part);
        let named = |error| match error {
            McapError::Io(error) => {
                let text = format!("{} cannot be created: {error}", path.display());
                McapError::Io(io::Error::new(error.kind(), text))
            }
            other => other,
        };
        let part = RecordingPart::create(&mut self.disk, &self.notes, link.clone()).map_err(named)?;
        self.link = link;
        self.shared.begin_file(path);
        Ok(part)
    }
}
