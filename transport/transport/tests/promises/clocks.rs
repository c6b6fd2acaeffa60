//! Clocks of two computers, one with an offset and a drift that the test makes.

use std::time::Duration;

use flyrig_transport::{CameraPublisher, CameraSubscriber, HostClock, TransportConfig};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

use crate::{
    cameras::{now_nanos, our_clock},
    support::*,
};

/// Faster than any real computer's, so that seconds are enough to see it.
const DRIFT_PPM: f64 = 400.0;

fn other_clock(at: i64) -> i64 {
    at + 86_400_000_000_000 + (at as f64 * DRIFT_PPM * 1e-6) as i64
}

#[test]
fn offset_and_drift_of_another_computer_are_taken_off() {
    let a = CameraId::from("a");
    let config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".into()], ..TransportConfig::publisher("test") };
    let clock = HostClock::new(|| other_clock(now_nanos()));
    let host = CameraPublisher::open(&config, std::slice::from_ref(&a), clock).unwrap();
    let config = TransportConfig { connect: host.endpoints().to_vec(), ..TransportConfig::subscriber("test") };
    let there = CameraSubscriber::open(&config, std::slice::from_ref(&a), our_clock()).unwrap();
    let (mut sequence, mut worst, mut leaning) = (0u64, 0i64, 0);
    wait_until("fifty frames after the drift is known", || {
        sequence += 1;
        let taken = now_nanos();
        // Images fill the wire between the questions.
        let image = Image::new(640, 360, PixelFormat::Yuyv, vec![0; 640 * 360 * 2]).unwrap();
        let capture_nanos = other_clock(taken);
        let before = there.link(&a).clock;
        host.publish(Frame { camera: a.clone(), sequence, capture_nanos, exposure_nanos: None, image, mask: None })
            .unwrap();
        let found = loop {
            match there.next_frame(&a, Duration::from_millis(30)).unwrap() {
                Some(frame) if frame.sequence == sequence => break Some(frame),
                Some(_) => {}
                None => break None,
            }
        };
        let clock = there.link(&a).clock;
        if let (Some(found), Some(clock)) = (found, clock) {
            let error = (found.capture_nanos - taken).abs();
            // Half of the round trip bounds the offset where it was measured, the drift not yet known adds to it. The clock may have been
            // asked again since the frame came.
            let round_trip_nanos = before.map_or(0, |clock| clock.round_trip_nanos).max(clock.round_trip_nanos);
            let bound = round_trip_nanos / 2 + 3_000_000;
            assert!(error <= bound, "{error} ns, bound {bound}, {clock:?}");
            if (clock.drift_ppm - DRIFT_PPM).abs() < 100.0 {
                leaning += 1;
                worst = worst.max(error);
            }
        }
        std::thread::sleep(Duration::from_millis(5));
        leaning >= 50
    });
    let clock = there.link(&a).clock.unwrap();
    println!(
        "a day and {DRIFT_PPM} ppm apart: drift {:.1} ppm, round trip {} us, stamps within {} us",
        clock.drift_ppm,
        clock.round_trip_nanos / 1000,
        worst / 1000
    );
    assert_eq!(clock.steps, 0);
}
