//! Replay of video files, decoded by FFmpeg.
//!
//! Frames are those that the decoder returns and their times those that it states, whatever the header promises.

use std::{
    fmt,
    fs::File,
    io::Seek as _,
    ops::Range,
    path::{Path, PathBuf},
    sync::{Arc, Once},
    time::Duration,
};

use ac_ffmpeg::{
    codec::{
        Decoder as _, VideoCodecParameters,
        video::{PixelFormat as FramePixels, VideoDecoder, VideoFrame, VideoFrameScaler},
    },
    format::{
        demuxer::{Demuxer, DemuxerWithStreamInfo},
        io::IO,
        stream::Stream,
    },
};
use flyrig_types::{CameraId, Frame, Image, MAX_IMAGE_SIDE, PixelFormat};
use image::{DynamicImage, RgbImage, metadata::Orientation};

use crate::container::missing_bytes;
use crate::error::{CaptureError, CaptureErrorKind};
use crate::image_file::is_quarter_turn;
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

/// Frame source of a video file in any format that FFmpeg decodes: its first video stream. Its frames are `Bgr8`, turned
/// upright where the file says how, and their sequence number is their position in the file. The first frame has the
/// time 0, the others the file's presentation times after it; where the file has none, or one that does not grow, the
/// frame follows after the duration of the one before.
pub struct VideoReplay {
    camera: CameraId,
    path: PathBuf,
    demuxer: DemuxerWithStreamInfo<File>,
    stream: usize,
    decoder: VideoDecoder,
    converter: Option<Converter>,
    orientation: Orientation,
    /// Width and height in the header, upright.
    header_size: Option<(u32, u32)>,
    options: VideoOptions,
    times: FrameTimes,
    next: u64,
    size: Option<(u32, u32)>,
    /// Bytes that the file lacks by its own account.
    missing: Option<u64>,
    progress: Progress,
    pool: Arc<BufferPool>,
}

/// Part of the file that a replay has reached.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Progress {
    Reading,
    /// All packets are read; the decoder returns what it holds. The text is the reader's error, if one ended it.
    Draining(Option<String>),
    Ended,
}

impl fmt::Debug for VideoReplay {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("VideoReplay")
            .field("path", &self.path)
            .field("next", &self.next)
            .field("progress", &self.progress)
            .finish_non_exhaustive()
    }
}

impl VideoReplay {
    /// Opens a video file.
    ///
    /// # Errors
    /// `NotFound` for a missing file, `Corrupt` when it cannot be opened as a video.
    pub fn open(camera: &CameraId, path: &Path, options: &VideoOptions) -> Result<Self, CaptureError> {
        // FFmpeg prints what it also returns.
        static SILENCE: Once = Once::new();
        SILENCE.call_once(|| ac_ffmpeg::set_log_callback(|_, _| {}));
        let error = |kind, text: String| CaptureError::new(camera, kind, format!("{}: {text}", path.display()));
        if !path.is_file() {
            return Err(error(CaptureErrorKind::NotFound, "there is no such video file".to_owned()));
        }
        let unreadable = |cause: &dyn fmt::Display| {
            let text = "cannot be opened as a video; it may be cut off, or of a format that FFmpeg does not decode";
            error(CaptureErrorKind::Corrupt, format!("{text} ({cause})"))
        };
        let mut file = File::open(path).map_err(|cause| unreadable(&cause))?;
        let missing = missing_bytes(&mut file);
        file.rewind().map_err(|cause| unreadable(&cause))?;
        // The last packet of a cut file is half a picture. Elsewhere the reader's doubts are too many: joined files.
        let mut builder = Demuxer::builder();
        if missing.is_some() {
            builder = builder.set_option("fflags", "discardcorrupt");
        }
        let demuxer = builder.build(IO::from_seekable_read_stream(file)).map_err(|cause| unreadable(&cause))?;
        let demuxer = demuxer.find_stream_info(None).map_err(|(_, cause)| unreadable(&cause))?;
        let videos = demuxer.streams().iter().map(Stream::codec_parameters).enumerate();
        let Some((stream, parameters)) =
            videos.filter_map(|(i, parameters)| Some((i, parameters.into_video_codec_parameters()?))).next()
        else {
            return Err(unreadable(&"it has no pictures"));
        };
        let found = &demuxer.streams()[stream];
        let decoder = VideoDecoder::from_codec_parameters(&parameters)
            .and_then(|builder| builder.time_base(found.time_base()).set_option("threads", "auto").build())
            .map_err(|cause| unreadable(&cause))?;
        let orientation = orientation(found, &parameters);
        let side = |pixels: usize| u32::try_from(pixels).ok().filter(|pixels| (1..=MAX_IMAGE_SIDE).contains(pixels));
        let header_size = side(parameters.width()).zip(side(parameters.height()));
        Ok(Self {
            camera: camera.clone(),
            path: path.to_owned(),
            stream,
            decoder,
            converter: None,
            orientation,
            header_size: header_size.map(|(w, h)| if is_quarter_turn(orientation) { (h, w) } else { (w, h) }),
            options: options.clone(),
            times: FrameTimes::default(),
            next: 0,
            size: None,
            missing,
            progress: Progress::Reading,
            pool: BufferPool::new(8),
            demuxer,
        })
    }

    /// Returns width and height in pixels from the file's header.
    #[must_use]
    pub fn image_size(&self) -> Option<(u32, u32)> {
        self.header_size
    }

    /// Returns the duration by the file's header, seconds, where it states one.
    #[must_use]
    pub fn header_secs(&self) -> Option<f64> {
        let nanos = self.demuxer.streams().get(self.stream)?.duration().as_nanos()?;
        Some(nanos as f64 * 1e-9).filter(|secs| *secs > 0.0)
    }

    /// Returns frames per second and the number of frames by the file's header, where it states both. Decoding may find others.
    #[must_use]
    pub fn header_rate(&self) -> Option<(f64, u64)> {
        let frames = self.demuxer.streams().get(self.stream)?.frames().filter(|frames| *frames > 0)?;
        Some((frames as f64 / self.header_secs()?, frames)).filter(|(fps, _)| (0.1..=10_000.0).contains(fps))
    }

    fn error(&self, kind: CaptureErrorKind, text: impl fmt::Display) -> CaptureError {
        CaptureError::new(&self.camera, kind, format!("{}: {text}", self.path.display()))
    }

    fn end(&self) -> CaptureError {
        self.error(CaptureErrorKind::EndOfStream, "all frames were replayed")
    }

    /// Decodes the next frame.
    fn grab(&mut self) -> Result<VideoFrame, CaptureError> {
        loop {
            match self.decoder.take() {
                Ok(Some(frame)) => return Ok(frame),
                Ok(None) => {}
                Err(cause) => self.undecodable(&cause)?,
            }
            if let Progress::Draining(trouble) = &self.progress {
                let error = self.last_word(trouble.as_deref());
                self.progress = Progress::Ended;
                return Err(error);
            }
            let trouble = match self.demuxer.take() {
                Ok(Some(packet)) if packet.stream_index() == self.stream => {
                    let duration = packet.duration().and_then(|duration| i64::try_from(duration.as_nanos()).ok());
                    self.times.step = duration.filter(|nanos| *nanos > 0).or(self.times.step);
                    if let Err(error) = self.decoder.try_push(packet)
                        && let Some(cause) = error.into_inner()
                    {
                        self.undecodable(&cause)?;
                    }
                    continue;
                }
                Ok(Some(_)) => continue,
                Ok(None) => None,
                Err(cause) => Some(cause.to_string()),
            };
            self.progress = Progress::Draining(trouble);
            // The decoder has nothing to return if this fails.
            let _ = self.decoder.try_flush();
        }
    }

    /// Returns an error for a picture that cannot be decoded. A clip may begin with some that refer to pictures before
    /// it.
    fn undecodable(&self, cause: &ac_ffmpeg::Error) -> Result<(), CaptureError> {
        if self.next == 0 {
            return Ok(());
        }
        Err(self
            .error(CaptureErrorKind::Corrupt, format!("a frame after {} cannot be decoded ({cause})", self.next - 1)))
    }

    /// Returns the error at the end of the file.
    fn last_word(&self, trouble: Option<&str>) -> CaptureError {
        let cause = match (self.missing, trouble) {
            (Some(bytes), _) => format!("{bytes} bytes are missing"),
            (None, Some(trouble)) => trouble.to_owned(),
            (None, None) if self.next == 0 => {
                return self.error(CaptureErrorKind::Corrupt, "has no frame that can be decoded");
            }
            (None, None) => return self.end(),
        };
        let text = format!("ends after {} frames ({cause}); the file is cut off or damaged", self.next);
        self.error(CaptureErrorKind::Corrupt, text)
    }

    /// Returns the time of a frame, nanoseconds.
    fn capture_nanos(&mut self, number: u64, frame: &VideoFrame) -> Result<i64, CaptureError> {
        let nanos = match self.options.fps {
            Some(fps) => Some((number as f64 / fps * 1e9).round() as i64),
            None => self.times.next(frame.best_effort_timestamp().as_nanos()),
        };
        let Some(nanos) = nanos else {
            return Err(self.error(CaptureErrorKind::Unsupported, "has no times and no frame rate; give one"));
        };
        Ok(nanos.saturating_add(self.options.offset_nanos))
    }

    fn image(&mut self, number: u64, frame: &VideoFrame) -> Result<Image, CaptureError> {
        let corrupt = |video: &Self, cause: &dyn fmt::Display| {
            video.error(CaptureErrorKind::Corrupt, format!("frame {number} cannot be decoded ({cause})"))
        };
        let mut converter = match self.converter.take().filter(|converter| converter.fits(frame)) {
            Some(converter) => converter,
            None => Converter::new(frame).map_err(|cause| corrupt(self, &cause))?,
        };
        let mut bytes = self.pool.take();
        converter.convert(frame, &mut bytes).map_err(|cause| corrupt(self, &cause))?;
        self.converter = Some(converter);
        let (mut width, mut height) = (frame.width() as u32, frame.height() as u32);
        if self.orientation != Orientation::NoTransforms {
            let Some(picture) = RgbImage::from_raw(width, height, bytes) else {
                return Err(corrupt(self, &"it is too small"));
            };
            let mut picture = DynamicImage::ImageRgb8(picture);
            picture.apply_orientation(self.orientation);
            (width, height) = (picture.width(), picture.height());
            bytes = picture.into_bytes();
        }
        let first = *self.size.get_or_insert((width, height));
        if (width, height) != first {
            let text = format!("frame {number} is {width}x{height}, the frames before it {}x{}", first.0, first.1);
            return Err(self.error(CaptureErrorKind::Corrupt, text));
        }
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
            if self.progress == Progress::Ended || self.next >= range.end {
                return Err(self.end());
            }
            let picture = self.grab()?;
            let number = self.next;
            self.next += 1;
            let capture_nanos = self.capture_nanos(number, &picture)?;
            if range.contains(&number) {
                let image = self.image(number, &picture)?;
                let camera = self.camera.clone();
                return Ok(Frame { camera, sequence: number, capture_nanos, exposure_nanos: None, image, mask: None });
            }
        }
    }
}

/// Times of frames in the order in which they are shown.
#[derive(Debug, Default)]
struct FrameTimes {
    /// Duration of a frame, nanoseconds: that of the newest packet, or the last difference between two frames.
    step: Option<i64>,
    /// Own time of the file that is 0 here, nanoseconds.
    origin: Option<i64>,
    last: Option<i64>,
}

impl FrameTimes {
    /// Returns the time of the next frame, which has this time in the file, nanoseconds. `None` where nothing says
    /// when it follows.
    fn next(&mut self, own: Option<i64>) -> Option<i64> {
        let place = own.zip(self.origin).map(|(own, origin)| own.saturating_sub(origin));
        let time = match (place, self.last) {
            (Some(time), Some(last)) if time > last => {
                if self.step.is_none() {
                    self.step = Some(time.saturating_sub(last));
                }
                time
            }
            (_, None) => 0,
            (_, Some(last)) => last.saturating_add(self.step?),
        };
        // The first time that the file states, or the first after its clock was set back.
        if place.is_none_or(|place| place != time) {
            self.origin = own.map(|own| own.saturating_sub(time)).or(self.origin);
        }
        self.last = Some(time);
        Some(time)
    }
}

/// Conversion of decoded pictures of one size and pixel format to BGR.
struct Converter {
    scaler: VideoFrameScaler,
    from: (FramePixels, usize, usize),
}

impl Converter {
    fn new(frame: &VideoFrame) -> Result<Self, ac_ffmpeg::Error> {
        let (format, width, height) = (frame.pixel_format(), frame.width(), frame.height());
        if width.max(height) > MAX_IMAGE_SIDE as usize {
            return Err(ac_ffmpeg::Error::new(format!("{width}x{height} pixels are too many")));
        }
        let bgr = "bgr24".parse::<FramePixels>().map_err(|_| ac_ffmpeg::Error::new("FFmpeg knows no BGR"))?;
        let scaler = VideoFrameScaler::builder()
            .source_pixel_format(format)
            .source_width(width)
            .source_height(height)
            .target_pixel_format(bgr)
            .target_width(width)
            .target_height(height)
            .build()?;
        Ok(Self { scaler, from: (format, width, height) })
    }

    fn fits(&self, frame: &VideoFrame) -> bool {
        self.from == (frame.pixel_format(), frame.width(), frame.height())
    }

    /// Appends the rows to `bytes`, 3 bytes per pixel.
    fn convert(&mut self, frame: &VideoFrame, bytes: &mut Vec<u8>) -> Result<(), ac_ffmpeg::Error> {
        let converted = self.scaler.scale(frame)?;
        let (_, width, height) = self.from;
        for row in converted.planes()[0].lines().take(height) {
            bytes.extend_from_slice(row.get(..3 * width).unwrap_or_default());
        }
        Ok(())
    }
}

/// Returns how a stream's pictures are turned upright, by its display matrix: nine numbers in 16.16 fixed point (2.30 in
/// the last column), `x' = a x + c y`, `y' = b x + d y`.
fn orientation(stream: &Stream, parameters: &VideoCodecParameters) -> Orientation {
    #[cfg(stream_side_data)]
    let (_, blocks) = (parameters, stream.side_data());
    #[cfg(not(stream_side_data))]
    let (_, blocks) = (stream, parameters.coded_side_data());
    // Names of kinds are no public constants, but no other block of this size ends its rows like this.
    let matrices = blocks.filter_map(|block| {
        let (rows, []) = block.data().as_chunks::<4>() else { return None };
        let numbers: [i32; 9] = rows.iter().map(|n| i32::from_ne_bytes(*n)).collect::<Vec<_>>().try_into().ok()?;
        let [a, b, 0, c, d, 0, _, _, 0x4000_0000] = numbers else { return None };
        Some([a, b, c, d].map(i32::signum))
    });
    match matrices.last() {
        Some([-1, 0, 0, 1]) => Orientation::FlipHorizontal,
        Some([-1, 0, 0, -1]) => Orientation::Rotate180,
        Some([1, 0, 0, -1]) => Orientation::FlipVertical,
        Some([0, 1, 1, 0]) => Orientation::Rotate90FlipH,
        Some([0, 1, -1, 0]) => Orientation::Rotate90,
        Some([0, -1, -1, 0]) => Orientation::Rotate270FlipH,
        Some([0, -1, 1, 0]) => Orientation::Rotate270,
        _ => Orientation::NoTransforms,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn times(step: Option<i64>, own: &[Option<i64>]) -> Vec<Option<i64>> {
        let mut times = FrameTimes { step, ..FrameTimes::default() };
        own.iter().map(|own| times.next(own.map(|ms| ms * MS)).map(|nanos| nanos / MS)).collect()
    }

    #[test]
    fn times_are_the_files_own_from_the_first_frame_on() {
        assert_eq!(times(None, &[Some(-200), Some(-100), Some(700)]), [Some(0), Some(100), Some(900)]);
        assert_eq!(times(Some(40 * MS), &[Some(23), Some(24), Some(500)]), [Some(0), Some(1), Some(477)]);
    }

    #[test]
    fn a_frame_without_a_time_follows_the_one_before() {
        let step = Some(40 * MS);
        assert_eq!(times(step, &[None, None, Some(0), Some(50)]), [Some(0), Some(40), Some(80), Some(130)]);
        assert_eq!(times(step, &[Some(100), None, Some(190)]), [Some(0), Some(40), Some(90)]);
        assert_eq!(times(None, &[Some(100), Some(120), None]), [Some(0), Some(20), Some(40)]);
        assert_eq!(times(None, &[None, None]), [Some(0), None]);
    }

    #[test]
    fn times_grow_whatever_the_file_says() {
        assert_eq!(times(Some(MS), &[Some(5), Some(5), Some(6), Some(0)]), [Some(0), Some(1), Some(2), Some(3)]);
        assert_eq!(times(Some(MS), &[Some(900), Some(0), Some(10)]), [Some(0), Some(1), Some(11)]);
        let mut wild = FrameTimes { step: Some(i64::MAX), ..FrameTimes::default() };
        for own in [i64::MIN, i64::MAX, 0, i64::MIN] {
            assert!(wild.next(Some(own)).is_some());
        }
    }
}
