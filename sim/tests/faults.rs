//! Effects of a fault script on the frames.

#![allow(clippy::unwrap_used)]

mod common;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use common::{simulator, small_config};
use flyrig_capture::{CameraSource, CaptureErrorKind};
use flyrig_sim::{Delivery, FaultScript, Shot, SimSource, SimTime, Simulator, sources};
use flyrig_types::{CameraId, Frame};

const FPS: f64 = 30.0;

fn nanos_of(index: u64) -> i64 {
    (index as f64 * 1e9 / FPS) as i64
}

/// Returns cameras 00 and 01 of a simulation with these faults, and a simulator without any.
fn rig(script: &str) -> (Vec<SimSource>, Simulator) {
    let mut config = small_config(2);
    config.frames = Some(12);
    config.width = 64;
    config.height = 64;
    let plain = simulator(&config);
    config.faults = FaultScript::parse(script).unwrap();
    (sources(&Arc::new(Mutex::new(simulator(&config))), SimTime::Exact), plain)
}

fn next(source: &mut SimSource) -> Result<Frame, CaptureErrorKind> {
    source.next_frame(Duration::ZERO).map_err(|error| error.kind)
}

fn stamps(source: &mut SimSource) -> Vec<i64> {
    (0..12).map(|_| next(source).unwrap().capture_nanos).collect()
}

#[test]
fn a_clock_with_an_offset_and_drift_stamps_late_but_shows_the_common_instant() {
    let script = "[[fault]]\nkind = \"offset\"\ncamera = \"01\"\nms = 12.5\n\
                  [[fault]]\nkind = \"drift\"\ncamera = \"01\"\nppm = 20000.0\n";
    let (mut cameras, mut plain) = rig(script);
    let whole: Vec<i64> = (0..12).map(nanos_of).collect();
    assert_eq!(stamps(&mut cameras[0]), whole);
    for index in 0..12 {
        let frame = next(&mut cameras[1]).unwrap();
        let expected = nanos_of(index) + 12_500_000 + (nanos_of(index) as f64 * 0.02) as i64;
        assert!((frame.capture_nanos - expected).abs() <= 1, "frame {index}: {} and {expected}", frame.capture_nanos);
        assert_eq!(frame.image.bytes(), plain.capture(nanos_of(index), 1).unwrap().0.bytes());
    }
}

#[test]
fn jitter_has_its_standard_deviation_and_no_bias() {
    let script = FaultScript::parse("seed = 4\n[[fault]]\nkind = \"jitter\"\nms = 2.0\n").unwrap();
    let camera = CameraId::from("00");
    let errors: Vec<f64> = (0..20_000)
        .map(|index| {
            let plan = script.plan(&camera, index, nanos_of);
            assert_eq!(plan.true_nanos, nanos_of(index));
            (plan.stamp_nanos - plan.true_nanos) as f64 / 1e6
        })
        .collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let sigma = (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / errors.len() as f64).sqrt();
    println!("jitter of 2 ms: mean {mean:.4} ms, standard deviation {sigma:.4} ms");
    assert!(mean.abs() < 0.05 && (sigma - 2.0).abs() < 0.04, "mean {mean}, sigma {sigma}");
    // The other camera jitters otherwise; another seed too.
    assert_ne!(script.plan(&"01".to_owned().into(), 7, nanos_of), script.plan(&camera, 7, nanos_of));
    let other = FaultScript { seed: 5, ..script.clone() };
    assert_ne!(other.plan(&camera, 7, nanos_of), script.plan(&camera, 7, nanos_of));
}

#[test]
fn a_lagging_camera_shows_a_later_instant_and_says_so() {
    let (mut cameras, mut plain) = rig("[[fault]]\nkind = \"lag\"\ncamera = \"00\"\nms = 9.0\n");
    for index in 0..3 {
        let frame = next(&mut cameras[0]).unwrap();
        assert_eq!(frame.capture_nanos, nanos_of(index) + 9_000_000);
        assert_eq!(frame.image.bytes(), plain.capture(nanos_of(index) + 9_000_000, 0).unwrap().0.bytes());
        assert_eq!(next(&mut cameras[1]).unwrap().capture_nanos, nanos_of(index));
    }
}

#[test]
fn dropped_frames_leave_a_gap_in_sequence_and_time() {
    let (mut cameras, _) = rig("[[fault]]\nkind = \"drop\"\nfrom_frame = 2\nframes = 3\n");
    let got: Vec<(u64, i64)> =
        (0..4).map(|_| next(&mut cameras[0]).unwrap()).map(|f| (f.sequence, f.capture_nanos)).collect();
    assert_eq!(got, [0, 1, 5, 6].map(|index| (index, nanos_of(index))));
    // A share of all frames.
    let script = FaultScript::parse("[[fault]]\nkind = \"drop\"\nprobability = 0.2\n").unwrap();
    let camera = CameraId::from("03");
    let dropped = (0..10_000).filter(|&i| script.plan(&camera, i, nanos_of).delivery == Delivery::Dropped).count();
    assert!((1880..2120).contains(&dropped), "{dropped} of 10000 frames, expected 2000");
}

#[test]
fn a_duplicate_is_the_image_before_with_a_stamp_of_its_own() {
    let (mut cameras, _) = rig("[[fault]]\nkind = \"duplicate\"\nfrom_frame = 2\nframes = 1\n");
    let frames: Vec<Frame> = (0..4).map(|_| next(&mut cameras[0]).unwrap()).collect();
    assert_eq!(frames[2].image.bytes(), frames[1].image.bytes());
    assert_ne!(frames[3].image.bytes(), frames[2].image.bytes());
    assert_eq!((frames[2].sequence, frames[2].capture_nanos), (2, nanos_of(2)));
}

#[test]
fn a_stall_times_out_and_time_goes_on_meanwhile() {
    let (mut cameras, _) = rig("[[fault]]\nkind = \"stall\"\nfrom_frame = 1\nframes = 2\n");
    assert_eq!(next(&mut cameras[0]).unwrap().sequence, 0);
    assert_eq!(next(&mut cameras[0]).unwrap_err(), CaptureErrorKind::Timeout);
    assert_eq!(next(&mut cameras[0]).unwrap_err(), CaptureErrorKind::Timeout);
    let frame = next(&mut cameras[0]).unwrap();
    assert_eq!((frame.sequence, frame.capture_nanos), (3, nanos_of(3)));
}

#[test]
fn a_camera_that_was_gone_returns_and_counts_from_zero() {
    let (mut cameras, _) = rig("[[fault]]\nkind = \"disconnect\"\ncamera = \"01\"\nfrom_frame = 2\nframes = 4\n");
    assert_eq!(stamps(&mut cameras[0]).len(), 12);
    for sequence in 0..2 {
        assert_eq!(next(&mut cameras[1]).unwrap().sequence, sequence);
    }
    for _ in 0..4 {
        assert_eq!(next(&mut cameras[1]).unwrap_err(), CaptureErrorKind::Disconnected);
    }
    for (sequence, index) in (0..3).zip(6..) {
        let frame = next(&mut cameras[1]).unwrap();
        assert_eq!((frame.sequence, frame.capture_nanos), (sequence, nanos_of(index)));
    }
}

#[test]
fn a_wrong_timestamp_hits_single_frames() {
    let (mut cameras, mut plain) =
        rig("[[fault]]\nkind = \"wrong-timestamp\"\nfrom_frame = 3\nframes = 1\nms = -250.0\n");
    let frames: Vec<Frame> = (0..5).map(|_| next(&mut cameras[1]).unwrap()).collect();
    let expected: Vec<i64> = (0..5).map(|i| nanos_of(i) - if i == 3 { 250_000_000 } else { 0 }).collect();
    assert_eq!(frames.iter().map(|f| f.capture_nanos).collect::<Vec<_>>(), expected);
    assert_eq!(frames[3].image.bytes(), plain.capture(nanos_of(3), 1).unwrap().0.bytes());
}

#[test]
fn a_corrupt_frame_is_garbage_below_a_row_and_an_undecodable_one_an_error() {
    let (mut cameras, mut plain) = rig("seed = 1\n[[fault]]\nkind = \"corrupt\"\nfrom_frame = 1\nframes = 1\n\
                                        [[fault]]\nkind = \"undecodable\"\nfrom_frame = 2\nframes = 1\n");
    assert_eq!(next(&mut cameras[0]).unwrap().image.bytes(), plain.capture(0, 0).unwrap().0.bytes());
    let corrupted = next(&mut cameras[0]).unwrap().image.bytes().to_vec();
    let sound = plain.capture(nanos_of(1), 0).unwrap().0.bytes().to_vec();
    let first = corrupted.iter().zip(&sound).position(|(a, b)| a != b).unwrap();
    let wrong = corrupted[first..].iter().zip(&sound[first..]).filter(|(a, b)| a.abs_diff(**b) > 20).count();
    assert!(wrong * 2 > corrupted.len() - first, "{wrong} of {} bytes are wrong", corrupted.len() - first);
    assert!(first < corrupted.len() * 9 / 10 + 64, "the garbage starts at {first}");
    assert_eq!(next(&mut cameras[0]).unwrap_err(), CaptureErrorKind::Corrupt);
    assert_eq!(next(&mut cameras[0]).unwrap().image.bytes(), plain.capture(nanos_of(3), 0).unwrap().0.bytes());
}

#[test]
fn an_exposure_jump_darkens_the_frames_of_its_span() {
    let (mut cameras, mut plain) =
        rig("[[fault]]\nkind = \"exposure-jump\"\ncamera = \"00\"\nfrom_frame = 1\nframes = 1\nfactor = 0.4\n");
    let linear = |byte: &u8| match f64::from(*byte) / 255.0 {
        code if code <= 0.04045 => code / 12.92,
        code => ((code + 0.055) / 1.055).powf(2.4),
    };
    let light = |bytes: &[u8]| bytes.iter().map(linear).sum::<f64>() / bytes.len() as f64;
    let shares: Vec<f64> = (0..3)
        .map(|i| {
            light(next(&mut cameras[0]).unwrap().image.bytes())
                / light(plain.capture(nanos_of(i), 0).unwrap().0.bytes())
        })
        .collect();
    println!("light of three frames: {shares:.3?}");
    assert!((shares[0] - 1.0).abs() < 1e-12 && (shares[1] - 0.4).abs() < 0.03 && (shares[2] - 1.0).abs() < 1e-12);
}

#[test]
fn a_bumped_camera_stands_where_it_was_pushed_to_and_the_calibration_does_not_know() {
    let script = "seed = 3\n[[fault]]\nkind = \"bump\"\ncamera = \"00\"\nfrom_frame = 2\nmm = 40.0\ndeg = 2.0\n";
    let (mut cameras, mut plain) = rig(script);
    let plan = |index| FaultScript::parse(script).unwrap().plan(&"00".into(), index, nanos_of);
    assert_eq!(plan(1).bump, None);
    let push = plan(2).bump.unwrap();
    assert!((push.translation.length() - 0.04).abs() < 1e-12);
    assert!((push.rotation.angle_between(glam::DQuat::IDENTITY).to_degrees() - 2.0).abs() < 1e-6);
    assert_eq!(plan(9).bump, Some(push), "it stays there");
    for index in 0..4 {
        let frame = next(&mut cameras[0]).unwrap();
        let unmoved = plain.capture(nanos_of(index), 0).unwrap().0;
        if index < 2 {
            assert_eq!(frame.image.bytes(), unmoved.bytes());
            continue;
        }
        let differ = frame.image.bytes().iter().zip(unmoved.bytes()).filter(|(a, b)| a.abs_diff(**b) > 8).count();
        assert!(differ * 20 > unmoved.bytes().len(), "{differ} bytes differ");
        // A camera that is known to stand there sees the same.
        let shot = Shot { camera_shift: Some(push), ..Shot::new(nanos_of(index), 0) };
        assert_eq!(plain.capture_with(&shot).unwrap().0.bytes(), frame.image.bytes());
    }
    assert_eq!(plain.rig(), &plain.reported_rig());
}

#[test]
fn the_shipped_script_has_every_fault() {
    let script = FaultScript::parse(include_str!("../assets/faults.toml")).unwrap();
    let kinds: std::collections::BTreeSet<String> = script.faults.iter().map(|f| format!("{:?}", f.kind)).collect();
    let known = FaultScript::parse("[[fault]]\nkind = \"none\"\n").unwrap_err().to_string();
    let listed = known.rsplit("expected one of").next().unwrap().matches('`').count() / 2;
    assert_eq!(kinds.len(), listed, "{kinds:?} of {known}");
}

#[test]
fn what_is_no_fault_is_refused_by_name() {
    let refusal = |text: &str| FaultScript::parse(text).unwrap_err().to_string();
    assert!(refusal("[[fault]]\nkind = \"drop\"\nprobabilty = 0.5\n").contains("probabilty"));
    assert!(refusal("sed = 4\n").contains("sed"));
    assert!(refusal("[[fault]]\nkind = \"explode\"\n").contains("explode"));
    assert!(refusal("[[fault]]\nkind = \"offset\"\n").contains("fault.ms is missing for Offset"));
    assert!(refusal("[[fault]]\nkind = \"drop\"\nms = 3.0\n").contains("fault.ms is 3"));
    assert!(refusal("[[fault]]\nkind = \"drift\"\nppm = nan\n").contains("fault.ppm is NaN"));
    assert!(refusal("[[fault]]\nkind = \"drop\"\nprobability = 1.5\n").contains("fault.probability is 1.5"));
}

#[test]
fn a_fault_of_a_camera_that_does_not_stand_in_the_ring_is_refused() {
    let refusal = |camera: &str| {
        let mut config = small_config(2);
        config.faults = FaultScript::parse(&format!("[[fault]]\nkind = \"drop\"\ncamera = \"{camera}\"\n")).unwrap();
        config.validate().map_err(|error| error.to_string())
    };
    assert_eq!(refusal("01"), Ok(()));
    for unknown in ["02", "1", "cam1", ""] {
        let text = refusal(unknown).unwrap_err();
        let expected = format!("fault.camera is '{unknown}' beside cameras 00 to 01, expected one of those");
        assert!(text.contains(&expected), "{text}");
    }
}
