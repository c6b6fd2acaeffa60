//! Scripted cameras for tests of the capture threads.

#![allow(dead_code, clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, mpsc},
    thread::Builder,
    time::{Duration, Instant},
};

use flyrig_capture::{
    CameraSource, CameraStats, CaptureError, CaptureErrorKind, CaptureThreads, Pacing, SourceHealth, SourceOpener,
    ThreadsConfig,
};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

pub const MINUTE: Duration = Duration::from_secs(60);

/// Blocks every call until it is opened.
#[derive(Default)]
pub struct Gate(Mutex<bool>, Condvar);

impl Gate {
    pub fn pass(&self) {
        let mut is_open = self.0.lock().unwrap();
        while !*is_open {
            is_open = self.1.wait(is_open).unwrap();
        }
    }

    pub fn open(&self) {
        *self.0.lock().unwrap() = true;
        self.1.notify_all();
    }
}

#[derive(Clone)]
pub enum Step {
    Frame,
    Fail(CaptureErrorKind),
    Panic,
    /// Panics, and again in the drop during unwinding.
    PanicTwice,
    /// Blocks until the gate is open.
    Hang(Arc<Gate>),
    /// Repeats the previous frame.
    Again,
}

pub struct Script {
    camera: CameraId,
    steps: VecDeque<Step>,
    /// Step that repeats once `steps` is exhausted.
    then: Step,
    sequence: u64,
    panics_in_drop: bool,
}

pub fn source(camera: &str, steps: impl IntoIterator<Item = Step>, then: Step) -> Box<dyn CameraSource> {
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
        // A camera of a thousand frames per second.
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

pub fn frames(count: usize) -> Vec<Step> {
    vec![Step::Frame; count]
}

pub fn live(queue_capacity: usize) -> ThreadsConfig {
    ThreadsConfig { queue_capacity, pacing: Pacing::AsDelivered }
}

/// Opener of a camera that works.
pub fn healthy(camera: &str) -> SourceOpener {
    let name = camera.to_owned();
    SourceOpener::new(&camera.into(), move || Ok(source(&name, [], Step::Frame)))
}

pub fn stats(threads: &CaptureThreads, camera: &str) -> CameraStats {
    threads.stats().into_iter().find(|stats| stats.camera.as_str() == camera).unwrap()
}

/// Waits until the counts of a camera satisfy `is_so`.
pub fn until(threads: &CaptureThreads, camera: &str, what: &str, is_so: impl Fn(&CameraStats) -> bool) -> CameraStats {
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

/// Waits until ten more frames of a camera have been captured.
pub fn flows(threads: &CaptureThreads, camera: &str) {
    let before = stats(threads, camera).frames;
    until(threads, camera, "it gives frames", |stats| stats.frames > before + 10);
}

/// Drops the threads and returns the time that took; fails after a minute.
pub fn dropped(threads: CaptureThreads) -> Duration {
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
