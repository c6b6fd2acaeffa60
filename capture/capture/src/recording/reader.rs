//! Replay of recordings.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use flyrig_types::{CameraId, Frame};

use super::{
    message::{self, TOPIC},
    parts::Parts,
};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::source::CameraSource;

/// Most messages and bytes before the first frame: recordings of other programs may have no frame at all.
const MOST_NOTES: usize = 4096;
const MOST_NOTE_BYTES: usize = 64 << 20;

/// Frame source of one camera of a recording. Frames have the order of the file; a truncated file, as after a crash,
/// ends there with a warning. The first file of a rotated recording ([`crate::Rotation`]) yields the frames of all its
/// files, up to the first missing one; any other file yields its own.
pub struct McapReplay {
    camera: CameraId,
    path: PathBuf,
    topic: String,
    messages: Parts,
    /// Sequence number of the last frame, as 32 bits in the file and extended.
    last: Option<(u32, u64)>,
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
            Err(error) if notes.is_empty() => {
                let text = format!("{} is no recording: {error}", path.display());
                return Err(CaptureError::general(CaptureErrorKind::Corrupt, text));
            }
            // Cut off: what came before counts.
            Err(_) => break,
        }
    }
    Ok(notes)
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
pub fn recorded_spans(path: &Path, cameras: &[CameraId]) -> Result<Vec<RecordedSpan>, CaptureError> {
    let topics: Vec<String> = cameras.iter().map(|camera| format!("{TOPIC}{camera}")).collect();
    let mut spans = vec![RecordedSpan::default(); cameras.len()];
    for message in Parts::open(path)?.map_while(Result::ok) {
        for (span, _) in spans.iter_mut().zip(&topics).filter(|(_, topic)| **topic == message.channel.topic) {
            let nanos = i64::try_from(message.log_time).unwrap_or(i64::MAX);
            span.nanos = [if span.frames == 0 { nanos } else { span.nanos[0] }, nanos];
            span.frames += 1;
        }
    }
    Ok(spans)
}

impl McapReplay {
    /// Opens a file for one camera; each camera reads the file independently.
    ///
    /// # Errors
    /// `NotFound` if the file is missing. A camera that is not in it ends immediately.
    pub fn open(camera: &CameraId, path: &Path) -> Result<Self, CaptureError> {
        Ok(Self {
            camera: camera.clone(),
            path: path.to_owned(),
            topic: format!("{TOPIC}{camera}"),
            messages: Parts::open(path).map_err(|error| error.of(camera))?,
            last: None,
            is_over: false,
        })
    }

    fn end(&mut self) -> CaptureError {
        self.is_over = true;
        CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, "the recording is over")
    }
}

impl CameraSource for McapReplay {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        while !self.is_over {
            let message = match self.messages.next() {
                Some(Ok(message)) => message,
                Some(Err(error)) => {
                    tracing::warn!("camera {}: {} breaks off: {error}", self.camera, self.path.display());
                    return Err(self.end());
                }
                None => break,
            };
            if message.channel.topic != self.topic {
                continue;
            }
            let sequence = self.last.map_or(u64::from(message.sequence), |(before, counted)| {
                match message.sequence.wrapping_sub(before) {
                    step if step <= u32::MAX / 2 => counted.wrapping_add(u64::from(step)),
                    // Back: the camera was opened again and counts from its start.
                    _ => counted.wrapping_add(1),
                }
            });
            self.last = Some((message.sequence, sequence));
            let schema = message.channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
            let image = message::decode(&self.camera, schema, message.data.into_owned())?;
            return Ok(Frame {
                camera: self.camera.clone(),
                sequence,
                capture_nanos: i64::try_from(message.log_time).unwrap_or(i64::MAX),
                exposure_nanos: message::exposure_nanos(&message.channel.metadata),
                image,
                mask: None,
            });
        }
        Err(self.end())
    }
}

impl std::fmt::Debug for McapReplay {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("McapReplay").field("camera", &self.camera).field("path", &self.path).finish_non_exhaustive()
    }
}
