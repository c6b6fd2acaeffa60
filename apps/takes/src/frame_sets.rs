//! Sets of images of a take: a folder's, or those of a recording, which are decoded here.

use std::{ops::Range, sync::Arc};

use anyhow::Result;
use flyrig_capture::{CaptureError, CaptureErrorKind, Decoding, FrameStage as _};
use flyrig_fusion::SetReader;
use flyrig_types::{Camera, Frame, FrameSet};

/// Sets of a take in their order.
pub(crate) struct TakeSets {
    reader: SetReader,
    recorded: Option<Recorded>,
}

/// How the sets of a recording are taken.
struct Recorded {
    /// Numbers of the sets, counted from the first of the recording.
    range: Range<u64>,
    /// One for each slot.
    decoding: Vec<Decoding>,
    damaged: u64,
}

impl TakeSets {
    /// Of a folder.
    pub fn folder(reader: SetReader) -> Self {
        Self { reader, recorded: None }
    }

    /// Of a recording: sets of these numbers, of the calibrated cameras in the order of the slots.
    pub fn recording(reader: SetReader, cameras: &[Camera], range: Range<u64>) -> Self {
        let decoding = cameras.iter().map(|camera| Decoding::new(Some(camera.size()))).collect();
        Self { reader, recorded: Some(Recorded { range, decoding, damaged: 0 }) }
    }

    /// Returns the next set; `None` at the end. Images that cannot be decoded are missing. Frames of a recording get the number of their set.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>> {
        let Some(Recorded { range, decoding, damaged }) = &mut self.recorded else {
            return Ok(self.reader.next_set()?);
        };
        while let Some(mut set) = self.reader.next_set()?.filter(|set| set.index < range.end) {
            if set.index < range.start {
                continue;
            }
            for (slot, decoding) in set.frames.iter_mut().zip(decoding) {
                // Nobody else holds it yet.
                let Some(frame) = slot.take().and_then(Arc::into_inner) else { continue };
                match decoded(decoding, Frame { sequence: set.index, ..frame })? {
                    Some(frame) => *slot = Some(Arc::new(frame)),
                    None => *damaged += 1,
                }
            }
            return Ok(Some(set));
        }
        Ok(None)
    }

    /// Counts of complete and partial sets and of broken images.
    pub fn summary(&self) -> serde_json::Value {
        let counts = self.reader.counts();
        let damaged = self.reader.damaged() + self.recorded.as_ref().map_or(0, |recorded| recorded.damaged);
        serde_json::json!({ "complete": counts.complete, "partial": counts.partial, "broken_images": damaged })
    }
}

/// Decodes a frame; None, with a warning, for one that is damaged.
pub(crate) fn decoded(decoding: &mut Decoding, frame: Frame) -> Result<Option<Frame>, CaptureError> {
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
