//! Lags that are known, found again.

use flyrig_types::{Intrinsics, Isometry, Lens};

use super::*;
use crate::random::Random;

const PERIOD: i64 = 16_666_667;

fn camera(slot: usize) -> Camera {
    let angle = slot as f64 * 1.4 + 0.3;
    let eye = DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 1.6);
    let intrinsics = Intrinsics {
        width: 544,
        height: 960,
        focal_px: DVec2::splat(830.0),
        center_px: DVec2::new(271.5, 479.5),
        lens: Lens::PINHOLE,
    };
    let camera_from_world = Isometry::look_at(eye, DVec3::new(0.0, 0.0, 1.0), DVec3::Z);
    Camera { id: format!("cam{slot}").into(), intrinsics, camera_from_world }
}

/// Joints of somebody who walks: forward, up and down, limbs in turn.
fn joint(point: usize, secs: f64) -> DVec3 {
    let (side, height) = (if point.is_multiple_of(2) { 1.0 } else { -1.0 }, 0.1 + 0.1 * point as f64);
    let swing = (6.3 * secs + side).sin() * 0.35 * (height - 1.0).abs();
    DVec3::new(1.2 * secs - 1.0 + swing * side, 0.2 * side, height + 0.04 * (12.6 * secs).sin())
}

fn track(slot: usize, lag: i64, frames: i64, noise_px: f64, random: &mut Random) -> PointTrack {
    let camera = camera(slot);
    let mut track = PointTrack::new(&camera);
    for n in 0..frames {
        let truth = n * PERIOD + slot as i64 * 3_000_000;
        let pixels: Vec<Option<DVec2>> = (0..16)
            .map(|point| {
                let pixel = camera.project(joint(point, truth as f64 * 1e-9))?;
                let mut tremble = || (random.unit() + random.unit() + random.unit() - 1.5) * 2.0 * noise_px;
                let off = DVec2::new(tremble(), tremble());
                // Now and then it is another thing altogether.
                let is_wrong = random.unit() < 0.05;
                Some(if is_wrong { pixel + DVec2::new(150.0, 40.0) } else { pixel + off })
            })
            .collect();
        track.add(truth + lag, &pixels);
    }
    track
}

#[test]
fn a_second_and_a_half_of_walking_is_enough() {
    let mut random = Random(4);
    let mut worst = 0.0f64;
    for _ in 0..2 {
        let lags: Vec<i64> = (0..4).map(|i| if i == 0 { 0 } else { ((random.unit() - 0.5) * 160e6) as i64 }).collect();
        let tracks: Vec<PointTrack> =
            lags.iter().enumerate().map(|(slot, lag)| track(slot, *lag, 97, 3.0, &mut random)).collect();
        for (estimate, lag) in estimate_point_lags(&tracks, 150_000_000).iter().zip(&lags) {
            let off = (estimate.lag_nanos.unwrap() - lag) as f64 * 1e-6;
            println!(
                "{}: {:.1} ms, off by {off:.2} ms, contrast {:.2}, halves {:.2} ms",
                estimate.camera,
                *lag as f64 * 1e-6,
                estimate.correlation,
                estimate.disagreement_nanos * 1e-6
            );
            worst = worst.max(off.abs());
        }
    }
    // Half of a frame: what 97 noisy pictures tell.
    assert!(worst <= 8.0, "{worst} ms");
}

#[test]
fn who_stands_still_tells_no_lag() {
    let mut random = Random(8);
    let tracks: Vec<PointTrack> = (0..3)
        .map(|slot| {
            let camera = camera(slot);
            let mut track = PointTrack::new(&camera);
            for n in 0..97 {
                let pixels: Vec<_> = (0..16)
                    .map(|point| {
                        let noise = DVec2::new(random.unit(), random.unit()) * 4.0;
                        camera.project(joint(point, 0.5)).map(|pixel| pixel + noise)
                    })
                    .collect();
                track.add(n * PERIOD, &pixels);
            }
            track
        })
        .collect();
    let estimates = estimate_point_lags(&tracks, 100_000_000);
    assert!(estimates[1..].iter().all(|estimate| estimate.lag_nanos.is_none()), "{estimates:?}");
}

#[test]
fn too_few_cameras_and_senseless_points_are_borne() {
    assert!(estimate_point_lags(&[], 1).is_empty());
    let mut odd = PointTrack::new(&camera(0));
    odd.add(i64::MIN, &[Some(DVec2::NAN), None, Some(DVec2::splat(1e300))]);
    odd.add(i64::MAX, &[Some(DVec2::ZERO)]);
    odd.add(0, &[Some(DVec2::ZERO)]);
    let estimates = estimate_point_lags(&[odd.clone(), odd.clone(), odd], i64::MAX);
    assert!(estimates[1].lag_nanos.is_none());
    let pair: Vec<PointTrack> = (0..2).map(|slot| track(slot, 0, 97, 1.0, &mut Random(1))).collect();
    assert!(estimate_point_lags(&pair, 100_000_000)[1].lag_nanos.is_none(), "two cameras see too little");
}
