//! Frame sets of stored footage; images of recordings are decoded here.

use std::{collections::BTreeMap, ops::Range, sync::Arc};

use anyhow::Result;
use flyrig_capture::{CaptureError, CaptureErrorKind, Decoding, FolderOptions, FrameStage as _};
use flyrig_fusion::SetReader;
use flyrig_sync::SyncSettings;
use flyrig_types::{Camera, CameraId, Frame, FrameSet, Rig};

use crate::footage::{Footage, OpenFootage};

/// Footage with the frames that are read and the time offsets that are applied.
pub(crate) struct FrameSelection {
    pub footage: Footage,
    /// Frames per second.
    pub fps: f64,
    /// Range of frames; all for `None`.
    pub frames: Option<Range<u64>>,
    /// Time offsets that are subtracted from the timestamps, nanoseconds.
    pub lags_nanos: BTreeMap<CameraId, i64>,
}

impl FrameSelection {
    /// Opens these cameras.
    pub fn open(&self, cameras: &[Camera], with_masks: bool) -> Result<OpenFootage> {
        let ids: Vec<CameraId> = cameras.iter().map(|camera| camera.id.clone()).collect();
        self.footage.open(Some(&ids), &FolderOptions { fps: self.fps, frames: self.frames.clone(), with_masks })
    }

    /// Opens the frame sets of a rig; returns the number of a folder's frames with them.
    pub fn open_sets(&self, rig: &Rig, with_masks: bool) -> Result<(FrameSets, usize)> {
        let OpenFootage { sources, frames, .. } = self.open(&rig.cameras, with_masks)?;
        let sync = SyncSettings {
            // Timestamps of a folder follow from the frame numbers; those of recordings and videos are the cameras'.
            window_nanos: matches!(self.footage, Footage::Folder(_)).then(|| self.half_period_nanos()),
            lags_nanos: self.lags_nanos.clone(),
            ..SyncSettings::default()
        };
        let reader = SetReader::new(sources, &sync);
        let range = self.frames.clone().unwrap_or(0..u64::MAX);
        let sets = if self.is_encoded() {
            FrameSets::recording(reader, &rig.cameras, range)
        } else {
            FrameSets::folder(reader)
        };
        Ok((sets, frames))
    }

    /// Returns whether frames arrive as the cameras sent them, to be decoded here.
    pub fn is_encoded(&self) -> bool {
        matches!(self.footage, Footage::Recording(_))
    }

    /// Returns half of a frame period, within which a frame belongs to one frame set alone, nanoseconds.
    pub fn half_period_nanos(&self) -> u64 {
        (0.5e9 / self.fps).ceil() as u64
    }
}

/// Frame sets of stored footage in the order of time.
pub(crate) struct FrameSets {
    reader: SetReader,
    recorded: Option<Recorded>,
}

/// Selection and decoding of a recording's frame sets.
struct Recorded {
    /// Numbers of the frame sets, counted from the first of the recording.
    range: Range<u64>,
    /// Decoders, one per slot.
    decoding: Vec<Decoding>,
    damaged: u64,
}

impl FrameSets {
    /// Reads the frame sets of a folder.
    pub fn folder(reader: SetReader) -> Self {
        Self { reader, recorded: None }
    }

    /// Reads the frame sets of a recording with numbers in `range`; `cameras` are in the order of the slots.
    pub fn recording(reader: SetReader, cameras: &[Camera], range: Range<u64>) -> Self {
        let decoding = cameras.iter().map(|camera| Decoding::new(Some(camera.size()))).collect();
        Self { reader, recorded: Some(Recorded { range, decoding, damaged: 0 }) }
    }

    /// Returns the next frame set; `None` at the end. Images that cannot be decoded are missing. Frames of a recording get the number of their
    /// frame set.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>> {
        let Some(Recorded { range, decoding, damaged }) = &mut self.recorded else {
            return Ok(self.reader.next_set()?);
        };
        while let Some(mut set) = self.reader.next_set()?.filter(|set| set.index < range.end) {
            if set.index < range.start {
                continue;
            }
            for (slot, decoding) in set.frames.iter_mut().zip(decoding) {
                // The reader has given its only reference away.
                let Some(frame) = slot.take().and_then(Arc::into_inner) else { continue };
                match decode_or_skip(decoding, Frame { sequence: set.index, ..frame })? {
                    Some(frame) => *slot = Some(Arc::new(frame)),
                    None => *damaged += 1,
                }
            }
            return Ok(Some(set));
        }
        Ok(None)
    }

    /// Returns the counts of complete and partial frame sets and of broken images.
    pub fn summary(&self) -> serde_json::Value {
        let counts = self.reader.counts();
        let damaged = self.reader.damaged() + self.recorded.as_ref().map_or(0, |recorded| recorded.damaged);
        serde_json::json!({ "complete": counts.complete, "partial": counts.partial, "broken_images": damaged })
    }
}

/// Decodes a frame; warns of a damaged one and returns `None`.
pub(crate) fn decode_or_skip(decoding: &mut Decoding, frame: Frame) -> Result<Option<Frame>, CaptureError> {
    let camera = frame.camera.clone();
    match decoding.process(frame).map_err(|error| error.of(&camera)) {
        Ok(frame) => Ok(Some(frame)),
        Err(error) if error.kind == CaptureErrorKind::Corrupt => {
            tracing::warn!("{error}; going on without it");
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
