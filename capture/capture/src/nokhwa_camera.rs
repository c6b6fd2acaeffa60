//! Cameras through the crate `nokhwa`: those of macOS and Windows, and Linux devices that V4L2 alone does not serve.

use std::{
    fmt,
    time::{Duration, SystemTime},
};

use crossbeam::channel::bounded;
use flyrig_types::{CameraId, PixelFormat};
use nokhwa::{
    Camera, NokhwaError, nokhwa_check, nokhwa_initialize, query,
    utils::{
        ApiBackend, CameraFormat, CameraIndex, CameraInfo, FrameFormat, RequestedFormat, RequestedFormatType,
        Resolution,
    },
};

use crate::blocking::{BlockingCamera, DriverImage, Expected, Opener, Watched};
use crate::camera_options::FormatChoice;
use crate::clock::monotonic_nanos;
use crate::error::{CaptureError, CaptureErrorKind};
use crate::image_file;
use crate::mjpeg;
use crate::source::forward_source;

/// Formats of nokhwa and their equivalents, in the order of preference of [`FormatChoice::Auto`].
const FORMATS: [(FrameFormat, FormatChoice, PixelFormat); 6] = [
    (FrameFormat::YUYV, FormatChoice::Yuyv, PixelFormat::Yuyv),
    (FrameFormat::NV12, FormatChoice::Nv12, PixelFormat::Nv12),
    (FrameFormat::RAWRGB, FormatChoice::Rgb24, PixelFormat::Rgb8),
    (FrameFormat::RAWBGR, FormatChoice::Rgb24, PixelFormat::Bgr8),
    (FrameFormat::MJPEG, FormatChoice::Mjpeg, PixelFormat::Mjpeg),
    (FrameFormat::GRAY, FormatChoice::Grey, PixelFormat::Gray8),
];
/// Time limit of the system's request for the user's permission.
const ASKING: Duration = Duration::from_secs(4);

/// Identity of a nokhwa camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NokhwaDevice {
    /// Number in the system's list; on Linux that of `/dev/video`. It may change after a replug: prefer the name.
    Index(u32),
    /// Name; the first camera of several with that name.
    Name(String),
}

impl From<&str> for NokhwaDevice {
    /// Parses a number as an index, any other text as a name.
    fn from(text: &str) -> Self {
        text.parse().map_or_else(|_| Self::Name(text.to_owned()), Self::Index)
    }
}

impl fmt::Display for NokhwaDevice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Index(index) => write!(f, "number {index}"),
            Self::Name(name) => write!(f, "name \"{name}\""),
        }
    }
}

/// Options with which a nokhwa camera is opened.
#[derive(Debug, Clone, PartialEq)]
pub struct NokhwaOptions {
    /// Device to open.
    pub device: NokhwaDevice,
    /// Pixels. Other sizes are rejected, since the calibration holds for this one.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Frames per second, rounded: nokhwa supports whole rates only.
    pub fps: f64,
    /// Pixel format; UYVY and Bayer mosaics are not supported.
    pub format: FormatChoice,
    /// Latency of this camera's timestamps, seconds; subtracted from them.
    pub lag_secs: f64,
}

/// Camera of this computer, read through `nokhwa`. Frames have the camera's own pixel format.
///
/// Reads of nokhwa may block for ever, so they run in a thread of their own. A camera that yields no frame for five
/// periods (but not less than 500 ms) is given up and reopened; a thread that hangs in the driver is abandoned, at most
/// one per camera, so that a camera never has more than two threads.
///
/// The capture time is the system's timestamp where there is one, otherwise the arrival minus half a period, which is
/// accurate to about half a frame; [`SourceHealth::mode`](crate::SourceHealth::mode) reports which applies. The system
/// does not document the instant that its timestamp refers to: it may be off by exposure and readout, which `lag_secs`
/// corrects. nokhwa has no sequence numbers: frames are counted on arrival, so that losses in the driver are not
/// detected. Exposure and other controls stay as the camera has them. Padded rows cannot be distinguished and look
/// sheared.
#[derive(Debug)]
pub struct NokhwaCamera(Watched<System>);

impl NokhwaCamera {
    /// Finds the camera, configures it and starts its stream.
    ///
    /// # Errors
    /// `NotFound` when there is no such camera, `Unsupported` for options that it lacks, `Io` when it is in use, access
    /// is denied or it hangs. Every text names the camera, the cause and the fix.
    pub fn open(camera: &CameraId, options: &NokhwaOptions) -> Result<Self, CaptureError> {
        let (size, lag_secs) = ((options.width, options.height), options.lag_secs);
        let expected = Expected { size, fps: options.fps, lag_secs };
        Watched::open(camera, expected, System(options.clone())).map(Self)
    }
}

forward_source!(NokhwaCamera);

/// Lists number and name of every camera that `nokhwa` finds.
///
/// # Errors
/// `Io` when the system's list is unavailable.
pub fn nokhwa_cameras() -> Result<Vec<(NokhwaDevice, String)>, CaptureError> {
    let infos = list()?;
    Ok(infos.iter().map(|info| (NokhwaDevice::from(info.index().as_string().as_str()), info.human_name())).collect())
}

fn list() -> Result<Vec<CameraInfo>, CaptureError> {
    if !nokhwa_check() {
        let (sender, receiver) = bounded(1);
        nokhwa_initialize(move |granted| {
            // Nobody waits any more for an answer that comes late.
            let _ = sender.try_send(granted);
        });
        if !receiver.recv_timeout(ASKING).unwrap_or(false) {
            let text =
                "the system does not let this program use cameras; allow it in the privacy settings and start again";
            return Err(CaptureError::general(CaptureErrorKind::Io, text));
        }
    }
    query(ApiBackend::Auto).map_err(|error| explain(&error))
}

fn find(infos: &[CameraInfo], device: &NokhwaDevice) -> Result<CameraIndex, CaptureError> {
    let is_it = |info: &&CameraInfo| match device {
        NokhwaDevice::Index(index) => info.index().as_string() == index.to_string(),
        NokhwaDevice::Name(name) => info.human_name() == *name,
    };
    let order = |info: &&CameraInfo| info.index().as_index().unwrap_or(u32::MAX);
    if let Some(info) = infos.iter().filter(is_it).min_by_key(order) {
        return Ok(info.index().clone());
    }
    let there: Vec<String> =
        infos.iter().map(|info| format!("{} \"{}\"", info.index().as_string(), info.human_name())).collect();
    let there = if there.is_empty() { "none".to_owned() } else { there.join(", ") };
    let text = format!("no camera with {device} was found; plug it in, or set nokhwa to one of these: {there}");
    Err(CaptureError::general(CaptureErrorKind::NotFound, text))
}

/// Maps an error of nokhwa, which is plain text that ends with the system's error number.
fn explain(error: &NokhwaError) -> CaptureError {
    let text = error.to_string();
    let has = |number: u8| text.contains(&format!("(os error {number})"));
    let general = |kind, mend: &str| CaptureError::general(kind, format!("{text}; {mend}"));
    if has(2) || has(6) || has(19) {
        general(CaptureErrorKind::Disconnected, "it is gone: plug the camera in again")
    } else if has(13) {
        general(CaptureErrorKind::Io, "add the user to the group video (sudo usermod -aG video $USER) and log in again")
    } else if has(16) {
        general(CaptureErrorKind::Io, "another program uses it: close that")
    } else {
        general(CaptureErrorKind::Io, "plug it in again, or see whether another program can use it")
    }
}

/// This computer's cameras.
#[derive(Debug)]
struct System(NokhwaOptions);

impl System {
    fn size(&self) -> Resolution {
        Resolution::new(self.0.width, self.0.height)
    }

    /// Builds the error of an unsupported mode, with the modes that the camera has.
    fn lacks(&self, index: CameraIndex, error: &NokhwaError) -> CaptureError {
        let all = FORMATS.map(|(format, ..)| format);
        let opened = Camera::new(index, RequestedFormat::with_formats(RequestedFormatType::None, &all));
        let formats = opened.and_then(|mut camera| camera.compatible_camera_formats()).unwrap_or_default();
        let of_size = formats.iter().filter(|format| format.resolution() == self.size());
        let mut list: Vec<String> = of_size.map(|f| format!("{} at {}", f.format(), f.frame_rate())).collect();
        list.sort();
        list.dedup();
        let list = if list.is_empty() { "none that nokhwa knows".to_owned() } else { list.join(", ") };
        let NokhwaOptions { width, height, fps, format, .. } = &self.0;
        let text = format!(
            "gives no {format:?} images of {width}x{height} at {fps} frames a second ({error}); what it has at that \
             size: {list}"
        );
        CaptureError::general(CaptureErrorKind::Unsupported, text)
    }
}

impl Opener for System {
    type Camera = OpenCamera;

    fn device(&self) -> String {
        format!("{:?}", self.0.device)
    }

    fn open(&self) -> Result<OpenCamera, CaptureError> {
        let index = find(&list()?, &self.0.device)?;
        let rate = self.0.fps.round().clamp(1.0, 10_000.0) as u32;
        let choice = self.0.format;
        let mut refused = NokhwaError::NotImplementedError(format!("{choice:?}"));
        for (format, ..) in FORMATS.iter().filter(|(_, of, _)| choice == FormatChoice::Auto || choice == *of) {
            let wanted = CameraFormat::new(self.size(), *format, rate);
            let formats = [*format];
            let exact = RequestedFormat::with_formats(RequestedFormatType::Exact(wanted), &formats);
            match Camera::new(index.clone(), exact) {
                Ok(mut camera) => {
                    camera.open_stream().map_err(|error| explain(&error))?;
                    return Ok(OpenCamera(camera));
                }
                Err(error)
                    if matches!(error, NokhwaError::OpenDeviceError(..)) || error.to_string().contains("(os error") =>
                {
                    return Err(explain(&error));
                }
                Err(error) => refused = error,
            }
        }
        Err(self.lacks(index, &refused))
    }
}

struct OpenCamera(Camera);

impl BlockingCamera for OpenCamera {
    fn mode(&self) -> String {
        let format = self.0.camera_format();
        format!("{} {} at {} through nokhwa", format.format(), format.resolution(), format.frame_rate())
    }

    fn read(&mut self, bytes: &mut Vec<u8>) -> Result<DriverImage, CaptureError> {
        let before = wall_offset_nanos();
        let buffer = self.0.frame().map_err(|error| explain(&error))?;
        let arrival_nanos = monotonic_nanos();
        let stamp_nanos =
            buffer.capture_timestamp().and_then(|taken| steady_nanos(taken, [before, wall_offset_nanos()]));
        let resolution = buffer.resolution();
        let format = buffer.source_frame_format();
        let Some((.., format)) = FORMATS.iter().find(|(of, ..)| *of == format) else {
            return Err(CaptureError::general(CaptureErrorKind::Corrupt, format!("{format} cannot be read")));
        };
        let size = cut(*format, (resolution.width(), resolution.height()), buffer.buffer(), bytes)?;
        Ok(DriverImage { size, format: *format, stamp_nanos, arrival_nanos })
    }
}

/// Largest change of the wall clock against the monotonic one during a read that is not a step, nanoseconds: a busy machine may pause
/// between the readings of both.
const SAME_CLOCK: u64 = 20_000_000;

/// Returns the wall clock minus the monotonic clock, nanoseconds; `None` before 1970.
fn wall_offset_nanos() -> Option<i64> {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).ok()?;
    i64::try_from(now.as_nanos()).ok()?.checked_sub(monotonic_nanos())
}

/// Converts a time of the wall clock to the monotonic one, with their difference before and after the read that gave it. `None` where the
/// wall clock was set in between: then the time may be of either setting.
fn steady_nanos(taken: Duration, [before, after]: [Option<i64>; 2]) -> Option<i64> {
    let (before, after) = (before?, after?);
    let taken = i64::try_from(taken.as_nanos()).ok()?;
    (before.abs_diff(after) <= SAME_CLOCK).then(|| taken.saturating_sub(after))
}

/// Copies the image without trailing bytes, since nokhwa may return the driver's whole buffer. Returns its size.
fn cut(
    format: PixelFormat,
    (width, height): (u32, u32),
    given: &[u8],
    bytes: &mut Vec<u8>,
) -> Result<(u32, u32), CaptureError> {
    let corrupt = |text: String| CaptureError::general(CaptureErrorKind::Corrupt, text);
    let (length, size) = if format == PixelFormat::Mjpeg {
        let found = image_file::jpeg_length(given).zip(mjpeg::jpeg_size(given));
        let (length, size) = found.ok_or_else(|| corrupt("an image is no whole JPEG".to_owned()))?;
        (length, (size.0 as u32, size.1 as u32))
    } else {
        (format.byte_len(width, height).unwrap_or(usize::MAX), (width, height))
    };
    let given = given.get(..length);
    bytes.extend_from_slice(given.ok_or_else(|| corrupt(format!("an image is cut off: it has no {length} bytes")))?);
    Ok(size)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(device: &str) -> NokhwaOptions {
        let (width, height, fps) = (640, 360, 30.0);
        NokhwaOptions { device: device.into(), width, height, fps, format: FormatChoice::Auto, lag_secs: 0.0 }
    }

    #[test]
    fn a_wall_clock_that_is_set_during_a_read_gives_no_stamp() {
        const SECOND: i64 = 1_000_000_000;
        let (monotonic, offset) = (500 * SECOND, 1_700_000_000 * SECOND);
        for step in [SECOND / 10, SECOND / 2, 10 * SECOND, 3600 * SECOND].into_iter().flat_map(|step| [step, -step]) {
            // Set before the driver's stamp, or after it.
            for taken in [monotonic + offset, monotonic + offset + step] {
                let taken = Duration::from_nanos(taken.unsigned_abs());
                assert_eq!(steady_nanos(taken, [Some(offset), Some(offset + step)]), None, "{step}");
            }
            // Set at another time.
            let taken = Duration::from_nanos((monotonic + offset + step).unsigned_abs());
            assert_eq!(steady_nanos(taken, [Some(offset + step); 2]), Some(monotonic), "{step}");
        }
        assert_eq!(steady_nanos(Duration::MAX, [Some(0); 2]), None);
        assert_eq!(steady_nanos(Duration::ZERO, [None, Some(0)]), None);
    }

    #[test]
    fn a_camera_that_is_not_there_is_one_clear_error() {
        for (device, named) in [("97", "no camera with number 97"), ("Best Cam", "no camera with name \"Best Cam\"")] {
            let error = NokhwaCamera::open(&"front".into(), &options(device)).unwrap_err();
            assert_eq!(error.kind, CaptureErrorKind::NotFound);
            let text = error.to_string();
            assert!(
                text.starts_with(&format!("camera front: {named} was found; plug it in, or set nokhwa to")),
                "{text}"
            );
        }
    }

    #[test]
    fn cameras_are_found_by_number_and_name() {
        let info = |name: &str, index| CameraInfo::new(name, "", "", CameraIndex::Index(index));
        let infos = [info("B", 3), info("A", 2), info("B", 1)];
        let found = |device: &str| find(&infos, &device.into()).map(|index| index.as_string());
        assert_eq!([found("2"), found("B")], [Ok("2".into()), Ok("1".into())]);
        let error = found("0").unwrap_err();
        assert_eq!(
            error.to_string(),
            "no camera with number 0 was found; plug it in, or set nokhwa to one of these: 3 \"B\", 2 \"A\", 1 \"B\""
        );
    }

    #[test]
    fn errors_of_the_system_say_what_to_do() {
        let open = |text: &str| explain(&NokhwaError::OpenDeviceError("0".into(), text.into()));
        for (text, kind, mend) in [
            ("Permission denied (os error 13)", CaptureErrorKind::Io, "usermod -aG video"),
            ("Device or resource busy (os error 16)", CaptureErrorKind::Io, "another program uses it"),
            ("No such device (os error 19)", CaptureErrorKind::Disconnected, "plug the camera in again"),
            ("whatever", CaptureErrorKind::Io, "another program can use it"),
        ] {
            let error = open(text);
            assert_eq!(error.kind, kind, "{error}");
            assert!(error.message.contains(text) && error.message.contains(mend), "{error}");
        }
    }

    #[test]
    fn what_lies_behind_an_image_is_left_out() {
        let mut bytes = Vec::new();
        let given: Vec<u8> = (0..100).collect();
        assert_eq!(cut(PixelFormat::Yuyv, (4, 2), &given, &mut bytes), Ok((4, 2)));
        assert_eq!(bytes, given[..16]);
        assert!(cut(PixelFormat::Nv12, (64, 64), &given, &mut bytes).unwrap_err().message.contains("cut off"));
        let mut jpeg = std::io::Cursor::new(Vec::new());
        image::RgbImage::new(16, 8).write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        let whole = jpeg.into_inner();
        // As the driver's buffer looks: the rest of a longer image before it.
        let padded: Vec<u8> = whole.iter().copied().chain([7; 3000]).chain([0xff, 0xd9]).collect();
        bytes.clear();
        assert_eq!(cut(PixelFormat::Mjpeg, (640, 360), &padded, &mut bytes), Ok((16, 8)));
        assert_eq!(bytes, whole);
        assert!(cut(PixelFormat::Mjpeg, (16, 8), &whole[..whole.len() - 2], &mut bytes).is_err());
        assert!(cut(PixelFormat::Mjpeg, (16, 8), b"no image", &mut bytes).is_err());
    }
}
