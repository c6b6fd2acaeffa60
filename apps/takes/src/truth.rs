//! Ground truth: images of the held-out cameras.

use anyhow::Result;
use flyrig_capture::{CameraSource, CaptureErrorKind, Decoding, to_rgb8};
use flyrig_fusion::next_frame;
use flyrig_renderer::ColorMatcher;
use flyrig_types::{Camera, Frame, Image, PixelFormat};

use crate::frame_sets::{FrameSelection, decode_or_skip};

/// Reader of the held-out cameras; reads one frame beyond the time that is asked for at most.
pub struct TruthReader {
    sources: Vec<TrueImages>,
    window_nanos: u64,
}

/// Images of one held-out camera.
struct TrueImages {
    source: Box<dyn CameraSource>,
    /// Time offset that is subtracted from the timestamps, nanoseconds.
    lag_nanos: i64,
    matcher: Option<ColorMatcher>,
    /// Decoder for the frames of a recording.
    decoding: Option<Decoding>,
    /// Next frame, already read.
    ahead: Option<Frame>,
    /// Frame nearest to the last time, and whether its image is decoded and corrected.
    current: Option<(Frame, bool)>,
}

impl TrueImages {
    /// Advances to the frame nearest to a time, nanoseconds.
    fn seek(&mut self, nanos: i64) -> Result<()> {
        loop {
            if self.ahead.is_none() {
                match next_frame(self.source.as_mut()) {
                    Ok(Some(frame)) => {
                        let capture_nanos = frame.capture_nanos.saturating_sub(self.lag_nanos);
                        self.ahead = Some(Frame { capture_nanos, ..frame });
                    }
                    Ok(None) => return Ok(()),
                    Err(error) if error.kind == CaptureErrorKind::Corrupt => {
                        tracing::warn!("held-out {error}; that frame is not scored");
                        continue;
                    }
                    Err(error) => return Err(error.into()),
                }
            }
            let away = |frame: &Frame| frame.capture_nanos.abs_diff(nanos);
            let is_nearer = |ahead: &Frame| self.current.as_ref().is_none_or(|(now, _)| away(ahead) <= away(now));
            match self.ahead.take_if(|ahead| is_nearer(ahead)) {
                Some(frame) => self.current = Some((frame, false)),
                None => return Ok(()),
            }
        }
    }

    /// Decodes the frame and corrects its colours like those of an input camera.
    fn prepare(&mut self) -> Result<()> {
        let Some((mut frame, false)) = self.current.take_if(|(_, is_ready)| !*is_ready) else { return Ok(()) };
        if let Some(decoding) = &mut self.decoding {
            let Some(found) = decode_or_skip(decoding, frame)? else { return Ok(()) };
            frame = found;
        }
        if let Some(matcher) = &self.matcher {
            let (width, height) = (frame.image.width(), frame.image.height());
            let mut rgb = to_rgb8(&frame.image)?;
            matcher.correct(&mut rgb, 3, width as usize, |_| false);
            frame.image = Image::new(width, height, PixelFormat::Rgb8, rgb)?;
        }
        self.current = Some((frame, true));
        Ok(())
    }
}

impl TruthReader {
    /// Opens the held-out cameras, with masks if every one of them has some.
    pub(crate) fn open(selection: &FrameSelection, holdout: &[Camera]) -> Result<Self> {
        let masks = selection.footage.folder().map(|folder| folder.join("mask"));
        let with_masks =
            masks.is_some_and(|masks| holdout.iter().all(|camera| masks.join(camera.id.as_str()).is_dir()));
        let images = |(source, camera): (Box<dyn CameraSource>, &Camera)| TrueImages {
            source,
            lag_nanos: selection.lags_nanos.get(&camera.id).copied().unwrap_or_default(),
            matcher: ColorMatcher::new(camera),
            decoding: selection.is_encoded().then(|| Decoding::new(Some(camera.size()))),
            ahead: None,
            current: None,
        };
        let sources = selection.open(holdout, with_masks)?.sources.into_iter().zip(holdout).map(images).collect();
        Ok(Self { sources, window_nanos: selection.half_period_nanos() })
    }

    /// Returns the frame of each held-out camera nearest to a time (nanoseconds), within half a frame period. Times must not decrease from
    /// call to call.
    ///
    /// # Errors
    /// Names the image that cannot be read; a broken one is left out.
    pub fn at(&mut self, nanos: i64) -> Result<Vec<Option<&Frame>>> {
        let window = self.window_nanos;
        let is_near = |frame: &Frame| frame.capture_nanos.abs_diff(nanos) <= window;
        for images in &mut self.sources {
            images.seek(nanos)?;
            if images.current.as_ref().is_some_and(|(frame, _)| is_near(frame)) {
                images.prepare()?;
            }
        }
        let sources = self.sources.iter().map(|images| images.current.as_ref());
        Ok(sources.map(|current| current.map(|(frame, _)| frame).filter(|frame| is_near(frame))).collect())
    }
}
