//! Frame sets of recordings, read in step and without loss.

use std::{collections::VecDeque, time::Duration};

use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind};
use flyrig_sync::{SyncCounts, SyncSettings, Synchronizer};
use flyrig_types::{CameraId, Frame, FrameSet};

/// Reads recorded cameras frame by frame and forms sets; a damaged image is missing from its set.
pub struct SetReader {
    sources: Vec<Box<dyn CameraSource>>,
    sync: Synchronizer,
    ready: VecDeque<FrameSet>,
    done: bool,
    damaged: u64,
}

impl SetReader {
    /// Reads these sources, one slot each.
    #[must_use]
    pub fn new(sources: Vec<Box<dyn CameraSource>>, sync: &SyncSettings) -> Self {
        let ids: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
        Self { sync: Synchronizer::new(&ids, sync), sources, ready: VecDeque::new(), done: false, damaged: 0 }
    }

    /// Returns the next set; `None` at the end of all sources.
    ///
    /// # Errors
    /// The source's, but for damaged images, which are logged and counted.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>, CaptureError> {
        while self.ready.is_empty() && !self.done {
            let mut ended = 0;
            for source in &mut self.sources {
                match next_frame(source.as_mut()) {
                    Ok(Some(frame)) => self.ready.extend(self.sync.push(frame)),
                    Ok(None) => ended += 1,
                    Err(error) if error.kind == CaptureErrorKind::Corrupt => {
                        self.damaged += 1;
                        tracing::warn!("{error}; going on without it");
                    }
                    Err(error) => return Err(error),
                }
            }
            if ended == self.sources.len() {
                self.done = true;
                self.ready.extend(self.sync.flush());
            }
        }
        Ok(self.ready.pop_front())
    }

    /// Counts of the synchroniser.
    #[must_use]
    pub fn counts(&self) -> SyncCounts {
        self.sync.counts().clone()
    }

    /// Number of damaged images.
    #[must_use]
    pub fn damaged(&self) -> u64 {
        self.damaged
    }
}

/// Returns the next frame of a recording; `None` at its end.
///
/// # Errors
/// The source's.
pub fn next_frame(source: &mut dyn CameraSource) -> Result<Option<Frame>, CaptureError> {
    match source.next_frame(Duration::ZERO) {
        Ok(frame) => Ok(Some(frame)),
        Err(error) if error.kind == CaptureErrorKind::EndOfStream => Ok(None),
        Err(error) => Err(error),
    }
}
