//! Sources and stages that panic or fail for good are made anew.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod scripted;

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use flyrig_capture::{CaptureError, CaptureErrorKind, CaptureThreads, FrameStage, Pacing, SourceOpener, ThreadsConfig};
use flyrig_types::{CameraId, Frame};
use scripted::{Step, dropped, flows, frames, healthy, live, source, stats, until};

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

/// Stage that panics at its third frame.
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
