//! Openers of cameras that are missing, hang, take long or panic.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod scripted;

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use flyrig_capture::{CaptureError, CaptureErrorKind, CaptureThreads, SourceOpener};
use scripted::{Gate, Step, dropped, flows, healthy, live, source, stats, until};

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
