//! Threads that hang are named, and the end comes whatever cameras do.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod scripted;

use std::{
    sync::Arc,
    thread::Builder,
    time::{Duration, Instant},
};

use flyrig_capture::{
    CameraSource, CaptureError, CaptureErrorKind, CaptureThreads, FrameStage, Pacing, PopError, SourceOpener,
    ThreadsConfig,
};
use flyrig_model::SplitMix64;
use flyrig_types::{CameraId, Frame};
use scripted::{Gate, MINUTE, Step, dropped, flows, frames, healthy, live, source};

/// Stage that hangs with the frames of one camera.
struct Hanging(Option<Arc<Gate>>);

impl FrameStage for Hanging {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        if let Some(gate) = &self.0 {
            gate.pass();
        }
        Ok(frame)
    }
}

#[test]
fn threads_that_are_stuck_are_named() {
    let gate = Arc::new(Gate::default());
    let (of_source, of_stage) = (Arc::clone(&gate), Arc::clone(&gate));
    let hanging = SourceOpener::ready(source("03", frames(2), Step::Hang(of_source)));
    let stage = move |camera: &CameraId| {
        Box::new(Hanging((camera.as_str() == "04").then(|| Arc::clone(&of_stage)))) as Box<dyn FrameStage>
    };
    let openers = vec![hanging, healthy("04"), healthy("05")];
    let threads = CaptureThreads::start_opening_staged(openers, stage, live(8)).unwrap();
    let start = Instant::now();
    let expected = ["camera 03", "stage 04"];
    while threads.stuck(Duration::from_secs(2)) != expected {
        assert!(start.elapsed() < MINUTE, "{:?}", threads.activity());
        std::thread::sleep(Duration::from_millis(20));
    }
    flows(&threads, "05");
    let names: Vec<String> = threads.activity().into_iter().map(|(name, _)| name).collect();
    assert_eq!(names, ["camera 03", "stage 03", "camera 04", "stage 04", "camera 05", "stage 05"]);
    gate.open();
    while !threads.stuck(Duration::from_secs(2)).is_empty() {
        assert!(start.elapsed() < MINUTE, "{:?}", threads.activity());
        std::thread::sleep(Duration::from_millis(20));
    }
    dropped(threads);
}

#[test]
fn whoever_waits_for_a_slow_reader_is_not_stuck() {
    let opener = || SourceOpener::ready(source("a", [], Step::Frame));
    let config = ThreadsConfig { queue_capacity: 1, pacing: Pacing::Lossless };
    let stage = |_: &CameraId| Box::new(Hanging(None)) as Box<dyn FrameStage>;
    for threads in [
        CaptureThreads::start_opening(vec![opener()], config).unwrap(),
        CaptureThreads::start_opening_staged(vec![opener()], stage, config).unwrap(),
    ] {
        let start = Instant::now();
        while !threads.activity().is_empty() {
            assert!(start.elapsed() < MINUTE, "{:?}", threads.activity());
            std::thread::sleep(Duration::from_millis(5));
        }
        assert!(threads.queue().pop(MINUTE).is_ok());
        dropped(threads);
    }
}

#[test]
fn the_end_leaves_behind_what_hangs_in_a_driver() {
    let gate = Arc::new(Gate::default());
    let hanging = SourceOpener::ready(source("hangs", [], Step::Hang(Arc::clone(&gate))));
    let threads = CaptureThreads::start_opening(vec![hanging, healthy("good")], live(8)).unwrap();
    flows(&threads, "good");
    assert!(dropped(threads) >= Duration::from_secs(15), "it is given time");
    gate.open();
}

/// Generator of small numbers (SplitMix64).
struct Random(SplitMix64);

impl Random {
    fn new(seed: u64) -> Self {
        Self(SplitMix64(seed))
    }

    fn below(&mut self, end: u64) -> u64 {
        self.0.below(end)
    }

    fn step(&mut self, gate: &Arc<Gate>) -> Step {
        use CaptureErrorKind::{Corrupt, Disconnected, EndOfStream, Io, NotFound, Timeout, Unsupported};
        match self.below(40) {
            0 => Step::Panic,
            1 => Step::PanicTwice,
            2 => Step::Hang(Arc::clone(gate)),
            3..=6 => Step::Again,
            n @ 7..=13 => {
                let kinds = [Corrupt, Disconnected, EndOfStream, Io, NotFound, Timeout, Unsupported];
                Step::Fail(kinds[n as usize - 7])
            }
            _ => Step::Frame,
        }
    }
}

/// Stage that fails, panics and hangs at random.
struct Moody(Random, Arc<Gate>);

impl FrameStage for Moody {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        match self.0.below(30) {
            0 => panic!("moody stage"),
            1 => self.1.pass(),
            2 => return Err(CaptureError::general(CaptureErrorKind::Corrupt, "moody")),
            _ => {}
        }
        Ok(frame)
    }
}

#[test]
fn whatever_cameras_do_the_end_comes() {
    for seed in 0..40 {
        let mut random = Random::new(seed);
        let (gate, in_opener) = (Arc::new(Gate::default()), Arc::new(Gate::default()));
        let openers = (0..3).map(|camera| {
            let name = camera.to_string();
            let (gate, in_opener) = (Arc::clone(&gate), Arc::clone(&in_opener));
            let mut random = Random::new(seed * 100 + camera);
            let is_ready = random.below(3) == 0;
            let mut open = move || -> Result<Box<dyn CameraSource>, CaptureError> {
                match random.below(if is_ready { 1 } else { 8 }) {
                    5 => return Err(CaptureError::general(CaptureErrorKind::NotFound, "scripted")),
                    6 => panic!("scripted opener"),
                    7 => in_opener.pass(),
                    _ => {}
                }
                let steps: Vec<Step> = (0..random.below(60)).map(|_| random.step(&gate)).collect();
                Ok(source(&name, steps, Step::Frame))
            };
            if is_ready {
                SourceOpener::ready(open().unwrap())
            } else {
                SourceOpener::new(&camera.to_string().into(), open)
            }
        });
        let openers: Vec<SourceOpener> = openers.collect();
        // Sources that are opened first may not hang in that.
        let pacing =
            [Pacing::AsDelivered, Pacing::AsDelivered, Pacing::RealTime, Pacing::Lossless][random.below(4) as usize];
        if pacing != Pacing::AsDelivered {
            in_opener.open();
        }
        let config = ThreadsConfig { queue_capacity: 1 + random.below(6) as usize, pacing };
        let of_stage = Arc::clone(&gate);
        let stage = move |camera: &CameraId| {
            let seed = camera.as_str().len() as u64 + seed;
            Box::new(Moody(Random::new(seed), Arc::clone(&of_stage))) as Box<dyn FrameStage>
        };
        let threads = if random.below(2) == 0 {
            CaptureThreads::start_opening_staged(openers, stage, config)
        } else {
            CaptureThreads::start_opening(openers, config)
        };
        let Ok(threads) = threads else { continue };
        let queue = Arc::clone(threads.queue());
        let end = Instant::now() + Duration::from_millis(random.below(150));
        while Instant::now() < end && !matches!(queue.pop(Duration::from_millis(5)), Err(PopError::Closed)) {}
        // What hangs comes back while the threads are dropped, or, in an opener, never before the end.
        let later = Arc::clone(&gate);
        let releasing = Builder::new().name("releasing".into()).spawn(move || {
            std::thread::sleep(Duration::from_millis(20));
            later.open();
        });
        assert!(dropped(threads) < Duration::from_secs(14), "seed {seed}: a thread was left behind");
        releasing.unwrap().join().unwrap();
        in_opener.open();
        assert!(queue.is_closed(), "seed {seed}");
    }
}
