//! Frame sets of recordings, read in step and without loss. `flyrig eval` uses them.

use std::{collections::VecDeque, time::Duration};

use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind};
use flyrig_sync::{SyncCounts, SyncSettings, Synchronizer};
use flyrig_types::{CameraId, Frame, FrameSet};

/// Reader of recorded cameras, which forms frame sets.
///
/// Frames are read in the order of time, so that a camera that began late or lost frames keeps in step. A damaged image is missing from its
/// frame set.
///
/// # Example
/// ```no_run
/// use flyrig_fusion::{
///     SetReader,
///     capture::{CameraSource, FolderOptions, FolderReplay},
///     sync::SyncSettings,
/// };
///
/// let replay = FolderReplay::open("take".as_ref(), None, &FolderOptions::default())?;
/// let sources = replay.into_iter().map(|source| Box::new(source) as Box<dyn CameraSource>).collect();
/// let mut sets = SetReader::new(sources, &SyncSettings::default());
/// while let Some(set) = sets.next_set()? {
///     println!("frame set {}: {} images", set.index, set.present().count());
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct SetReader {
    sources: Vec<Box<dyn CameraSource>>,
    /// Next frame of each source with its position in the order of time, nanoseconds.
    ahead: Vec<Option<(i64, Frame)>>,
    /// Whether each source has ended.
    ended: Vec<bool>,
    sync: Synchronizer,
    ready: VecDeque<FrameSet>,
    done: bool,
    damaged: u64,
}

impl SetReader {
    /// Reads these sources, one per slot.
    #[must_use]
    pub fn new(sources: Vec<Box<dyn CameraSource>>, sync: &SyncSettings) -> Self {
        let ids: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
        Self {
            sync: Synchronizer::new(&ids, sync),
            ahead: sources.iter().map(|_| None).collect(),
            ended: vec![false; sources.len()],
            sources,
            ready: VecDeque::new(),
            done: false,
            damaged: 0,
        }
    }

    /// Returns the next frame set; `None` at the end of all sources.
    ///
    /// # Errors
    /// As the sources, except for damaged images, which are logged and counted.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>, CaptureError> {
        while self.ready.is_empty() && !self.done {
            for slot in 0..self.sources.len() {
                self.look_ahead(slot)?;
            }
            let times = self.ahead.iter().enumerate().filter_map(|(slot, ahead)| Some((ahead.as_ref()?.0, slot)));
            match times.min().and_then(|(_, slot)| self.ahead[slot].take()) {
                Some((_, frame)) => self.ready.extend(self.sync.push(frame)),
                None => {
                    self.done = true;
                    self.ready.extend(self.sync.flush());
                }
            }
        }
        Ok(self.ready.pop_front())
    }

    /// Reads a source's next frame, unless it was read already.
    fn look_ahead(&mut self, slot: usize) -> Result<(), CaptureError> {
        let source = self.sources[slot].as_mut();
        while self.ahead[slot].is_none() && !self.ended[slot] {
            match next_frame(source) {
                Ok(Some(frame)) => self.ahead[slot] = Some((source.order_nanos(&frame), frame)),
                Ok(None) => self.ended[slot] = true,
                Err(error) if error.kind == CaptureErrorKind::Corrupt => {
                    self.damaged += 1;
                    tracing::warn!("{error}; going on without it");
                }
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Returns the counts of the synchroniser.
    #[must_use]
    pub fn counts(&self) -> SyncCounts {
        self.sync.counts().clone()
    }

    /// Returns the number of damaged images.
    #[must_use]
    pub fn damaged(&self) -> u64 {
        self.damaged
    }
}

/// Returns the next frame of a recording; `None` at its end.
///
/// # Errors
/// As [`CameraSource::next_frame`].
pub fn next_frame(source: &mut dyn CameraSource) -> Result<Option<Frame>, CaptureError> {
    match source.next_frame(Duration::ZERO) {
        Ok(frame) => Ok(Some(frame)),
        Err(error) if error.kind == CaptureErrorKind::EndOfStream => Ok(None),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Image, PixelFormat, SetKind};

    use super::*;

    type Scripts = Vec<Vec<Result<i64, CaptureErrorKind>>>;

    struct Scripted(CameraId, VecDeque<Result<i64, CaptureErrorKind>>);

    impl CameraSource for Scripted {
        fn camera(&self) -> &CameraId {
            &self.0
        }

        fn next_frame(&mut self, _: Duration) -> Result<Frame, CaptureError> {
            let next = self.1.pop_front().unwrap_or(Err(CaptureErrorKind::EndOfStream));
            let capture_nanos = next.map_err(|kind| CaptureError::new(&self.0, kind, "scripted"))?;
            let image = Image::new(1, 1, PixelFormat::Rgb8, vec![0; 3]).unwrap();
            Ok(Frame { camera: self.0.clone(), sequence: 0, capture_nanos, exposure_nanos: None, image, mask: None })
        }
    }

    fn read(cameras: Scripts) -> (Vec<FrameSet>, u64, Option<CaptureError>) {
        let source = |(i, frames): (usize, Vec<_>)| {
            Box::new(Scripted(format!("{i}").as_str().into(), frames.into())) as Box<dyn CameraSource>
        };
        let mut reader =
            SetReader::new(cameras.into_iter().enumerate().map(source).collect(), &SyncSettings::default());
        let mut sets = Vec::new();
        loop {
            match reader.next_set() {
                Ok(Some(set)) => sets.push(set),
                Ok(None) => return (sets, reader.damaged(), None),
                Err(error) => return (sets, reader.damaged(), Some(error)),
            }
        }
    }

    /// Returns capture times at 30 per second, `off` milliseconds late.
    fn frames(range: std::ops::Range<i64>, off: i64) -> Vec<Result<i64, CaptureErrorKind>> {
        range.map(|i| Ok(i * 33_333_333 + off * 1_000_000)).collect()
    }

    #[test]
    fn cameras_that_begin_late_or_lose_frames_keep_in_step() {
        let mut lossy = frames(0..300, 1);
        // Half a second is lost, and one image is damaged.
        lossy.drain(40..55);
        lossy[20] = Err(CaptureErrorKind::Corrupt);
        let (sets, damaged, error) = read(vec![lossy, frames(0..300, 0), frames(110..300, -2)]);
        assert!(error.is_none() && damaged == 1 && (299..=301).contains(&sets.len()), "{} {damaged}", sets.len());
        for set in &sets {
            let times: Vec<i64> = set.present().map(|(_, frame)| frame.capture_nanos).collect();
            let spread = times.iter().max().unwrap() - times.iter().min().unwrap();
            assert!(spread < 5_000_000, "{times:?}");
        }
        let all: Vec<&FrameSet> = sets.iter().filter(|set| set.master_nanos > 120 * 33_333_333).collect();
        assert!(all.len() > 170 && all.iter().all(|set| set.kind() == SetKind::Complete));
        let missing = |slot: usize| sets.iter().filter(|set| set.frames[slot].is_none()).count();
        assert!((16..=18).contains(&missing(0)) && missing(1) <= 1, "{} {}", missing(0), missing(1));
    }

    #[test]
    fn other_errors_end_it_and_nothing_gives_nothing() {
        let (sets, _, error) = read(vec![vec![Ok(0), Err(CaptureErrorKind::NotFound)], frames(0..3, 0)]);
        assert!(sets.is_empty() && error.unwrap().kind == CaptureErrorKind::NotFound);
        assert!(read(vec![]).0.is_empty() && read(vec![vec![], vec![]]).0.is_empty());
        assert!(read(vec![vec![], frames(0..90, 0)]).0.len() > 80, "one camera never came");
    }
}
