//! Blocking cameras that fail, hang and panic by script.

use std::{
    collections::VecDeque,
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
};

use flyrig_types::PixelFormat;

use super::*;
use crate::clock::monotonic_nanos;

const SIZE: (u32, u32) = (4, 2);
const FPS: f64 = 50.0;
const MINUTE: Duration = Duration::from_secs(60);

/// Next action of a scripted camera.
#[derive(Debug, Clone, Copy)]
enum Step {
    Frame,
    /// Frame of this size.
    Sized(u32, u32),
    /// Frame with a system timestamp of this age, nanoseconds.
    Stamped(i64),
    Damaged,
    Fails,
    Panics,
    /// Panics, and again in the drop during unwinding.
    PanicsTwice,
    /// Blocks until [`Script::release`] is called.
    Hangs,
}

/// Outcome of an opening, and the camera's actions after it.
#[derive(Debug, Clone)]
enum Open {
    Camera(Vec<Step>),
    Refused(CaptureErrorKind),
    Panics,
    Hangs,
}

#[derive(Debug, Default)]
struct Script {
    opens: Mutex<VecDeque<Open>>,
    /// Number of hanging calls that may return.
    released: Mutex<usize>,
    changed: std::sync::Condvar,
    /// Open cameras and pending calls.
    open: AtomicUsize,
    most_open: AtomicUsize,
    tried: AtomicUsize,
}

impl Script {
    fn hang(&self) {
        let mut released = self.released.lock().unwrap();
        while *released == 0 {
            released = self.changed.wait(released).unwrap();
        }
        *released -= 1;
    }

    fn release(&self, calls: usize) {
        *self.released.lock().unwrap() += calls;
        self.changed.notify_all();
    }

    fn enter(self: &Arc<Self>) -> Inside {
        let open = self.open.fetch_add(1, Ordering::SeqCst) + 1;
        self.most_open.fetch_max(open, Ordering::SeqCst);
        Inside(Arc::clone(self))
    }
}

/// Guard of a thread inside the driver.
struct Inside(Arc<Script>);

impl Drop for Inside {
    fn drop(&mut self) {
        self.0.open.fetch_sub(1, Ordering::SeqCst);
    }
}

struct Fake {
    steps: VecDeque<Step>,
    inside: Inside,
    panics_in_drop: bool,
}

impl Drop for Fake {
    fn drop(&mut self) {
        assert!(!self.panics_in_drop, "in drop");
    }
}

impl BlockingCamera for Fake {
    fn mode(&self) -> String {
        "FAKE 4x2 at 50".to_owned()
    }

    fn read(&mut self, bytes: &mut Vec<u8>) -> Result<DriverImage, CaptureError> {
        assert!(bytes.is_empty());
        let arrival_nanos = monotonic_nanos();
        let mut shot = DriverImage { size: SIZE, format: PixelFormat::Yuyv, stamp_nanos: None, arrival_nanos };
        match self.steps.pop_front().unwrap_or(Step::Hangs) {
            Step::Frame => std::thread::sleep(Duration::from_millis(2)),
            Step::Sized(width, height) => shot.size = (width, height),
            Step::Stamped(age) => {
                std::thread::sleep(Duration::from_millis(2));
                shot.stamp_nanos = Some(arrival_nanos - age);
            }
            Step::Damaged => return Err(CaptureError::general(CaptureErrorKind::Corrupt, "half an image")),
            Step::Fails => return Err(CaptureError::general(CaptureErrorKind::Io, "no such device")),
            Step::Panics => panic!("index out of bounds"),
            Step::PanicsTwice => {
                self.panics_in_drop = true;
                panic!("first");
            }
            Step::Hangs => self.inside.0.hang(),
        }
        bytes.resize(shot.format.byte_len(shot.size.0, shot.size.1).unwrap(), 9);
        Ok(shot)
    }
}

impl Opener for Arc<Script> {
    type Camera = Fake;

    fn device(&self) -> String {
        format!("{:p}", Arc::as_ptr(self))
    }

    fn open(&self) -> Result<Fake, CaptureError> {
        self.tried.fetch_add(1, Ordering::SeqCst);
        let inside = self.enter();
        let next = self.opens.lock().unwrap().pop_front();
        match next.unwrap_or(Open::Refused(CaptureErrorKind::NotFound)) {
            Open::Camera(steps) => Ok(Fake { steps: steps.into(), inside, panics_in_drop: false }),
            Open::Refused(kind) => Err(CaptureError::general(kind, "not there")),
            Open::Panics => panic!("in open"),
            Open::Hangs => {
                self.hang();
                Err(CaptureError::general(CaptureErrorKind::Io, "late"))
            }
        }
    }
}

fn script(opens: &[Open]) -> Arc<Script> {
    Arc::new(Script { opens: Mutex::new(opens.to_vec().into()), ..Script::default() })
}

fn open(script: &Arc<Script>) -> Result<Watched<Arc<Script>>, CaptureError> {
    let expected = Expected { size: SIZE, fps: FPS, lag_secs: 0.0 };
    Watched::open(&"left".into(), expected, Arc::clone(script))
}

fn frames(steps: usize) -> Vec<Step> {
    vec![Step::Frame; steps]
}

/// Returns the next result that is not a timeout.
fn next(camera: &mut Watched<Arc<Script>>) -> Result<Frame, CaptureError> {
    loop {
        match camera.next_frame(Duration::from_millis(100)) {
            Err(error) if error.kind == CaptureErrorKind::Timeout => {}
            result => return result,
        }
    }
}

/// Waits until a condition holds.
fn until(what: &str, is_so: impl Fn() -> bool) {
    let start = Instant::now();
    while !is_so() {
        assert!(start.elapsed() < MINUTE, "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn frames_are_counted_and_stamped_at_arrival_less_half_a_period() {
    let script = script(&[Open::Camera(frames(20))]);
    let mut camera = open(&script).unwrap();
    assert_eq!(&*camera.health().mode, "FAKE 4x2 at 50");
    let mut last = None;
    for _ in 0..10 {
        let before = monotonic_nanos();
        let frame = next(&mut camera).unwrap();
        assert!(frame.capture_nanos <= monotonic_nanos() - 10_000_000, "half of 20 ms");
        assert!(frame.capture_nanos > before - MINUTE.as_nanos() as i64);
        assert!(last.is_none_or(|(sequence, nanos)| sequence < frame.sequence && nanos < frame.capture_nanos));
        last = Some((frame.sequence, frame.capture_nanos));
        assert_eq!(
            (frame.camera.as_str(), frame.image.format(), frame.exposure_nanos),
            ("left", PixelFormat::Yuyv, None)
        );
    }
    let health = camera.health();
    assert_eq!(&*health.mode, "FAKE 4x2 at 50, stamped at arrival less half a period");
    let (sequence, _) = last.unwrap();
    assert_eq!(sequence, 9 + health.lost_by_driver, "what newer frames overtook has its numbers");
    assert_eq!((health.reconnects, health.silences), (0, 0));
}

#[test]
fn the_systems_stamp_is_taken_where_it_can_be_right() {
    let hour = 3_600_000_000_000;
    let steps = [Step::Stamped(7_000_000), Step::Stamped(hour)].map(|step| vec![step; 20]).concat();
    let mut camera = open(&script(&[Open::Camera(steps)])).unwrap();
    let before = monotonic_nanos();
    let first = next(&mut camera).unwrap();
    assert!(first.capture_nanos <= monotonic_nanos() - 7_000_000);
    while camera.health().stamps_replaced == 0 {
        let frame = next(&mut camera).unwrap();
        assert!(frame.capture_nanos > before - 3_000_000_000, "an hour ago cannot be");
    }
    assert_eq!(&*camera.health().mode, "FAKE 4x2 at 50, stamped by the system");
}

#[test]
fn an_image_of_another_size_or_damaged_costs_itself_alone() {
    // Newer ones may overtake any of them.
    let steps = [Step::Sized(8, 2), Step::Damaged, Step::Frame].repeat(30);
    let mut camera = open(&script(&[Open::Camera(steps)])).unwrap();
    let mut seen = Vec::new();
    loop {
        match next(&mut camera) {
            Ok(_) if seen.is_empty() => {}
            Ok(_) => break,
            Err(error) => seen.push((error.kind, error.to_string())),
        }
    }
    assert!(seen.iter().all(|(kind, _)| *kind == CaptureErrorKind::Corrupt), "{seen:?}");
    let is_size =
        |text: &str| text.starts_with("camera left: frame ") && text.ends_with(": it is 8x2 and not 4x2 as asked for");
    assert!(seen.iter().all(|(_, text)| is_size(text) || text == "camera left: half an image"), "{seen:?}");
    assert_eq!(camera.health().reconnects, 0);
}

#[test]
fn a_silent_camera_is_noticed_and_opened_again_and_its_thread_ends_when_it_can() {
    let script = script(&[Open::Camera(frames(3)), Open::Camera(frames(30))]);
    let mut camera = open(&script).unwrap();
    let error = std::iter::repeat_with(|| next(&mut camera)).find_map(Result::err).unwrap();
    assert_eq!(error.to_string(), "camera left: gave no frame for 500 ms; opening it again");
    assert_eq!((error.kind, camera.health().silences), (CaptureErrorKind::Disconnected, 1));
    next(&mut camera).unwrap();
    assert_eq!(camera.health().reconnects, 1);
    assert_eq!(script.open.load(Ordering::SeqCst), 2, "the old thread hangs in its driver");
    script.release(1);
    until("the old camera is closed", || script.open.load(Ordering::SeqCst) < 2);
}

#[test]
fn threads_do_not_pile_up_whatever_hangs() {
    let script = script(&[Open::Camera(frames(2)), Open::Hangs, Open::Camera(frames(30))]);
    let mut camera = open(&script).unwrap();
    let mut texts = Vec::new();
    while texts.len() < 3 {
        if let Err(error) = next(&mut camera) {
            texts.push(error.message);
        }
    }
    assert!(texts[0].ends_with("opening it again"), "{texts:?}");
    assert!(texts[1].contains("unplug it and plug it in again") && texts[1] == texts[2], "{texts:?}");
    assert_eq!((script.tried.load(Ordering::SeqCst), script.most_open.load(Ordering::SeqCst)), (2, 2));
    assert_eq!(camera.health().silences, 2);
    // Both return: the opening with an error, and it is tried again.
    script.release(2);
    until("it came back", || script.open.load(Ordering::SeqCst) == 0);
    while next(&mut camera).is_err() {}
    assert_eq!((camera.health().reconnects, script.most_open.load(Ordering::SeqCst)), (1, 2));
}

#[test]
fn openings_that_hang_do_not_pile_up_over_attempts() {
    let script = script(&[Open::Hangs, Open::Hangs, Open::Camera(frames(30))]);
    let texts: Vec<String> = (0..4).map(|_| open(&script).unwrap_err().to_string()).collect();
    assert!(texts[..2].iter().all(|text| text.contains("was not opened within 5 s")), "{texts:?}");
    assert!(texts[2..].iter().all(|text| text.contains("hangs in its driver since it was opened before")), "{texts:?}");
    assert_eq!((script.tried.load(Ordering::SeqCst), script.most_open.load(Ordering::SeqCst)), (2, 2));
    script.release(2);
    until("both return", || script.open.load(Ordering::SeqCst) == 0);
    let mut camera = loop {
        // The last of a thread is its word that it has ended.
        if let Ok(camera) = open(&script) {
            break camera;
        }
    };
    assert!(next(&mut camera).is_ok());
}

#[test]
fn panics_inside_end_the_opening_and_not_the_process() {
    let panicking = [Step::Frame, Step::Panics];
    let script = script(&[
        Open::Camera(panicking.to_vec()),
        Open::Panics,
        Open::Camera(vec![Step::PanicsTwice]),
        Open::Camera(vec![Step::Frame, Step::Fails]),
        Open::Camera(frames(30)),
    ]);
    let mut camera = open(&script).unwrap();
    let mut texts = Vec::new();
    while texts.len() < 4 {
        if let Err(error) = next(&mut camera) {
            assert!(error.kind.is_recoverable());
            texts.push(error.message);
        }
    }
    for (text, expected) in texts.iter().zip(["index out of bounds", "in open", "first", "no such device"]) {
        assert!(text.contains(expected), "{texts:?}");
    }
    assert!(next(&mut camera).is_ok());
    assert!(script.most_open.load(Ordering::SeqCst) <= 2);
}

#[test]
fn what_is_wrong_at_the_start_is_told_and_later_waited_for() {
    let error = open(&script(&[])).unwrap_err();
    assert_eq!((error.kind, error.to_string().as_str()), (CaptureErrorKind::NotFound, "camera left: not there"));
    assert!(open(&script(&[Open::Panics])).unwrap_err().message.contains("in open"));
    let gone = Open::Refused(CaptureErrorKind::NotFound);
    let script = script(&[Open::Camera(vec![Step::Frame, Step::Fails]), gone.clone(), gone, Open::Camera(frames(9))]);
    let mut camera = open(&script).unwrap();
    let kinds: Vec<_> = std::iter::repeat_with(|| next(&mut camera)).filter_map(Result::err).take(3).collect();
    let kinds: Vec<_> = kinds.iter().map(|error| error.kind).collect();
    // A camera that was there may come back.
    assert_eq!(kinds, [CaptureErrorKind::Io, CaptureErrorKind::Disconnected, CaptureErrorKind::Disconnected]);
    assert!(next(&mut camera).is_ok());
    assert_eq!(camera.health().reconnects, 1);
}

#[test]
fn a_silent_camera_does_not_touch_another() {
    let silent = script(&[Open::Camera(frames(1)), Open::Camera(Vec::new())]);
    let busy = script(&[Open::Camera(frames(20_000))]);
    let mut sources: Vec<Box<dyn CameraSource>> = vec![Box::new(open(&silent).unwrap())];
    // At half a frame per second it counts as silent after ten seconds: a machine may pause meanwhile.
    let other = Watched::open(&"right".into(), Expected { size: SIZE, fps: 0.5, lag_secs: 0.0 }, Arc::clone(&busy));
    sources.push(Box::new(other.unwrap()));
    let threads = crate::CaptureThreads::start(sources, crate::ThreadsConfig::default()).unwrap();
    let (mut right, mut at_silence) = (0, None);
    while at_silence.is_none_or(|at| right < at + 20) {
        let frame = threads.queue().pop(MINUTE).unwrap();
        right += u64::from(frame.camera.as_str() == "right");
        if threads.stats()[0].health.silences > 0 {
            at_silence.get_or_insert(right);
        }
    }
    assert!(threads.stats()[1].errors.is_empty());
    drop(threads);
    until("the other is closed", || busy.open.load(Ordering::SeqCst) == 0);
    silent.release(2);
    until("the silent one is closed", || silent.open.load(Ordering::SeqCst) == 0);
}
