//! Capture threads: order, back-pressure, counts, and failing cameras.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use flyrig_capture::{
    CameraSource, CameraStats, CaptureError, CaptureErrorKind, CaptureThreads, Pacing, PopError, ThreadsConfig,
};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

const LONG: Duration = Duration::from_secs(60);

enum Step {
    At(i64),
    Fail(CaptureErrorKind),
    Panic,
    /// Returns `Timeout` until the flag is set.
    Until(Arc<AtomicBool>),
}

struct Script {
    camera: CameraId,
    steps: VecDeque<Step>,
    sequence: u64,
    dropped: Option<Arc<AtomicBool>>,
}

impl Script {
    fn new(camera: &str, steps: impl IntoIterator<Item = Step>) -> Self {
        Self { camera: camera.into(), steps: steps.into_iter().collect(), sequence: 0, dropped: None }
    }
}

impl Drop for Script {
    fn drop(&mut self) {
        if let Some(dropped) = &self.dropped {
            dropped.store(true, Ordering::SeqCst);
        }
    }
}

impl CameraSource for Script {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        let fail = |kind| Err(CaptureError::new(&self.camera, kind, "scripted"));
        let capture_nanos = match self.steps.pop_front() {
            None => return fail(CaptureErrorKind::EndOfStream),
            Some(Step::Fail(kind)) => return fail(kind),
            Some(Step::Panic) => panic!("scripted panic"),
            Some(Step::Until(flag)) => {
                if !flag.load(Ordering::SeqCst) {
                    self.steps.push_front(Step::Until(flag));
                }
                std::thread::yield_now();
                return fail(CaptureErrorKind::Timeout);
            }
            Some(Step::At(nanos)) => nanos,
        };
        self.sequence += 1;
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: self.sequence - 1,
            capture_nanos,
            exposure_nanos: None,
            image: Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap(),
            mask: None,
        })
    }
}

fn start(scripts: Vec<Script>, pacing: Pacing, queue_capacity: usize) -> CaptureThreads {
    let sources = scripts.into_iter().map(|script| Box::new(script) as Box<dyn CameraSource>).collect();
    CaptureThreads::start(sources, ThreadsConfig { queue_capacity, pacing }).unwrap()
}

fn drain(threads: &CaptureThreads) -> Vec<(String, i64)> {
    let mut frames = Vec::new();
    loop {
        match threads.queue().pop(LONG) {
            Ok(frame) => frames.push((frame.camera.to_string(), frame.capture_nanos)),
            Err(PopError::Closed) => return frames,
            Err(PopError::Timeout) => panic!("the queue never closed"),
        }
    }
}

fn ended(threads: &CaptureThreads) -> Vec<CameraStats> {
    while threads.stats().iter().any(|stats| stats.running) {
        std::thread::yield_now();
    }
    threads.stats()
}

#[test]
fn lossless_gives_every_frame_in_the_order_of_capture() {
    for capacity in [1, 3, 100] {
        let times = |phase: i64, step: i64| (0..200).map(move |i| Step::At(i * step + phase));
        let scripts = vec![
            Script::new("a", times(0, 30)),
            Script::new("b", times(0, 30)),
            // A camera at half the rate, with damaged frames in between.
            Script::new("c", (0..100).flat_map(|i| [Step::Fail(CaptureErrorKind::Corrupt), Step::At(i * 60 + 7)])),
        ];
        let threads = start(scripts, Pacing::Lossless, capacity);
        let frames = drain(&threads);
        assert_eq!(frames.len(), 500);
        let keys: Vec<(i64, &String)> = frames.iter().map(|(camera, nanos)| (*nanos, camera)).collect();
        assert!(keys.is_sorted());
        let stats = ended(&threads);
        assert_eq!(stats.iter().map(|s| (s.frames, s.dropped)).collect::<Vec<_>>(), [(200, 0), (200, 0), (100, 0)]);
        assert_eq!(stats[2].errors[&CaptureErrorKind::Corrupt], 100);
        assert_eq!(threads.queue().dropped(), 0);
    }
}

#[test]
fn a_live_queue_drops_the_oldest_and_counts_it_for_its_camera() {
    let threads = start(vec![Script::new("a", (0..50).map(Step::At))], Pacing::AsDelivered, 4);
    let stats = ended(&threads);
    assert_eq!((stats[0].frames, stats[0].dropped, threads.queue().dropped()), (50, 46, 46));
    assert_eq!(drain(&threads).into_iter().map(|(_, nanos)| nanos).collect::<Vec<_>>(), [46, 47, 48, 49]);
}

#[test]
fn replay_in_real_time_takes_the_time_of_the_recording() {
    let step = 20_000_000;
    let begin = std::time::Instant::now();
    let threads =
        start(vec![Script::new("a", (0..6).map(|i| Step::At(i64::MAX - (6 - i) * step)))], Pacing::RealTime, 100);
    assert_eq!(drain(&threads).len(), 6);
    // Only a lower bound: the machine may be slow, but the replay never fast.
    assert!(begin.elapsed() >= Duration::from_nanos(5 * step as u64));
}

#[test]
fn errors_that_may_pass_are_survived_and_counted_by_kind() {
    use CaptureErrorKind::{Corrupt, Disconnected, Io, NotFound, Timeout, Unsupported};
    let passing = [Timeout, Corrupt, Disconnected, Corrupt, Io].map(Step::Fail);
    let scripts = vec![
        Script::new("a", passing.into_iter().chain([Step::At(1)])),
        Script::new("b", [Step::At(2), Step::Fail(Unsupported), Step::At(3)]),
        Script::new("c", [Step::Fail(NotFound), Step::At(4)]),
    ];
    let threads = start(scripts, Pacing::AsDelivered, 10);
    let mut frames = drain(&threads);
    frames.sort();
    assert_eq!(frames, [("a".to_owned(), 1), ("b".to_owned(), 2)], "nothing after a final error");
    let stats = ended(&threads);
    let counts: Vec<_> = stats[0].errors.iter().map(|(kind, count)| (*kind, *count)).collect();
    assert_eq!(counts, [(Disconnected, 1), (Corrupt, 2), (Io, 1)], "no frame yet is no error");
    assert_eq!(stats[1].last_error.as_ref().unwrap().to_string(), "camera b: scripted");
}

#[test]
fn a_panicking_source_ends_its_own_camera_only() {
    for pacing in [Pacing::AsDelivered, Pacing::Lossless] {
        let scripts = vec![
            Script::new("bad", [Step::At(0), Step::Panic, Step::At(1)]),
            Script::new("good", (0..5).map(Step::At)),
        ];
        let threads = start(scripts, pacing, 100);
        assert_eq!(drain(&threads).len(), 6);
        let stats = ended(&threads);
        assert_eq!(stats[0].errors[&CaptureErrorKind::Disconnected], 1);
        let text = stats[0].last_error.as_ref().unwrap().to_string();
        assert_eq!(text, "camera bad: its source failed inside: scripted panic; restart to use it again");
        assert!(stats[1].errors.is_empty());
    }
}

#[test]
fn dropping_stops_threads_that_wait_for_anything() {
    let dropped: Vec<Arc<AtomicBool>> = (0..4).map(|_| Arc::default()).collect();
    let flagged = |mut script: Script, i: usize| {
        script.dropped = Some(Arc::clone(&dropped[i]));
        script
    };
    // On a full queue and for its turn.
    let blocked = vec![
        flagged(Script::new("a", (0..50).map(Step::At)), 0),
        flagged(Script::new("b", [Step::Until(Arc::default())]), 1),
    ];
    let lossless = start(blocked, Pacing::Lossless, 1);
    // For a frame that is due in an hour, and for a camera that is gone.
    let sleeping = vec![
        flagged(Script::new("a", [Step::At(0), Step::At(3_600_000_000_000)]), 2),
        flagged(Script::new("b", (0..1000).map(|_| Step::Fail(CaptureErrorKind::Disconnected))), 3),
    ];
    let real_time = start(sleeping, Pacing::RealTime, 1);
    assert!(real_time.queue().pop(LONG).is_ok());
    let queue = Arc::clone(lossless.queue());
    drop((lossless, real_time));
    assert!(dropped.iter().all(|flag| flag.load(Ordering::SeqCst)), "every source is let go");
    assert!(queue.is_closed());
}

#[test]
fn names_must_differ_and_no_camera_is_no_wait() {
    let twice: Vec<Box<dyn CameraSource>> = vec![Box::new(Script::new("a", [])), Box::new(Script::new("a", []))];
    let error = CaptureThreads::start(twice, ThreadsConfig::default()).unwrap_err();
    assert_eq!(error.to_string(), "camera a: is given twice; every source needs a name of its own");
    assert!(drain(&start(Vec::new(), Pacing::Lossless, 1)).is_empty());
}
