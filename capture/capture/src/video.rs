//! Replay of video files, decoded by OpenCV.

use std::{
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use flyrig_types::{CameraId, Frame, Image, PixelFormat};
use opencv::{
    core::{CV_8UC3, LogLevel, Mat, MatTraitConst, set_log_level},
    prelude::MatTraitConstManual,
    videoio::{
        CAP_ANY, CAP_PROP_FPS, CAP_PROP_FRAME_COUNT, CAP_PROP_FRAME_HEIGHT, CAP_PROP_FRAME_WIDTH, CAP_PROP_POS_MSEC,
        VideoCapture, VideoCaptureTrait, VideoCaptureTraitConst,
    },
};

use crate::error::{CaptureError, CaptureErrorKind};
use crate::pool::BufferPool;
use crate::source::CameraSource;

/// Options of a video's replay.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VideoOptions {
    /// Frames per second; the file's own times when `None`.
    pub fps: Option<f64>,
    /// Range of frames to replay, counted from 0; all when `None`.
    pub frames: Option<Range<u64>>,
    /// Delay of this camera's start against the rig's clock, nanoseconds; added to every frame's time.
    pub offset_nanos: i64,
}

/// Frame source of a video file in any format that OpenCV's videoio decodes. Its frames are `Bgr8`, rotated upright
/// where the file says how, and their sequence number is their position in the file.
#[derive(Debug)]
pub struct VideoReplay {
    camera: CameraId,
    path: PathBuf,
    video: VideoCapture,
    options: VideoOptions,
    /// Frames per second from the options or the file.
    fps: f64,
    /// Number of frames in the file's header.
    promised: Option<u64>,
    next: u64,
    /// Time of the last frame in the file, milliseconds.
    last_msec: Option<f64>,
    size: Option<(i32, i32)>,
    ended: bool,
    mat: Mat,
    pool: Arc<BufferPool>,
}

impl VideoReplay {
    /// Opens a video file.
    ///
    /// # Errors
    /// `NotFound` for a missing file, `Corrupt` when it cannot be opened as a video, `Unsupported` when no rate is
    /// known.
    pub fn open(camera: &CameraId, path: &Path, options: &VideoOptions) -> Result<Self, CaptureError> {
        // OpenCV prints what it also returns. Fails only without a logger.
        let _ = set_log_level(LogLevel::LOG_LEVEL_SILENT);
        let error = |kind, text: String| CaptureError::new(camera, kind, format!("{}: {text}", path.display()));
        if !path.is_file() {
            return Err(error(CaptureErrorKind::NotFound, "there is no such video file".to_owned()));
        }
        let unreadable = || {
            let text = "cannot be opened as a video; it may be cut off, or of a format that OpenCV does not decode";
            error(CaptureErrorKind::Corrupt, text.to_owned())
        };
        let video = VideoCapture::from_file(path, CAP_ANY).map_err(|_| unreadable())?;
        if !video.is_opened().unwrap_or(false) {
            return Err(unreadable());
        }
        let property = |id| video.get(id).ok().filter(|value| value.is_finite() && *value > 0.0);
        let fps = options.fps.or_else(|| property(CAP_PROP_FPS)).filter(|fps| fps.is_finite() && *fps > 0.0);
        let Some(fps) = fps else {
            return Err(error(CaptureErrorKind::Unsupported, "has no frame rate; give one".to_owned()));
        };
        let promised = property(CAP_PROP_FRAME_COUNT).map(|count| count.round() as u64);
        Ok(Self {
            camera: camera.clone(),
            path: path.to_owned(),
            video,
            options: options.clone(),
            fps,
            promised,
            next: 0,
            last_msec: None,
            size: None,
            ended: false,
            mat: Mat::default(),
            pool: BufferPool::new(8),
        })
    }

    /// Returns width and height in pixels from the file's header.
    #[must_use]
    pub fn image_size(&self) -> Option<(u32, u32)> {
        let side = |id| self.video.get(id).ok().filter(|pixels| *pixels >= 1.0).map(|pixels| pixels as u32);
        side(CAP_PROP_FRAME_WIDTH).zip(side(CAP_PROP_FRAME_HEIGHT))
    }

    fn error(&self, kind: CaptureErrorKind, text: impl std::fmt::Display) -> CaptureError {
        CaptureError::new(&self.camera, kind, format!("{}: {text}", self.path.display()))
    }

    fn end(&self) -> CaptureError {
        self.error(CaptureErrorKind::EndOfStream, "all frames were replayed")
    }

    /// Skips a frame without decoding its pixels.
    fn grab(&mut self) -> Result<(), CaptureError> {
        if self.video.grab().unwrap_or(false) {
            return Ok(());
        }
        self.ended = true;
        match self.promised {
            _ if self.next == 0 => Err(self.error(CaptureErrorKind::Corrupt, "has no frame that can be decoded")),
            Some(promised) if self.next < promised => Err(self.error(
                CaptureErrorKind::Corrupt,
                format!("ends after {} of {promised} frames; the file is cut off or damaged", self.next),
            )),
            _ => Err(self.end()),
        }
    }

    /// Returns the time of the frame grabbed last, nanoseconds.
    fn capture_nanos(&mut self, number: u64) -> i64 {
        let own = self.video.get(CAP_PROP_POS_MSEC).ok().filter(|msec| msec.is_finite());
        // Some containers carry no times: OpenCV says 0 then.
        let grows = own.filter(|msec| *msec >= 0.0 && self.last_msec.is_none_or(|last| *msec > last));
        self.last_msec = grows.or(self.last_msec);
        let nanos = match grows {
            Some(msec) if self.options.fps.is_none() => msec * 1e6,
            _ => number as f64 / self.fps * 1e9,
        };
        (nanos.round() as i64).saturating_add(self.options.offset_nanos)
    }

    fn image(&mut self, number: u64) -> Result<Image, CaptureError> {
        let decoded = self.video.retrieve_def(&mut self.mat).unwrap_or(false);
        if !decoded || self.mat.typ() != CV_8UC3 {
            return Err(self.error(CaptureErrorKind::Corrupt, format!("frame {number} cannot be decoded")));
        }
        let size = (self.mat.cols(), self.mat.rows());
        let first = *self.size.get_or_insert(size);
        if size != first {
            let text = format!("frame {number} is {}x{}, the frames before it {}x{}", size.0, size.1, first.0, first.1);
            return Err(self.error(CaptureErrorKind::Corrupt, text));
        }
        let mut bytes = self.pool.take();
        match self.mat.data_bytes() {
            Ok(data) => bytes.extend_from_slice(data),
            Err(cause) => return Err(self.error(CaptureErrorKind::Corrupt, cause)),
        }
        let (width, height) = (size.0.max(0) as u32, size.1.max(0) as u32);
        Image::new(width, height, PixelFormat::Bgr8, self.pool.lease(bytes))
            .map_err(|cause| self.error(CaptureErrorKind::Unsupported, cause))
    }
}

impl CameraSource for VideoReplay {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        let range = self.options.frames.clone().unwrap_or(0..u64::MAX);
        loop {
            if self.ended || self.next >= range.end {
                return Err(self.end());
            }
            self.grab()?;
            let number = self.next;
            self.next += 1;
            let capture_nanos = self.capture_nanos(number);
            if range.contains(&number) {
                let image = self.image(number)?;
                let camera = self.camera.clone();
                return Ok(Frame { camera, sequence: number, capture_nanos, exposure_nanos: None, image, mask: None });
            }
        }
    }
}
