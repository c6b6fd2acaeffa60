//! Stages behind a camera's thread: none blocks another thread, and an unusable frame is lost alone.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_capture::{
    CameraSource, CameraStats, CaptureError, CaptureErrorKind, CaptureThreads, Decoding, FrameStage, Pacing, PopError,
    ThreadsConfig,
};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

const LONG: Duration = Duration::from_secs(60);

/// Source that yields this many frames at once and counts those taken.
struct Fast {
    camera: CameraId,
    left: u64,
    taken: Arc<AtomicUsize>,
    image: fn(u64) -> Image,
}

impl Fast {
    fn boxed(camera: &str, frames: u64, taken: &Arc<AtomicUsize>, image: fn(u64) -> Image) -> Box<dyn CameraSource> {
        Box::new(Self { camera: camera.into(), left: frames, taken: Arc::clone(taken), image })
    }
}

impl CameraSource for Fast {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        if self.left == 0 {
            return Err(CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, "over"));
        }
        self.left -= 1;
        let sequence = self.taken.fetch_add(1, Ordering::SeqCst) as u64;
        Ok(Frame {
            camera: self.camera.clone(),
            sequence,
            capture_nanos: sequence as i64 * 10,
            exposure_nanos: Some(3),
            image: (self.image)(sequence),
            mask: None,
        })
    }
}

fn grey(_: u64) -> Image {
    Image::new(1, 1, PixelFormat::Gray8, vec![9]).unwrap()
}

/// Image that is truncated every third time.
fn sometimes_damaged(sequence: u64) -> Image {
    if sequence % 3 == 1 {
        return Image::new(2, 1, PixelFormat::Mjpeg, vec![0xff, 0xd8, 1]).unwrap();
    }
    Image::new(2, 1, PixelFormat::Yuyv, vec![235, 128, 16, 128]).unwrap()
}

/// Stage that passes frames on once the gate is open.
struct Gate(Arc<AtomicBool>);

impl FrameStage for Gate {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        while !self.0.load(Ordering::SeqCst) {
            std::thread::yield_now();
        }
        Ok(frame)
    }
}

struct Panics;

impl FrameStage for Panics {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        assert!(frame.sequence != 2, "scripted");
        Ok(frame)
    }
}

fn ended(threads: &CaptureThreads) -> Vec<CameraStats> {
    while threads.stats().iter().any(|stats| stats.running) {
        std::thread::yield_now();
    }
    threads.stats()
}

fn drain(threads: &CaptureThreads) -> Vec<Frame> {
    let mut frames = Vec::new();
    loop {
        match threads.queue().pop(LONG) {
            Ok(frame) => frames.push(frame),
            Err(PopError::Closed) => return frames,
            Err(PopError::Timeout) => panic!("the queue never closed"),
        }
    }
}

#[test]
fn a_stuck_decoder_holds_up_neither_its_camera_nor_another() {
    let (slow_taken, fast_taken) = (Arc::default(), Arc::default());
    let gate = Arc::new(AtomicBool::new(false));
    let sources = vec![Fast::boxed("slow", 50, &slow_taken, grey), Fast::boxed("fast", 50, &fast_taken, grey)];
    let of_stage = Arc::clone(&gate);
    let stage = move |camera: &CameraId| -> Box<dyn FrameStage> {
        let is_slow = camera.as_str() == "slow";
        Box::new(Gate(if is_slow { Arc::clone(&of_stage) } else { Arc::new(AtomicBool::new(true)) }))
    };
    let config = ThreadsConfig { queue_capacity: 200, pacing: Pacing::AsDelivered };
    let threads = CaptureThreads::start_staged(sources, stage, config).unwrap();
    // While nothing leaves the stuck stage, its camera's buffers are all emptied and the other camera is done.
    while slow_taken.load(Ordering::SeqCst) < 50 || threads.stats()[1].running {
        std::thread::yield_now();
    }
    assert_eq!(threads.stats()[0].frames, 0);
    gate.store(true, Ordering::SeqCst);
    let stats = ended(&threads);
    for stats in &stats {
        assert_eq!(stats.frames + stats.overtaken, 50, "{stats:?}");
    }
    assert!(stats[0].overtaken >= 47, "one in work and two waiting are not overtaken: {}", stats[0].overtaken);
    let slow: Vec<u64> =
        drain(&threads).iter().filter(|frame| frame.camera.as_str() == "slow").map(|frame| frame.sequence).collect();
    assert!(slow.ends_with(&[48, 49]), "the newest are kept: {slow:?}");
}

/// Recording with capture times a tenth of a second apart.
struct Tenths(Box<dyn CameraSource>);

impl CameraSource for Tenths {
    fn camera(&self) -> &CameraId {
        self.0.camera()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let frame = self.0.next_frame(timeout)?;
        Ok(Frame { capture_nanos: frame.sequence as i64 * 100_000_000, ..frame })
    }
}

#[test]
fn a_recording_played_as_live_does_not_overtake_itself() {
    let end = Instant::now() + LONG;
    loop {
        let begun = Instant::now();
        let sources = vec![Box::new(Tenths(Fast::boxed("a", 12, &Arc::default(), grey))) as Box<dyn CameraSource>];
        let config = ThreadsConfig { queue_capacity: 12, pacing: Pacing::RealTime };
        let threads = CaptureThreads::start_staged(sources, |_| Box::new(Decoding::new(None)), config).unwrap();
        let frames = drain(&threads).len();
        // A stage that the machine stops for a tenth of a second may lose one.
        if frames >= 9 {
            return;
        }
        // Where the machine has paused for longer it is played again.
        assert!(begun.elapsed() > Duration::from_millis(1300), "{frames} of 12 frames are left");
        assert!(Instant::now() < end, "{frames} of 12 frames are left of each attempt");
    }
}

#[test]
fn a_damaged_image_costs_its_own_frame() {
    let taken = Arc::default();
    let sources = vec![Fast::boxed("a", 9, &taken, sometimes_damaged)];
    let config = ThreadsConfig { queue_capacity: 1, pacing: Pacing::Lossless };
    let threads = CaptureThreads::start_staged(sources, |_| Box::new(Decoding::new(None)), config).unwrap();
    let frames = drain(&threads);
    assert_eq!(frames.iter().map(|frame| frame.sequence).collect::<Vec<_>>(), [0, 2, 3, 5, 6, 8]);
    for frame in &frames {
        assert_eq!((frame.image.format(), frame.image.bytes()), (PixelFormat::Rgb8, &[255, 255, 255, 0, 0, 0][..]));
        assert_eq!((frame.capture_nanos, frame.exposure_nanos), (frame.sequence as i64 * 10, Some(3)));
    }
    let stats = ended(&threads);
    assert_eq!(stats[0].errors[&CaptureErrorKind::Corrupt], 3);
    let text = stats[0].last_error.as_ref().unwrap().to_string();
    assert_eq!(text, "camera a: frame 7 is a JPEG image that is cut off");
}

#[test]
fn a_stage_that_panics_goes_on_with_the_next_frame() {
    let taken = Arc::default();
    let config = ThreadsConfig { queue_capacity: 10, pacing: Pacing::Lossless };
    let sources = vec![Fast::boxed("a", 5, &taken, grey)];
    let threads = CaptureThreads::start_staged(sources, |_| Box::new(Panics), config).unwrap();
    assert_eq!(drain(&threads).iter().map(|frame| frame.sequence).collect::<Vec<_>>(), [0, 1, 3, 4]);
    assert_eq!(ended(&threads)[0].errors[&CaptureErrorKind::Corrupt], 1);
}

#[test]
fn stages_keep_the_order_of_capture_where_nothing_may_be_lost() {
    for capacity in [1, 50] {
        let (a, b) = (Arc::default(), Arc::default());
        let sources = vec![Fast::boxed("a", 100, &a, grey), Fast::boxed("b", 100, &b, grey)];
        let config = ThreadsConfig { queue_capacity: capacity, pacing: Pacing::Lossless };
        let threads = CaptureThreads::start_staged(sources, |_| Box::new(Decoding::new(None)), config).unwrap();
        let frames = drain(&threads);
        assert_eq!(frames.len(), 200);
        assert!(frames.is_sorted_by_key(|frame| (frame.capture_nanos, frame.camera.clone())));
        assert_eq!(ended(&threads).iter().map(|stats| stats.overtaken).sum::<u64>(), 0);
    }
}

#[test]
fn dropping_frees_stages_that_wait() {
    let taken = Arc::new(AtomicUsize::new(0));
    let config = ThreadsConfig { queue_capacity: 1, pacing: Pacing::Lossless };
    let sources = vec![Fast::boxed("a", 1000, &taken, grey)];
    let threads = CaptureThreads::start_staged(sources, |_| Box::new(Decoding::new(None)), config).unwrap();
    assert!(threads.queue().pop(LONG).is_ok());
    // Source, stage and queue are all full now or soon; nobody takes anything any more.
    drop(threads);
    assert!(taken.load(Ordering::SeqCst) < 1000);
}
