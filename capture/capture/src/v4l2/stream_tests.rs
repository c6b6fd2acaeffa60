//! Connecting and reconnecting with scripted devices.

use std::{
    collections::VecDeque,
    io,
    path::PathBuf,
    sync::{Arc, Mutex},
    time::Duration,
};

use v4l::v4l_sys::V4L2_CID_GAIN;

use super::{
    controls::{ControlDevice, tests::FakeControls},
    queue::{
        BufferDevice, Delivered, MAX_PLANES,
        tests::{Fake, Step},
    },
    stream::{CameraDevice, Host, Stream},
    sys::{ActiveFormat, ControlRange, SizeRange},
};
use crate::camera_options::{CameraControls, CameraIdentity, CameraOptions, FormatChoice};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::source::CameraSource;

const POLL: Duration = Duration::from_millis(200);
const MS: i64 = 1_000_000;

/// Webcam of 4x2 pixels with two formats, and a record of its calls.
#[derive(Debug, Default)]
struct Webcam {
    buffers: Fake,
    controls: FakeControls,
    clock: Arc<Mutex<i64>>,
    log: Arc<Mutex<Vec<String>>>,
    answers_with: Option<[u8; 4]>,
}

impl BufferDevice for Webcam {
    fn allocate(&mut self, count: u32) -> io::Result<u32> {
        self.buffers.allocate(count)
    }

    fn enqueue(&mut self, index: u32) -> io::Result<()> {
        self.buffers.enqueue(index)
    }

    fn dequeue(&mut self) -> io::Result<Delivered> {
        *self.clock.lock().unwrap() += 33 * MS;
        self.buffers.stamp_nanos = *self.clock.lock().unwrap() - 4 * MS;
        self.buffers.dequeue()
    }

    fn start(&mut self) -> io::Result<()> {
        self.buffers.start()
    }

    fn stop(&mut self) -> io::Result<()> {
        self.buffers.stop()
    }

    fn wait(&mut self, timeout: Duration) -> io::Result<bool> {
        let ready = self.buffers.wait(timeout)?;
        if !ready {
            *self.clock.lock().unwrap() += timeout.as_nanos() as i64;
        }
        Ok(ready)
    }

    fn plane(&self, index: u32, plane: usize) -> &[u8] {
        self.buffers.plane(index, plane)
    }
}

impl ControlDevice for Webcam {
    fn range(&self, id: u32) -> io::Result<Option<ControlRange>> {
        self.controls.range(id)
    }

    fn get(&self, id: u32) -> io::Result<i32> {
        self.controls.get(id)
    }

    fn set(&mut self, id: u32, value: i32) -> io::Result<()> {
        self.log.lock().unwrap().push(format!("set {id} {value}"));
        self.controls.set(id, value)
    }
}

impl CameraDevice for Webcam {
    fn formats(&self) -> io::Result<Vec<[u8; 4]>> {
        Ok(vec![*b"YUYV", *b"MJPG"])
    }

    fn sizes(&self, _fourcc: [u8; 4]) -> io::Result<Vec<SizeRange>> {
        Ok(vec![SizeRange::One(8, 8), SizeRange::Steps([2, 4, 2], [2, 2, 1])])
    }

    fn rates(&self, _fourcc: [u8; 4], _width: u32, _height: u32) -> io::Result<Vec<f64>> {
        Ok(vec![30.0, 15.0])
    }

    fn set_format(&mut self, fourcc: [u8; 4], width: u32, height: u32) -> io::Result<ActiveFormat> {
        self.log.lock().unwrap().push(format!("format {}", String::from_utf8_lossy(&fourcc)));
        let fourcc = self.answers_with.unwrap_or(fourcc);
        Ok(ActiveFormat { fourcc, width, height, stride: [0; MAX_PLANES], planes: 1 })
    }

    fn set_rate(&mut self, fps: f64) -> io::Result<Option<f64>> {
        self.log.lock().unwrap().push(format!("rate {fps}"));
        Ok(Some(fps))
    }
}

/// Supply of devices in turn; an errno in place of a device is the error of opening it.
#[derive(Debug)]
struct Bench {
    devices: VecDeque<Result<Webcam, i32>>,
    clock: Arc<Mutex<i64>>,
    log: Arc<Mutex<Vec<String>>>,
}

impl Host for Bench {
    type Device = Webcam;

    fn open(&mut self, identity: &CameraIdentity) -> Result<(Webcam, PathBuf, Option<u32>), CaptureError> {
        let node = PathBuf::from("/dev/video7");
        match self.devices.pop_front() {
            Some(Ok(mut device)) => {
                (device.clock, device.log) = (Arc::clone(&self.clock), Arc::clone(&self.log));
                Ok((device, node, Some(480)))
            }
            Some(Err(errno)) => {
                Err(super::causes::explain(&io::Error::from_raw_os_error(errno), "cannot be opened", &node))
            }
            None => {
                Err(CaptureError::general(CaptureErrorKind::NotFound, format!("there is no camera with {identity}")))
            }
        }
    }

    fn now_nanos(&self) -> i64 {
        *self.clock.lock().unwrap()
    }
}

fn webcam(script: Vec<Step>) -> Webcam {
    let buffers = Fake { script: script.into(), ..Fake::default() };
    let controls = FakeControls([(V4L2_CID_GAIN, (0, 255, 0))].into());
    Webcam { buffers, controls, ..Webcam::default() }
}

fn frames(numbers: std::ops::Range<u32>) -> Vec<Step> {
    numbers.map(|n| Step::Frame(n, vec![n as u8; 16])).collect()
}

fn options() -> CameraOptions {
    CameraOptions {
        identity: CameraIdentity::Serial("A1".into()),
        width: 4,
        height: 2,
        fps: 30.0,
        format: FormatChoice::Yuyv,
        controls: CameraControls { gain: Some(9), ..CameraControls::default() },
        readout_secs: 0.010,
        lag_secs: 0.0,
        buffers: 4,
    }
}

type Log = Arc<Mutex<Vec<String>>>;

fn open(devices: Vec<Result<Webcam, i32>>, options: &CameraOptions) -> (Result<Stream<Bench>, CaptureError>, Log) {
    let log = Log::default();
    let clock = Arc::new(Mutex::new(1_000_000 * MS));
    let bench = Bench { devices: devices.into(), clock, log: Arc::clone(&log) };
    (Stream::open(&"cam".into(), options, bench), log)
}

fn kinds(stream: &mut Stream<Bench>, calls: usize) -> Vec<Result<u64, CaptureErrorKind>> {
    (0..calls).map(|_| stream.next_frame(POLL).map(|f| f.sequence).map_err(|e| e.kind)).collect()
}

#[test]
fn frames_come_with_number_time_and_pixels() {
    let (stream, log) = open(vec![Ok(webcam([frames(10..12), frames(15..16)].concat()))], &options());
    let mut stream = stream.unwrap();
    let first = stream.next_frame(POLL).unwrap();
    assert_eq!((first.sequence, first.image.bytes()), (0, &[10; 16][..]));
    // Arrival 33 ms after the start, stamped 4 ms before it at the end of the frame, half the readout before that.
    assert_eq!(first.capture_nanos, 1_000_000 * MS + (33 - 4 - 5) * MS);
    assert_eq!(kinds(&mut stream, 2), [Ok(1), Ok(5)]);
    assert_eq!((stream.health().lost_by_driver, stream.health().reconnects), (3, 0));
    assert_eq!(&*stream.health().mode, "YUYV 4x2 at 30.00");
    assert_eq!(*log.lock().unwrap(), ["format YUYV", "rate 30", &format!("set {V4L2_CID_GAIN} 9")]);
}

#[test]
fn damaged_empty_and_cut_frames_cost_themselves() {
    let script = vec![
        Step::Broken(0),
        Step::Frame(1, vec![]),
        Step::Frame(2, vec![1; 15]),
        Step::Frame(3, vec![1; 16]),
        Step::Frame(4, vec![1; 99]),
    ];
    let (stream, _) = open(vec![Ok(webcam(script))], &options());
    let corrupt = || Err(CaptureErrorKind::Corrupt);
    assert_eq!(kinds(&mut stream.unwrap(), 5), [corrupt(), corrupt(), corrupt(), Ok(3), Ok(4)]);
}

#[test]
fn an_unplugged_camera_comes_back_with_its_settings() {
    let gone = [frames(0..2), vec![Step::Fail(libc::ENODEV)]].concat();
    let devices = vec![Ok(webcam(gone)), Err(libc::ENOENT), Err(libc::EBUSY), Ok(webcam(frames(0..3)))];
    let (stream, log) = open(devices, &options());
    let mut stream = stream.unwrap();
    let (gone, io) = (Err(CaptureErrorKind::Disconnected), Err(CaptureErrorKind::Io));
    assert_eq!(kinds(&mut stream, 7), [Ok(0), Ok(1), gone, gone, io, Ok(2), Ok(3)]);
    assert_eq!((stream.health().reconnects, stream.health().lost_by_driver), (1, 0));
    let set = format!("set {V4L2_CID_GAIN} 9");
    assert_eq!(*log.lock().unwrap(), ["format YUYV", "rate 30", &set, "format YUYV", "rate 30", &set]);
    // Not found while running is no reason to give up.
    assert_eq!(kinds(&mut stream, 1), [Ok(4)]);
    *stream_script(&mut stream) = [Step::Fail(libc::ENODEV)].into();
    assert_eq!(kinds(&mut stream, 3), [gone, gone, gone]);
}

fn stream_script(stream: &mut Stream<Bench>) -> &mut VecDeque<Step> {
    &mut stream.device().unwrap().buffers.script
}

#[test]
fn a_silent_camera_is_noticed_within_half_a_second_and_restarted() {
    let (stream, _) = open(vec![Ok(webcam(frames(0..1))), Ok(webcam(frames(0..1)))], &options());
    let mut stream = stream.unwrap();
    assert!(stream.next_frame(POLL).is_ok());
    let before = stream.host().now_nanos();
    let late = |stream: &mut Stream<Bench>| stream.next_frame(POLL).unwrap_err();
    let errors = [late(&mut stream), late(&mut stream), late(&mut stream)];
    assert_eq!(
        errors.each_ref().map(|e| e.kind),
        [CaptureErrorKind::Timeout, CaptureErrorKind::Timeout, CaptureErrorKind::Disconnected]
    );
    assert_eq!(errors[2].to_string(), "camera cam: gave no frame for 500 ms; starting it again");
    assert!(stream.host().now_nanos() - before <= 500 * MS);
    assert_eq!((stream.next_frame(POLL).unwrap().sequence, stream.health().silences), (1, 1));
}

#[test]
fn a_slow_camera_may_take_five_periods() {
    let slow = CameraOptions { fps: 15.0, ..options() };
    let (stream, _) = open(vec![Ok(webcam(frames(0..1)))], &slow);
    let mut stream = stream.unwrap();
    // Before its first frame it may take seconds; then five periods are less than half a second for 15 a second.
    *stream_script(&mut stream) = [Step::Silence, Step::Silence, Step::Silence].into();
    assert_eq!(kinds(&mut stream, 3), [Err(CaptureErrorKind::Timeout); 3]);
    stream_script(&mut stream).extend(frames(0..1));
    assert!(stream.next_frame(POLL).is_ok());
}

#[test]
fn a_full_bus_is_answered_by_stepping_down() {
    let full = |times: usize| {
        let mut camera = webcam([frames(0..1), vec![Step::Fail(libc::ENODEV)]].concat());
        camera.buffers.start_errors = vec![libc::ENOSPC; times].into();
        camera
    };
    let (stream, log) = open(vec![Ok(full(1)), Ok(full(0))], &options());
    let mut stream = stream.unwrap();
    assert_eq!(&*stream.health().mode, "MJPG 4x2 at 30.00");
    assert!(kinds(&mut stream, 3)[2].is_ok());
    let formats: Vec<String> = log.lock().unwrap().iter().filter(|l| l.starts_with("format")).cloned().collect();
    assert_eq!(formats, ["format YUYV", "format MJPG", "format MJPG"], "the step stays when it comes back");

    let (stream, _) = open(vec![Ok(full(99))], &options());
    let error = stream.unwrap_err();
    assert_eq!(error.kind, CaptureErrorKind::Io);
    assert!(error.message.contains("no room for it, even as MJPG at 15.00"), "{error}");
}

#[test]
fn what_is_wrong_at_the_start_is_told_at_once() {
    let error = |devices, options: &CameraOptions| open(devices, options).0.unwrap_err();
    let missing = error(vec![], &options());
    assert_eq!(
        (missing.kind, missing.to_string().as_str()),
        (CaptureErrorKind::NotFound, "camera cam: there is no camera with serial \"A1\"")
    );
    let busy = error(vec![Err(libc::EBUSY)], &options());
    assert!(busy.message.contains("/dev/video7 is in use by") && busy.message.contains("end that first"), "{busy}");
    let denied = error(vec![Err(libc::EACCES)], &options());
    assert!(denied.message.contains("usermod -aG video"), "{denied}");
    let size = error(vec![Ok(webcam(vec![]))], &CameraOptions { width: 6, ..options() });
    assert_eq!(size.kind, CaptureErrorKind::Unsupported);
    assert!(size.message.contains("has no Yuyv images of 6x2"), "{size}");
    let control = CameraControls { focus: Some(1), ..CameraControls::default() };
    let control = error(vec![Ok(webcam(vec![]))], &CameraOptions { controls: control, ..options() });
    assert!(control.message.contains("no control for focus"), "{control}");
    let stubborn = Webcam { answers_with: Some(*b"NV12"), ..webcam(vec![]) };
    let stubborn = error(vec![Ok(stubborn)], &options());
    assert!(stubborn.message.contains("sends NV12 4x2 instead of YUYV 4x2"), "{stubborn}");
}

#[test]
fn frames_from_before_the_first_question_are_not_given() {
    let (stream, _) = open(vec![Ok(webcam(frames(0..6)))], &options());
    let mut stream = stream.unwrap();
    *stream.host().clock.lock().unwrap() += 1000 * MS;
    let frame = stream.next_frame(POLL).unwrap();
    assert_eq!((frame.sequence, frame.image.bytes()[0]), (0, 4), "as many as there are buffers were old");
}
