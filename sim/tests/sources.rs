//! Simulated cameras behind the capture trait.

#![allow(clippy::unwrap_used)]

mod common;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use common::{simulator, small_config};
use flyrig_capture::{CameraSource, CaptureErrorKind};
use flyrig_sim::sources;

#[test]
fn all_cameras_see_the_same_instants_and_the_stream_ends_when_told() {
    let mut config = small_config(2);
    config.frames = Some(3);
    config.fps = 29.97;
    let shared = Arc::new(Mutex::new(simulator(&config)));
    let mut cameras = sources(&shared);
    assert_eq!(cameras.iter().map(|c| c.camera().to_string()).collect::<Vec<_>>(), ["00", "01"]);
    let mut previous: Option<Vec<u8>> = None;
    for sequence in 0..3 {
        let frames: Vec<_> = cameras.iter_mut().map(|c| c.next_frame(Duration::ZERO).unwrap()).collect();
        let nanos = (sequence as f64 * 1e9 / 29.97) as i64;
        assert!(frames.iter().all(|f| f.sequence == sequence && f.capture_nanos == nanos));
        let direct = shared.lock().unwrap().capture(nanos, 1).unwrap();
        assert_eq!(frames[1].image.bytes(), direct.0.bytes());
        assert_eq!(frames[1].mask.as_ref(), Some(&direct.1));
        let bytes = frames[0].image.bytes().to_vec();
        assert_ne!(previous.as_ref(), Some(&bytes), "the person stands still");
        previous = Some(bytes);
    }
    let error = cameras[0].next_frame(Duration::ZERO).unwrap_err();
    assert_eq!(error.kind, CaptureErrorKind::EndOfStream);
    assert_eq!(error.to_string(), "camera 00: the simulation ends after 3 frames");
}
