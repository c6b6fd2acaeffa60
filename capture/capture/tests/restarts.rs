//! Cameras that are missing, hang, panic and come back, and what the rig around them does meanwhile.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::{
    collections::VecDeque,
    sync::{
        Arc, Condvar, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc,
    },
    thread::Builder,
    time::{Duration, Instant},
};

use flyrig_capture::{
    CameraSource, CameraStats, CaptureError, CaptureErrorKind, CaptureThreads, FrameStage, Pacing, PopError,
    SourceHealth, SourceOpener, ThreadsConfig,
};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

const MINUTE: Duration = Duration::from_secs(60);

/// Holds calls up until it is opened.
#[derive(Default)]
struct Gate(Mutex<bool>, Condvar);

impl Gate {
    fn pass(&self) {
        let mut is_open = self.0.lock().unwrap();
        while !*is_open {
            is_open = self.1.wait(is_open).unwrap();
        }
    }

    fn open(&self) {
        *self.0.lock().unwrap() = true;
        self.1.notify_all();
    }
}

#[derive(Clone)]
enum Step {
    Frame,
    Fail(CaptureErrorKind),
    Panic,
    /// Panics, and once more when it is dropped for that.
    PanicTwice,
    /// Does not return before the gate is open.
    Hang(Arc<Gate>),
    /// Gives the frame before once more.
    Again,
}

struct Script {
    camera: CameraId,
    steps: VecDeque<Step>,
    /// What comes when the steps are over.
    then: Step,
    sequence: u64,
    panics_in_drop: bool,
}

fn source(camera: &str, steps: impl IntoIterator<Item = Step>, then: Step) -> Box<dyn CameraSource> {
    let steps = steps.into_iter().collect();
    Box::new(Script { camera: camera.into(), steps, then, sequence: 0, panics_in_drop: false })
}

impl CameraSource for Script {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        match self.steps.pop_front().unwrap_or_else(|| self.then.clone()) {
            Step::Frame => self.sequence += 1,
            Step::Again => {}
            Step::Fail(kind) => return Err(CaptureError::new(&self.camera, kind, "scripted")),
            Step::Panic => panic!("scripted panic"),
            Step::PanicTwice => {
                self.panics_in_drop = true;
                panic!("first panic");
            }
            Step::Hang(gate) => {
                gate.pass();
                return Err(CaptureError::new(&self.camera, CaptureErrorKind::Timeout, "late"));
            }
        }
        // A camera of a thousand frames a second.
        std::thread::sleep(Duration::from_millis(1));
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: self.sequence.saturating_sub(1),
            capture_nanos: self.sequence as i64,
            exposure_nanos: None,
            image: Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap(),
            mask: None,
        })
    }

    fn health(&self) -> SourceHealth {
        SourceHealth { lost_by_driver: self.sequence, ..SourceHealth::default() }
    }
}

impl Drop for Script {
    fn drop(&mut self) {
        assert!(!self.panics_in_drop, "second panic");
    }
}

fn frames(count: usize) -> Vec<Step> {
    vec![Step::Frame; count]
}

fn live(queue_capacity: usize) -> ThreadsConfig {
    ThreadsConfig { queue_capacity, pacing: Pacing::AsDelivered }
}

/// A camera that works.
fn healthy(camera: &str) -> SourceOpener {
    let name = camera.to_owned();
    SourceOpener::new(&camera.into(), move || Ok(source(&name, [], Step::Frame)))
}

fn stats(threads: &CaptureThreads, camera: &str) -> CameraStats {
    threads.stats().into_iter().find(|stats| stats.camera.as_str() == camera).unwrap()
}

/// Waits until the counts of a camera are so.
fn until(threads: &CaptureThreads, camera: &str, what: &str, is_so: impl Fn(&CameraStats) -> bool) -> CameraStats {
    let start = Instant::now();
    loop {
        let stats = stats(threads, camera);
        if is_so(&stats) {
            return stats;
        }
        assert!(start.elapsed() < MINUTE, "{what}: {stats:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Waits until the next frame of a camera that was captured now.
fn flows(threads: &CaptureThreads, camera: &str) {
    let before = stats(threads, camera).frames;
    until(threads, camera, "it gives frames", |stats| stats.frames > before + 10);
}

/// Drops the threads; fails where that takes for ever.
fn dropped(threads: CaptureThreads) -> Duration {
    let (done, is_done) = mpsc::sync_channel(1);
    let start = Instant::now();
    let thread = Builder::new().name("dropping".into()).spawn(move || {
        drop(threads);
        done.send(()).unwrap();
    });
    is_done.recv_timeout(MINUTE).unwrap_or_else(|_| panic!("dropping hangs"));
    thread.unwrap().join().unwrap();
    start.elapsed()
}

#[test]
fn a_camera_that_is_missing_at_the_start_joins_when_it_comes() {
    let is_there = Arc::new(AtomicBool::new(false));
    let (seen, tried) = (Arc::clone(&is_there), Arc::new(AtomicU64::new(0)));
    let counted = Arc::clone(&tried);
    let missing = SourceOpener::new(&"late".into(), move || {
        counted.fetch_add(1, Ordering::SeqCst);
        if seen.load(Ordering::SeqCst) {
            return Ok(source("late", [], Step::Frame));
        }
        Err(CaptureError::general(CaptureErrorKind::NotFound, "is not plugged in"))
    });
    let threads = CaptureThreads::start_opening(vec![missing, healthy("good")], live(8)).unwrap();
    flows(&threads, "good");
    let waiting = until(&threads, "late", "it is tried again", |stats| {
        stats.errors.get(&CaptureErrorKind::NotFound).is_some_and(|count| *count >= 2)
    });
    assert!(waiting.running && !waiting.opened && waiting.frames == 0, "{waiting:?}");
    assert_eq!(waiting.last_error.unwrap().to_string(), "camera late: is not plugged in");
    assert!(!threads.queue().is_closed());
    is_there.store(true, Ordering::SeqCst);
    flows(&threads, "late");
    let joined = stats(&threads, "late");
    assert!(joined.opened && joined.restarts == 0, "{joined:?}");
    dropped(threads);
}

#[test]
fn an_opening_that_hangs_holds_up_neither_the_others_nor_the_end() {
    let gate = Arc::new(Gate::default());
    let (of_opener, calls) = (Arc::clone(&gate), Arc::new(AtomicU64::new(0)));
    let counted = Arc::clone(&calls);
    let hanging = SourceOpener::new(&"hangs".into(), move || {
        counted.fetch_add(1, Ordering::SeqCst);
        of_opener.pass();
        Ok(source("hangs", [], Step::Frame))
    });
    let threads = CaptureThreads::start_opening(vec![hanging, healthy("good")], live(8)).unwrap();
    flows(&threads, "good");
    let late = until(&threads, "hangs", "it is reported", |stats| stats.last_error.is_some());
    assert!(late.running && !late.opened, "{late:?}");
    let text = late.last_error.unwrap().to_string();
    assert!(text.starts_with("camera hangs: was not opened within 5 s"), "{text}");
    assert_eq!(threads.stuck(Duration::from_secs(4)), ["open hangs"]);
    flows(&threads, "good");
    dropped(threads);
    assert_eq!(calls.load(Ordering::SeqCst), 1, "no second thread went into the driver");
    gate.open();
}

#[test]
fn an_opening_that_takes_long_is_waited_for() {
    let gate = Arc::new(Gate::default());
    let of_opener = Arc::clone(&gate);
    let slow = SourceOpener::new(&"slow".into(), move || {
        of_opener.pass();
        Ok(source("slow", [], Step::Frame))
    });
    let threads = CaptureThreads::start_opening(vec![slow], live(8)).unwrap();
    until(&threads, "slow", "it is reported", |stats| stats.last_error.is_some());
    gate.open();
    flows(&threads, "slow");
    dropped(threads);
}

#[test]
fn an_opener_that_panics_or_gives_another_camera_is_tried_again() {
    let mut calls = 0;
    let opener = SourceOpener::new(&"a".into(), move || {
        calls += 1;
        match calls {
            1 => panic!("in the opener"),
            2 => Ok(source("b", [Step::Frame], Step::Frame)),
            3 => Err(CaptureError::general(CaptureErrorKind::Unsupported, "another format")),
            _ => Ok(source("a", [], Step::Frame)),
        }
    });
    let threads = CaptureThreads::start_opening(vec![opener], live(8)).unwrap();
    flows(&threads, "a");
    let stats = stats(&threads, "a");
    let counts: Vec<_> = stats.errors.iter().map(|(kind, count)| (*kind, *count)).collect();
    assert_eq!(counts, [(CaptureErrorKind::Disconnected, 1), (CaptureErrorKind::Unsupported, 2)]);
    assert_eq!(stats.last_error.unwrap().to_string(), "camera a: another format");
    dropped(threads);
}

#[test]
fn a_source_that_panics_is_opened_anew_up_to_a_cap() {
    for bad in [Step::Panic, Step::PanicTwice, Step::Fail(CaptureErrorKind::Unsupported)] {
        let calls = Arc::new(AtomicU64::new(0));
        let (counted, step) = (Arc::clone(&calls), bad.clone());
        let opener = SourceOpener::new(&"bad".into(), move || {
            counted.fetch_add(1, Ordering::SeqCst);
            Ok(source("bad", frames(3), step.clone()))
        });
        let threads = CaptureThreads::start_opening(vec![opener, healthy("good")], live(10_000)).unwrap();
        until(&threads, "bad", "it is opened again", |stats| stats.restarts == 5);
        let capped = until(&threads, "bad", "the last one fails", |stats| stats.errors.values().sum::<u64>() == 6);
        flows(&threads, "good");
        std::thread::sleep(Duration::from_millis(500));
        // The next one comes in a minute.
        assert_eq!((calls.load(Ordering::SeqCst), stats(&threads, "bad").restarts), (6, 5));
        assert!(capped.running && !stats(&threads, "bad").opened, "{capped:?}");
        assert_eq!((capped.frames, capped.health.lost_by_driver), (18, 18), "counts go on");
        if !matches!(bad, Step::Fail(_)) {
            let text = capped.last_error.unwrap().to_string();
            assert!(text.starts_with("camera bad: its source failed inside: "), "{text}");
            assert!(text.ends_with("panic; opening it again"), "{text}");
        }
        assert!(threads.stuck(Duration::from_secs(5)).is_empty(), "a pause is not a hang");
        let queue = Arc::clone(threads.queue());
        dropped(threads);
        let numbers = std::iter::from_fn(|| queue.pop(Duration::ZERO).ok());
        let numbers: Vec<u64> =
            numbers.filter(|frame| frame.camera.as_str() == "bad").map(|frame| frame.sequence).collect();
        assert_eq!(numbers, (0..18).collect::<Vec<_>>(), "sequence numbers go on");
    }
}

#[test]
fn a_source_that_may_come_back_by_itself_is_left_alone() {
    let calls = Arc::new(AtomicU64::new(0));
    let counted = Arc::clone(&calls);
    let passing = [CaptureErrorKind::Disconnected, CaptureErrorKind::Io, CaptureErrorKind::Corrupt].map(Step::Fail);
    let opener = SourceOpener::new(&"a".into(), move || {
        counted.fetch_add(1, Ordering::SeqCst);
        Ok(source("a", passing.clone(), Step::Frame))
    });
    let threads = CaptureThreads::start_opening(vec![opener], live(8)).unwrap();
    flows(&threads, "a");
    assert_eq!((calls.load(Ordering::SeqCst), stats(&threads, "a").restarts), (1, 0));
    dropped(threads);
    // The end of a recording is the end.
    let over = SourceOpener::new(&"a".into(), || Ok(source("a", frames(2), Step::Fail(CaptureErrorKind::EndOfStream))));
    let threads = CaptureThreads::start_opening(vec![over], live(8)).unwrap();
    let ended = until(&threads, "a", "it ends", |stats| !stats.running);
    assert_eq!((ended.frames, ended.restarts, ended.opened), (2, 0, false));
    assert!(threads.queue().is_closed());
}

/// Panics at its third frame.
struct Fragile(u64);

impl FrameStage for Fragile {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        self.0 += 1;
        assert!(self.0 < 3, "scripted stage");
        Ok(frame)
    }
}

#[test]
fn a_stage_that_panics_is_made_anew() {
    let made = Arc::new(AtomicU64::new(0));
    let counted = Arc::clone(&made);
    let stage = move |_: &CameraId| {
        counted.fetch_add(1, Ordering::SeqCst);
        Box::new(Fragile(0)) as Box<dyn FrameStage>
    };
    // Without loss, so that the count is exact: two of three frames pass.
    let opener =
        SourceOpener::new(&"a".into(), || Ok(source("a", frames(10), Step::Fail(CaptureErrorKind::EndOfStream))));
    let config = ThreadsConfig { queue_capacity: 20, pacing: Pacing::Lossless };
    let threads = CaptureThreads::start_opening_staged(vec![opener], stage, config).unwrap();
    let ended = until(&threads, "a", "it ends", |stats| !stats.running);
    assert_eq!((ended.frames, ended.stage_restarts, ended.restarts), (7, 3, 0));
    assert_eq!((ended.errors[&CaptureErrorKind::Corrupt], made.load(Ordering::SeqCst)), (3, 4));
    let text = ended.last_error.unwrap().to_string();
    assert_eq!(text, "camera a: frame 8 made the decoder fail inside: scripted stage");
    // One that cannot be made again is used on.
    let first = AtomicBool::new(true);
    let stage = move |_: &CameraId| {
        assert!(first.swap(false, Ordering::SeqCst), "no second one");
        Box::new(Fragile(0)) as Box<dyn FrameStage>
    };
    let opener = SourceOpener::ready(source("a", frames(5), Step::Fail(CaptureErrorKind::EndOfStream)));
    let threads = CaptureThreads::start_opening_staged(vec![opener], stage, config).unwrap();
    let ended = until(&threads, "a", "it ends", |stats| !stats.running);
    assert_eq!((ended.frames, ended.stage_restarts, ended.errors[&CaptureErrorKind::Corrupt]), (2, 0, 3));
}

/// Hangs with the frames of one camera.
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

#[test]
fn what_is_read_without_loss_is_opened_first_and_never_anew() {
    let config = |pacing| ThreadsConfig { queue_capacity: 1000, pacing };
    for pacing in [Pacing::Lossless, Pacing::RealTime] {
        let missing = SourceOpener::new(&"gone".into(), || {
            Err(CaptureError::general(CaptureErrorKind::NotFound, "no such file"))
        });
        let error = CaptureThreads::start_opening(vec![healthy("a"), missing], config(pacing)).unwrap_err();
        assert_eq!(error.to_string(), "camera gone: no such file");
        let panics = SourceOpener::new(&"a".into(), || panic!("no header"));
        let error = CaptureThreads::start_opening(vec![panics], config(pacing)).unwrap_err();
        assert_eq!(error.to_string(), "camera a: opening it failed inside: no header");
        let recording = |camera: &'static str, end: Step| {
            SourceOpener::new(&camera.into(), move || Ok(source(camera, frames(5), end.clone())))
        };
        let openers = vec![recording("a", Step::Panic), recording("b", Step::Fail(CaptureErrorKind::EndOfStream))];
        let threads = CaptureThreads::start_opening(openers, config(pacing)).unwrap();
        let mut order = Vec::new();
        let end = loop {
            match threads.queue().pop(MINUTE) {
                Ok(frame) => order.push((frame.capture_nanos, frame.camera.to_string())),
                Err(end) => break end,
            }
        };
        assert_eq!((end, order.len()), (PopError::Closed, 10));
        assert!(order.is_sorted() || pacing == Pacing::RealTime, "{order:?}");
        assert_eq!(stats(&threads, "a").restarts, 0);
    }
}

/// A generator of small numbers (splitmix64).
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (x ^ (x >> 31)) % end
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

/// Fails, panics and hangs now and then.
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
        let mut random = Random(seed);
        let (gate, in_opener) = (Arc::new(Gate::default()), Arc::new(Gate::default()));
        let openers = (0..3).map(|camera| {
            let name = camera.to_string();
            let (gate, in_opener) = (Arc::clone(&gate), Arc::clone(&in_opener));
            let mut random = Random(seed * 100 + camera);
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
            Box::new(Moody(Random(seed), Arc::clone(&of_stage))) as Box<dyn FrameStage>
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

/// A camera of a thousand frames a second that gives none for a while, and knows the time all the same.
struct Silent {
    camera: CameraId,
    next: i64,
    silent: std::ops::Range<i64>,
    end: i64,
}

impl CameraSource for Silent {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        let now = self.next;
        self.next += 1;
        if now >= self.end {
            return Err(CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, "over"));
        }
        if self.silent.contains(&now) {
            return Err(CaptureError::new(&self.camera, CaptureErrorKind::Timeout, "silent"));
        }
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: now as u64,
            capture_nanos: now,
            exposure_nanos: None,
            image: Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap(),
            mask: None,
        })
    }

    fn next_nanos(&self) -> Option<i64> {
        Some(self.next)
    }
}

#[test]
fn what_is_read_without_loss_goes_on_while_one_camera_is_silent() {
    let silent = |camera: &str, silent: std::ops::Range<i64>| {
        SourceOpener::ready(
            Box::new(Silent { camera: camera.into(), next: 0, silent, end: 2000 }) as Box<dyn CameraSource>
        )
    };
    // For ever, for a while, at the start, and never; all at once in between.
    let openers = vec![
        silent("a", 20..2000),
        silent("b", 10..1500),
        silent("c", 0..100),
        silent("d", 900..1100),
        silent("e", 0..0),
    ];
    let config = ThreadsConfig { queue_capacity: 3, pacing: Pacing::Lossless };
    let threads = CaptureThreads::start_opening(openers, config).unwrap();
    let mut found = Vec::new();
    while let Ok(frame) = threads.queue().pop(MINUTE) {
        found.push((frame.capture_nanos, frame.camera.to_string()));
    }
    let count = |camera: &str| found.iter().filter(|(_, of)| of == camera).count();
    assert_eq!(["a", "b", "c", "d", "e"].map(count), [20, 510, 1900, 1800, 2000]);
    assert!(found.is_sorted(), "frames are in order, and by slot at equal times");
    dropped(threads);
}
