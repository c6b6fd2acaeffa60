//! Cameras that are missing, hang, take long or panic are opened and restarted.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod scripted;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use flyrig_capture::{CaptureError, CaptureErrorKind, CaptureThreads, FrameStage, Pacing, SourceOpener, ThreadsConfig};
use flyrig_types::{CameraId, Frame};
use scripted::{Gate, Step, dropped, flows, frames, healthy, live, source, stats, until};

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
    // A machine that pauses makes others look stuck for a moment.
    until(&threads, "hangs", "it alone is stuck", |_| threads.stuck(Duration::from_secs(4)) == ["open hangs"]);
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
        let threads = CaptureThreads::start_opening(vec![opener, healthy("good")], live(100_000)).unwrap();
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
        until(&threads, "bad", "a pause is not a hang", |_| threads.stuck(Duration::from_secs(5)).is_empty());
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
