//! Video files whose images keep their own times.

use std::{fs::File, path::Path, time::Duration};

use ac_ffmpeg::{
    Error,
    codec::{
        CodecParameters, Encoder as _,
        video::{PixelFormat, VideoEncoder, VideoFrameMut, VideoFrameScaler},
    },
    format::{
        io::IO,
        muxer::{Muxer, OutputFormat},
    },
    time::{TimeBase, Timestamp},
};
use anyhow::{Context, Result};
use image::RgbImage;

/// Interval after which an image follows whose time does not, nanoseconds.
const NOMINAL_NANOS: i64 = 40_000_000;

/// Codec of a file, with its pixel format and the options that set its quality.
type Codec = (&'static str, &'static str, &'static [(&'static str, &'static str)]);

/// H.264, which every browser plays. Images refer to earlier ones only, so that they are stored in the order of their times. The colours are
/// described, because players guess the matrix by the size otherwise.
const H264: Codec = (
    "libx264",
    "yuv420p",
    &[
        ("preset", "veryfast"),
        ("crf", "18"),
        ("bf", "0"),
        ("flags", "+global_header"),
        ("color_range", "tv"),
        ("colorspace", "smpte170m"),
        ("color_primaries", "bt709"),
        ("color_trc", "iec61966-2-1"),
    ],
);
/// MPEG-4 Part 2, where FFmpeg was built without H.264. Quality 3 of 1 (best) to 31, in units of 1/118.
const MPEG4: Codec = ("mpeg4", "yuv420p", &[("flags", "+qscale+global_header"), ("global_quality", "354")]);
const MOTION_JPEG: Codec = ("mjpeg", "yuvj420p", &[("flags", "+qscale+global_header"), ("global_quality", "354")]);

/// Video file of images of one size.
pub struct VideoFile {
    encoder: VideoEncoder,
    muxer: Muxer<File>,
    scaler: VideoFrameScaler,
    size: (u32, u32),
    ticks: Ticks,
}

/// Place of the images in a file, ticks.
#[derive(Debug)]
struct Ticks {
    per_second: i32,
    /// Source, its time that is 0 in the file, and the tick of its last image.
    last: Option<(u64, i64, i64)>,
}

impl Ticks {
    /// Returns the place of an image that a source took at a time, nanoseconds. Times of different sources have nothing
    /// in common.
    fn next(&mut self, source: u64, nanos: i64) -> i64 {
        let ticks =
            |nanos: i64| (i128::from(nanos) * i128::from(self.per_second) + 500_000_000).div_euclid(1_000_000_000);
        let (origin, tick) = match self.last {
            Some((known, origin, last)) if known == source => {
                let tick = i64::try_from(ticks(nanos.saturating_sub(origin))).unwrap_or(i64::MAX);
                (origin, tick.max(last.saturating_add(1)))
            }
            Some((.., last)) => {
                let tick = last.saturating_add(ticks(NOMINAL_NANOS) as i64);
                let into = i128::from(tick) * 1_000_000_000 / i128::from(self.per_second);
                (nanos.saturating_sub(i64::try_from(into).unwrap_or(i64::MAX)), tick)
            }
            None => (nanos, 0),
        };
        self.last = Some((source, origin, tick));
        tick
    }
}

impl VideoFile {
    /// Creates a file, by its ending: H.264 in MP4 with times of 0.02 ms, or Motion JPEG in AVI with times of 5 ms. H.264 has even sizes only;
    /// images of others are stretched by a pixel.
    ///
    /// # Errors
    /// The file cannot be created, with the cause.
    pub fn create(path: &Path, size: (u32, u32)) -> Result<Self> {
        let refused = || format!("cannot write a video to {}; does its folder exist?", path.display());
        let file = File::create(path).with_context(refused)?;
        if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("avi")) {
            // AVI repeats images in place of times.
            return Self::open(file, "avi", MOTION_JPEG, 200, size).with_context(refused);
        }
        // More than 65535 ticks per second MPEG-4 does not count.
        let open = |codec| Self::open(file.try_clone()?, "mp4", codec, 50_000, size);
        open(H264).or_else(|_| open(MPEG4)).with_context(refused)
    }

    fn open(
        file: File,
        container: &str,
        (codec, pixels, options): Codec,
        per_second: i32,
        size: (u32, u32),
    ) -> Result<Self> {
        // FFmpeg prints what it also returns.
        ac_ffmpeg::set_log_callback(|_, _| {});
        let format = pixel_format(pixels)?;
        let time_base = TimeBase::new(1, per_second);
        let (across, down) = (size.0 as usize, size.1 as usize);
        let even = |side: usize| if codec == H264.0 { side.next_multiple_of(2) } else { side };
        let mut encoder = VideoEncoder::builder(codec)?
            .pixel_format(format)
            .width(even(across))
            .height(even(down))
            .time_base(time_base);
        for (name, value) in options {
            encoder = encoder.set_option(name, value);
        }
        let encoder = encoder.build()?;
        let scaler = VideoFrameScaler::builder()
            .source_pixel_format(pixel_format("rgb24")?)
            .source_width(across)
            .source_height(down)
            .target_pixel_format(format)
            .target_width(even(across))
            .target_height(even(down))
            .build()?;
        let mut muxer = Muxer::builder();
        muxer.add_stream(&CodecParameters::from(encoder.codec_parameters()))?;
        muxer.streams_mut()[0].set_time_base(time_base);
        let container = OutputFormat::find_by_name(container).ok_or_else(|| Error::new("unknown container"))?;
        let muxer = muxer.build(IO::from_seekable_write_stream(file), container)?;
        Ok(Self { encoder, muxer, scaler, size, ticks: Ticks { per_second, last: None } })
    }

    /// Returns width and height, pixels.
    pub fn size(&self) -> (u32, u32) {
        self.size
    }

    /// Appends an image that a source took at a time, nanoseconds. One that is not later than the image before follows
    /// it at once.
    ///
    /// # Errors
    /// The image has another size, cannot be compressed, or the disk refuses it.
    pub fn write(&mut self, image: &RgbImage, source: u64, capture_nanos: i64) -> Result<()> {
        let (width, height) = image.dimensions();
        anyhow::ensure!((width, height) == self.size, "an image of {width}x{height} in a video of another size");
        let mut frame = VideoFrameMut::black(pixel_format("rgb24")?, width as usize, height as usize);
        let row_bytes = 3 * width as usize;
        for (line, row) in frame.planes_mut()[0].lines_mut().zip(image.chunks_exact(row_bytes)) {
            line[..row_bytes].copy_from_slice(row);
        }
        let time_base = TimeBase::new(1, self.ticks.per_second);
        let tick = Timestamp::new(self.ticks.next(source, capture_nanos), time_base);
        let frame = self.scaler.scale(&frame.with_time_base(time_base).with_pts(tick).freeze())?;
        self.encoder.push(frame)?;
        self.pass_on()
    }

    fn pass_on(&mut self) -> Result<()> {
        while let Some(packet) = self.encoder.take()? {
            // Without a duration, the last image is not shown.
            let packet = packet.into_mut().with_duration(Duration::from_nanos(NOMINAL_NANOS as u64)).freeze();
            self.muxer.push(packet.with_stream_index(0))?;
        }
        Ok(())
    }

    /// Writes what is held back, and the index without which no player reads the file.
    ///
    /// # Errors
    /// The disk refuses it.
    pub fn finish(mut self) -> Result<()> {
        self.encoder.flush()?;
        self.pass_on()?;
        self.muxer.flush()?;
        self.muxer.close()?;
        Ok(())
    }
}

fn pixel_format(name: &str) -> Result<PixelFormat, Error> {
    name.parse().map_err(|_| Error::new(format!("FFmpeg knows no {name}")))
}

#[cfg(test)]
mod tests {
    use flyrig_capture::{CameraSource as _, VideoOptions, VideoReplay};

    use super::*;

    /// Writes images of these times, milliseconds, and returns those that the file has.
    fn written(name: &str, times: &[i64], source: impl Fn(usize) -> u64) -> Vec<f64> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        let mut file = VideoFile::create(&path, (65, 47)).unwrap();
        for (i, time) in times.iter().enumerate() {
            let image = RgbImage::from_pixel(65, 47, image::Rgb([20 * i as u8, 100, 50]));
            file.write(&image, source(i), 1_000_000 * time).unwrap();
        }
        file.finish().unwrap();
        let mut video = VideoReplay::open(&"a".into(), &path, &VideoOptions::default()).unwrap();
        let frames = std::iter::from_fn(|| video.next_frame(Duration::ZERO).ok());
        let read = |(i, frame): (usize, flyrig_types::Frame)| {
            assert!(frame.image.bytes()[2].abs_diff(20 * i as u8) < 8, "{name} {i}: {:?}", &frame.image.bytes()[..3]);
            frame.capture_nanos as f64 * 1e-6
        };
        frames.enumerate().map(read).collect()
    }

    fn assert_near(times: &[f64], expected: &[i64], most: f64) {
        assert_eq!(times.len(), expected.len(), "{times:?}");
        let worst = times.iter().zip(expected).map(|(a, b)| (a - *b as f64).abs()).fold(0.0, f64::max);
        assert!(worst <= most, "{worst} ms: {times:?}");
    }

    #[test]
    fn images_keep_their_own_times() {
        let times = [5_000, 5_033, 5_067, 5_100, 5_700, 5_733, 8_000, 8_010, 8_020];
        let relative: Vec<i64> = times.iter().map(|time| time - times[0]).collect();
        assert_near(&written("a.mp4", &times, |_| 1), &relative, 0.05);
        assert_near(&written("a.avi", &times, |_| 1), &relative, 5.0);
    }

    #[test]
    fn another_rig_and_times_that_go_back_follow_at_once() {
        let times = [90_000, 90_040, 90_080, 10, 70, 70];
        let file = written("a.mp4", &times, |i| u64::from(i > 2));
        assert_near(&file, &[0, 40, 80, 120, 180, 180], 0.05);
        assert!(file.is_sorted_by(|a, b| a < b));
        let mut ticks = Ticks { per_second: 50_000, last: None };
        let mut last = -1;
        for (i, nanos) in [i64::MIN, i64::MAX, 0, i64::MAX, i64::MIN, 7].into_iter().enumerate() {
            let tick = ticks.next(i as u64 / 2, nanos);
            assert!(tick > last || tick == i64::MAX, "{tick}");
            last = tick;
        }
    }

    #[test]
    fn a_folder_that_does_not_exist_is_named() {
        let error = VideoFile::create(Path::new("/nowhere/at/all/a.mp4"), (64, 48)).err().unwrap();
        assert!(error.to_string().contains("cannot write a video to /nowhere/at/all/a.mp4"), "{error}");
    }
}
