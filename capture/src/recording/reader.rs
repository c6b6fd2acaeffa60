//! Playing a recording.

use std::{
    fs::File,
    io::BufReader,
    path::{Path, PathBuf},
    time::Duration,
};

use flyrig_types::{CameraId, Frame};
use mcap::{io::MessageReader, sans_io::LinearReaderOptions};

use super::message::{self, TOPIC};
use crate::{CameraSource, CaptureError, CaptureErrorKind};

/// Bytes read at once.
const BUFFER: usize = 1 << 20;
/// Most messages and bytes before the first frame: other people's recordings may have no frame at all.
const MOST_NOTES: usize = 4096;
const MOST_NOTE_BYTES: usize = 64 << 20;

/// One camera of a recording. Frames come as they were recorded, in the order of the file; one that breaks off, as after
/// a crash, ends there with a warning.
pub struct McapReplay {
    camera: CameraId,
    path: PathBuf,
    topic: String,
    messages: MessageReader<BufReader<File>>,
    /// Number of the last frame in the file, of 32 bits, and in all.
    last: Option<(u32, u64)>,
    is_over: bool,
}

fn open(path: &Path) -> Result<MessageReader<BufReader<File>>, CaptureError> {
    let cannot = |error: std::io::Error| {
        CaptureError::general(CaptureErrorKind::NotFound, format!("{} cannot be opened: {error}", path.display()))
    };
    let file = File::open(path).map_err(cannot)?;
    // A damaged length must not ask for more memory than the file has bytes.
    let length = usize::try_from(file.metadata().map_err(cannot)?.len()).unwrap_or(usize::MAX);
    let options = LinearReaderOptions::default().with_record_length_limit(length);
    Ok(MessageReader::new_with_options(BufReader::with_capacity(BUFFER, file), options))
}

/// Topic and content of everything before the first frame of a recording.
///
/// # Errors
/// `NotFound` without the file, `Corrupt` when it is no MCAP file.
pub fn recorded_notes(path: &Path) -> Result<Vec<(String, Vec<u8>)>, CaptureError> {
    let (mut notes, mut bytes) = (Vec::new(), 0usize);
    for message in open(path)? {
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

/// Time, nanoseconds, and content of every message of a topic, in the order of the file, until it breaks off.
///
/// # Errors
/// `NotFound` without the file.
pub fn recorded_messages(path: &Path, topic: &str) -> Result<impl Iterator<Item = (i64, Vec<u8>)>, CaptureError> {
    let topic = topic.to_owned();
    let messages = open(path)?.map_while(Result::ok).filter(move |message| message.channel.topic == topic);
    Ok(messages.map(|message| (i64::try_from(message.log_time).unwrap_or(i64::MAX), message.data.into_owned())))
}

impl McapReplay {
    /// Opens a file for one camera; each camera reads the file by itself.
    ///
    /// # Errors
    /// `NotFound` without the file. A camera that is not in it ends at once.
    pub fn open(camera: &CameraId, path: &Path) -> Result<Self, CaptureError> {
        Ok(Self {
            camera: camera.clone(),
            path: path.to_owned(),
            topic: format!("{TOPIC}{camera}"),
            messages: open(path).map_err(|error| error.of(camera))?,
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
                counted.wrapping_add(u64::from(message.sequence.wrapping_sub(before)))
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
