//! Reading without loss: opened first, never anew, in the order of time.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod scripted;

use std::time::Duration;

use flyrig_capture::{
    CameraSource, CaptureError, CaptureErrorKind, CaptureThreads, Pacing, PopError, SourceOpener, ThreadsConfig,
};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};
use scripted::{MINUTE, Step, dropped, frames, healthy, source, stats};

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

/// Camera of a thousand frames per second that is silent for a while, but knows the time.
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
