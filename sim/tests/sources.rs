//! Simulated cameras behind the capture trait.

#![allow(clippy::unwrap_used)]

mod common;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use common::{simulator, small_config};
use flyrig_capture::{CameraSource, CaptureErrorKind, CaptureThreads, Pacing, ThreadsConfig};
use flyrig_sim::{FaultScript, SimConfig, SimTime, sources};
use flyrig_types::Frame;

#[test]
fn all_cameras_see_the_same_instants_and_the_stream_ends_when_told() {
    let mut config = small_config(2);
    config.frames = Some(3);
    config.fps = 29.97;
    let shared = Arc::new(Mutex::new(simulator(&config)));
    let mut cameras = sources(&shared, SimTime::Exact);
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

/// Returns all frames that threads deliver from these simulated cameras.
fn delivered(config: &SimConfig, time: SimTime, pacing: Pacing) -> Vec<Frame> {
    let shared = Arc::new(Mutex::new(simulator(config)));
    let boxed = sources(&shared, time).into_iter().map(|source| Box::new(source) as Box<dyn CameraSource>).collect();
    let threads = CaptureThreads::start(boxed, ThreadsConfig { queue_capacity: 1000, pacing }).unwrap();
    std::iter::from_fn(|| threads.queue().pop(Duration::from_secs(60)).ok()).collect()
}

#[test]
fn in_real_time_a_machine_that_is_too_slow_skips_whole_instants() {
    let mut config = small_config(2);
    // Far more than any machine draws.
    (config.fps, config.frames) = (1000.0, Some(700));
    let frames = delivered(&config, SimTime::Real, Pacing::AsDelivered);
    let of = |camera: &str| -> Vec<u64> {
        frames.iter().filter(|f| f.camera.as_str() == camera).map(|f| f.sequence).collect()
    };
    let [a, b] = ["00", "01"].map(of);
    assert!(!a.is_empty() && a.len() < 700, "{} of 700 instants", a.len());
    // At the end one of them may have gone on to an instant after the last while the other drew it.
    assert_eq!(a[..a.len().min(b.len())], b[..a.len().min(b.len())], "both cameras take the same instants");
    assert!(a.windows(2).all(|pair| pair[1] > pair[0]));
    assert!(frames.iter().all(|f| f.capture_nanos == f.sequence as i64 * 1_000_000));
}

#[test]
fn simulated_time_is_exact_even_where_stamps_are_wrong_and_a_camera_is_gone() {
    let mut config = small_config(2);
    config.frames = Some(12);
    let script = "[[fault]]\nkind = \"wrong-timestamp\"\ncamera = \"01\"\nfrom_frame = 3\nframes = 1\nms = 250.0\n\
                  [[fault]]\nkind = \"disconnect\"\ncamera = \"01\"\nfrom_frame = 6\nframes = 3\n";
    config.faults = FaultScript::parse(script).unwrap();
    let order = || -> Vec<(String, u64)> {
        let frames = delivered(&config, SimTime::Exact, Pacing::Lossless);
        frames.into_iter().map(|f| (f.camera.to_string(), f.capture_nanos as u64 / 1_000_000)).collect()
    };
    let first = order();
    let ms = |index: u64| (index as f64 * 1e3 / 30.0) as u64;
    let expected: Vec<(String, u64)> = (0..12)
        .flat_map(|i| [Some(("00".to_owned(), ms(i))), Some(("01".to_owned(), ms(i) + if i == 3 { 250 } else { 0 }))])
        .flatten()
        .filter(|(camera, at)| camera == "00" || !(ms(6)..ms(9)).contains(at))
        .collect();
    assert_eq!(first, expected);
    assert_eq!(order(), first);
}
