//! Replay of recordings.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use flyrig_types::{CameraId, Frame, shortened};

use super::{
    message::{self, TOPIC},
    messages::cause,
    parts::Parts,
    schemas::Schema,
};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::source::CameraSource;

/// Most messages and bytes before the first frame: recordings of other programs may have no frame at all.
const MOST_NOTES: usize = 4096;
const MOST_NOTE_BYTES: usize = 64 << 20;

/// Camera of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordedCamera {
    /// Name.
    pub id: CameraId,
    /// Topic of its images.
    pub topic: String,
    /// Times of its frames.
    pub times: FrameTimes,
}

impl RecordedCamera {
    /// Returns a camera of a recording by flyrig.
    #[must_use]
    pub fn new(id: CameraId) -> Self {
        Self { topic: format!("{TOPIC}{id}"), times: FrameTimes::Own, id }
    }

    fn is_foreign(&self) -> bool {
        self.times != FrameTimes::Own
    }
}

/// Origin of the times of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameTimes {
    /// Those of flyrig's recordings, whose messages have the times of their images.
    Own,
    /// Times at which another program recorded the messages.
    Logged,
    /// Timestamps in the messages of another program.
    Stamped,
}

impl FrameTimes {
    fn nanos(self, log_time: u64, stamp_nanos: i64) -> i64 {
        match self {
            Self::Own | Self::Logged => i64::try_from(log_time).unwrap_or(i64::MAX),
            Self::Stamped => stamp_nanos,
        }
    }
}

/// Frame source of one camera of a recording. Frames have the order of the file; a truncated file, as after a crash,
/// ends there with a warning. The first file of a rotated recording ([`crate::Rotation`]) yields the frames of all its
/// files, up to the first missing one; any other file yields its own.
pub struct McapReplay {
    camera: RecordedCamera,
    path: PathBuf,
    messages: Parts,
    /// Sequence number of the last frame, as 32 bits in the file and extended.
    last: Option<(u32, u64)>,
    /// Time of the last frame of another program's recording, nanoseconds, and the number of those out of order.
    order: (i64, u64),
    is_over: bool,
}

/// Returns topic and content of every message before the first frame of a recording. Every file of a rotated one holds
/// them.
///
/// # Errors
/// `NotFound` if the file is missing, `Corrupt` when it is no MCAP file.
pub fn recorded_notes(path: &Path) -> Result<Vec<(String, Vec<u8>)>, CaptureError> {
    let (mut notes, mut bytes) = (Vec::new(), 0usize);
    for message in Parts::open(path)? {
        if notes.len() >= MOST_NOTES || bytes >= MOST_NOTE_BYTES {
            break;
        }
        match message {
            Ok(message) if message.channel.topic.starts_with(TOPIC) => break,
            Ok(message) => {
                bytes = bytes.saturating_add(message.data.len());
                notes.push((message.channel.topic.clone(), message.data.into_owned()));
            }
            Err(error) if notes.is_empty() => return Err(not_readable(path, &error)),
            // Cut off: what came before counts.
            Err(_) => break,
        }
    }
    Ok(notes)
}

/// Returns the error of a file without a readable message.
pub(super) fn not_readable(path: &Path, error: &mcap::McapError) -> CaptureError {
    use std::io::Read as _;
    let mut start = [0; 13];
    let read = std::fs::File::open(path).and_then(|mut file| file.read(&mut start)).unwrap_or(0);
    let is = |magic: &[u8]| start[..read].starts_with(magic);
    let text = match error {
        mcap::McapError::BadMagic if is(&[0x28, 0xb5, 0x2f, 0xfd]) => {
            "the file is compressed as a whole; unpack it with `zstd -d`".to_owned()
        }
        mcap::McapError::BadMagic if is(&[0x1f, 0x8b]) => "the file is compressed; unpack it with `gunzip`".to_owned(),
        mcap::McapError::BadMagic if is(b"#ROSBAG") || is(b"SQLite format") => {
            "it is a bag of ROS in another format; convert it with `mcap convert`".to_owned()
        }
        error => shortened(&cause(error)).into_owned(),
    };
    CaptureError::general(CaptureErrorKind::Corrupt, format!("{} is no recording: {text}", path.display()))
}

/// Returns time, nanoseconds, and content of every message of a topic, in the order of the file, until it is truncated;
/// of a rotated recording, over all its files.
///
/// # Errors
/// `NotFound` if the file is missing.
pub fn recorded_messages(path: &Path, topic: &str) -> Result<impl Iterator<Item = (i64, Vec<u8>)>, CaptureError> {
    let topic = topic.to_owned();
    let messages = Parts::open(path)?.map_while(Result::ok).filter(move |message| message.channel.topic == topic);
    Ok(messages.map(|message| (i64::try_from(message.log_time).unwrap_or(i64::MAX), message.data.into_owned())))
}

/// Frames of a camera in a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RecordedSpan {
    /// Number of frames.
    pub frames: usize,
    /// Timestamps of the first and the last one, nanoseconds.
    pub nanos: [i64; 2],
}

impl RecordedSpan {
    /// Returns the mean frame rate, frames per second; `None` with fewer than two frames or without elapsed time.
    #[must_use]
    pub fn fps(&self) -> Option<f64> {
        let nanos = self.nanos[1].saturating_sub(self.nanos[0]);
        (self.frames > 1 && nanos > 0).then(|| (self.frames - 1) as f64 * 1e9 / nanos as f64)
    }
}

/// Returns the span of each camera. Reads the recording to its end without decoding images.
///
/// # Errors
/// `NotFound` if the file is missing.
pub fn recorded_spans(path: &Path, cameras: &[RecordedCamera]) -> Result<Vec<RecordedSpan>, CaptureError> {
    let mut spans = vec![RecordedSpan::default(); cameras.len()];
    for message in Parts::open(path)?.map_while(Result::ok) {
        let is_of = |camera: &RecordedCamera| camera.topic == message.channel.topic;
        let Some((span, camera)) = spans.iter_mut().zip(cameras).find(|(_, camera)| is_of(camera)) else { continue };
        let stamp_nanos = match camera.times {
            FrameTimes::Own | FrameTimes::Logged => 0,
            FrameTimes::Stamped => {
                let Some(Ok(schema)) = Schema::of(&message.channel) else { continue };
                let Ok(image) = schema.image(message.data.into_owned()) else { continue };
                image.stamp_nanos
            }
        };
        let nanos = camera.times.nanos(message.log_time, stamp_nanos);
        span.nanos = [if span.frames == 0 { nanos } else { span.nanos[0] }, nanos];
        span.frames += 1;
    }
    Ok(spans)
}

impl McapReplay {
    /// Opens a recording of flyrig for one camera; each camera reads the file independently.
    ///
    /// # Errors
    /// `NotFound` if the file is missing. A camera that is not in it ends immediately.
    pub fn open(camera: &CameraId, path: &Path) -> Result<Self, CaptureError> {
        Self::open_camera(&RecordedCamera::new(camera.clone()), path)
    }

    /// Opens a recording for one of its cameras.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_camera(camera: &RecordedCamera, path: &Path) -> Result<Self, CaptureError> {
        let messages = Parts::open(path).map_err(|error| error.of(&camera.id))?;
        let order = (i64::MIN, 0);
        Ok(Self { camera: camera.clone(), path: path.to_owned(), messages, last: None, order, is_over: false })
    }

    fn end(&mut self) -> CaptureError {
        self.is_over = true;
        CaptureError::new(&self.camera.id, CaptureErrorKind::EndOfStream, "the recording is over")
    }

    /// Returns the number of a message's frame. Other programs mostly do not number their messages.
    fn count(&mut self, number: u32) -> u64 {
        let sequence = match (self.camera.is_foreign(), self.last) {
            (true, last) => last.map_or(0, |(_, counted)| counted + 1),
            (false, None) => u64::from(number),
            (false, Some((before, counted))) => match number.wrapping_sub(before) {
                step if step <= u32::MAX / 2 => counted.wrapping_add(u64::from(step)),
                // Back: the camera was opened again and counts from its start.
                _ => counted.wrapping_add(1),
            },
        };
        self.last = Some((number, sequence));
        sequence
    }

    /// Returns whether a frame is later than the one before; other programs' messages may be out of order.
    fn is_in_order(&mut self, nanos: i64) -> bool {
        let (before, count) = &mut self.order;
        if nanos > *before || !self.camera.is_foreign() {
            *before = nanos;
            return true;
        }
        *count += 1;
        if count.is_power_of_two() {
            tracing::warn!(
                count,
                "camera {}: a frame is left out: it is not later than the one before",
                self.camera.id
            );
        }
        false
    }
}

impl CameraSource for McapReplay {
    fn camera(&self) -> &CameraId {
        &self.camera.id
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        while !self.is_over {
            let message = match self.messages.next() {
                Some(Ok(message)) => message,
                Some(Err(error)) => {
                    tracing::warn!("camera {}: {} breaks off: {}", self.camera.id, self.path.display(), cause(&error));
                    return Err(self.end());
                }
                None => break,
            };
            if message.channel.topic != self.camera.topic {
                continue;
            }
            let sequence = self.count(message.sequence);
            let decoded = message::decode(&self.camera.id, &message.channel, message.data.into_owned());
            let (stamp, image) = match decoded {
                // One topic may have images of several kinds; the first decided that they can be read.
                Err(error) if self.camera.is_foreign() && error.kind == CaptureErrorKind::Unsupported => {
                    return Err(CaptureError { kind: CaptureErrorKind::Corrupt, ..error });
                }
                decoded => decoded?,
            };
            let capture_nanos = self.camera.times.nanos(message.log_time, stamp.0);
            if !self.is_in_order(capture_nanos) {
                continue;
            }
            let exposure_nanos = message::exposure_nanos(&message.channel.metadata);
            let camera = self.camera.id.clone();
            return Ok(Frame { camera, sequence, capture_nanos, exposure_nanos, image, mask: None });
        }
        Err(self.end())
    }
}

impl std::fmt::Debug for McapReplay {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("McapReplay").field("camera", &self.camera.id).field("path", &self.path).finish_non_exhaustive()
    }
}
