//! Known time offsets, recovered from silhouettes of moving balls.

use flyrig_types::{Intrinsics, Isometry, Lens};

use glam::DVec2;

use super::*;
use flyrig_model::SplitMix64;

const PERIOD: i64 = 33_333_333;

fn camera(name: &str, eye: DVec3, target: DVec3) -> Camera {
    let lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.0], tangential: [0.0; 2] };
    let intrinsics =
        Intrinsics { width: 144, height: 192, focal_px: DVec2::splat(195.0), center_px: DVec2::new(71.5, 95.5), lens };
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: name.into(),
        intrinsics,
        camera_from_world: Isometry::look_at(eye, target, DVec3::Z),
    }
}

/// Places cameras around the origin, at different heights.
fn ring(count: usize) -> Vec<Camera> {
    let eye = |slot: usize| {
        let angle = slot as f64 * 1.1 + 0.3;
        DVec3::new(3.5 * angle.cos(), 3.5 * angle.sin(), 0.8 + 0.4 * slot as f64)
    };
    (0..count).map(|slot| camera(&format!("cam{slot}"), eye(slot), DVec3::Z)).collect()
}

/// Returns balls (centre, radius) that stand for a person: a trunk, a head and two hands, jumping and waving.
fn balls(secs: f64, seed: u64) -> Vec<(DVec3, f64)> {
    let mut random = SplitMix64(seed);
    let mut swing = |size: f64| {
        let parts: Vec<[f64; 3]> =
            (0..4).map(|_| [1.0 + 8.0 * random.unit(), 6.3 * random.unit(), size * random.unit()]).collect();
        parts.iter().map(|[rate, phase, size]| size * (rate * secs + phase).sin()).sum::<f64>()
    };
    let base = DVec3::new(swing(0.1), swing(0.1), swing(0.1));
    let mut hand = |side: f64| base + DVec3::new(0.45 * side + swing(0.15), swing(0.25), 1.5 + swing(0.3));
    let (left, right) = (hand(-1.0), hand(1.0));
    vec![(base + DVec3::Z, 0.35), (base + DVec3::Z * 1.55, 0.14), (left, 0.1), (right, 0.1)]
}

/// Returns the rays of a camera's pixels.
fn rays(camera: &Camera) -> Vec<DVec3> {
    let [width, height] = camera.size();
    let pixel = |i: u32| DVec2::new(f64::from(i % width), f64::from(i / width));
    (0..width * height).map(|i| camera.ray(pixel(i)).unwrap()).collect()
}

/// Renders a camera's mask of balls: coverage from the distance of a pixel's ray to the nearest ball's outline.
fn mask(camera: &Camera, rays: &[DVec3], balls: &[(DVec3, f64)]) -> Mask {
    let [width, height] = camera.size();
    let to = |center: DVec3| center - camera.position();
    let seen: Vec<(DVec3, f64)> =
        balls.iter().map(|(center, radius)| (to(*center).normalize(), radius / to(*center).length())).collect();
    let coverage = rays.iter().map(|ray| {
        let inside = seen.iter().map(|(center, sine)| sine - ray.cross(*center).length());
        let pixels = inside.fold(f64::MIN, f64::max) * camera.intrinsics.focal_px.x;
        ((pixels + 0.5).clamp(0.0, 1.0) * 255.0).round() as u8
    });
    Mask::new(width, height, coverage.collect()).unwrap()
}

/// Simulates eight seconds of one camera; now and then a frame is missing or its mask is wrong.
fn track(camera: &Camera, lag: i64, phase: i64, seed: u64, random: &mut SplitMix64) -> SilhouetteTrack {
    let (mut track, rays) = (SilhouetteTrack::new(camera), rays(camera));
    for n in 0..240 {
        let truth = n * PERIOD + phase;
        let mut seen = balls(truth as f64 * 1e-9, seed);
        let luck = random.unit();
        if luck < 0.03 {
            continue;
        }
        if luck > 0.97 {
            seen.truncate(1 + (3.0 * random.unit()) as usize);
        }
        track.add(truth + lag, &mask(camera, &rays, &seen));
    }
    track
}

#[test]
fn random_lags_are_found_within_a_millisecond() {
    let mut random = SplitMix64(3);
    for (seed, count) in [(1, 2), (2, 4), (3, 5)] {
        let lags: Vec<i64> =
            (0..count).map(|i| if i == 0 { 0 } else { ((random.unit() - 0.5) * 200e6) as i64 }).collect();
        let tracks: Vec<SilhouetteTrack> = ring(count)
            .iter()
            .zip(&lags)
            .map(|(camera, lag)| track(camera, *lag, (random.unit() * PERIOD as f64) as i64, seed, &mut random))
            .collect();
        for (estimate, lag) in estimate_silhouette_lags(&tracks, 250_000_000).iter().zip(&lags) {
            let off = estimate.lag_nanos.map(|found| (found - lag) as f64 * 1e-6);
            println!(
                "seed {seed} {}: {:.1} ms, off by {off:.2?} ms, standard error {:.2} ms, contrast {:.2}",
                estimate.camera,
                *lag as f64 * 1e-6,
                estimate.disagreement_nanos * 1e-6,
                estimate.correlation
            );
            assert!(off.is_some_and(|off| off.abs() <= 1.0), "{}: {off:?} ms", estimate.camera);
        }
    }
}

#[test]
fn outermost_planes_are_those_that_touch_the_balls() {
    let cameras = ring(2);
    let mut tracks: Vec<SilhouetteTrack> = cameras.iter().map(SilhouetteTrack::new).collect();
    for n in 0..30 {
        for (track, camera) in tracks.iter_mut().zip(&cameras) {
            track.add(n * PERIOD, &mask(camera, &rays(camera), &balls((n * PERIOD) as f64 * 1e-9, 5)));
        }
    }
    let pencil = Pencil::new(&tracks[0], &tracks[1]).unwrap();
    // A plane through the line touches a ball where its angle differs from the centre's by this much.
    let on_line = cameras[0].position();
    let line = (cameras[1].position() - on_line).normalize();
    let reference = |nanos: i64| {
        let around = balls(nanos as f64 * 1e-9, 5).into_iter().map(|(center, radius)| {
            let away = (center - on_line).reject_from_normalized(line);
            let angle = away.dot(pencil.axes[1]).atan2(away.dot(pencil.axes[0]));
            let half = (radius / away.length()).asin();
            [angle - half, angle + half]
        });
        around.fold([f64::MAX, f64::MIN], |[low, high], [a, b]| [low.min(a), high.max(b)])
    };
    for track in &tracks {
        let [low, high] = pencil.tangents(track);
        assert_eq!((low.len(), high.len()), (30, 30));
        for ((nanos, low), (_, high)) in low.into_iter().zip(high) {
            let truth = reference(nanos);
            // A pixel is 5.1 mrad.
            let off = [(low - truth[0]).abs(), (high - truth[1]).abs()];
            assert!(off[0] < 3e-3 && off[1] < 3e-3, "{} at {nanos}: off by {off:?}", track.camera.id);
        }
    }
}

#[test]
fn what_the_image_cuts_off_is_not_compared() {
    // The first camera aims low: the top is above its image.
    let mut cameras = ring(2);
    cameras[0] = camera("low", cameras[0].position(), DVec3::new(0.0, 0.0, -0.4));
    let mut track = SilhouetteTrack::new(&cameras[0]);
    let mut whole = SilhouetteTrack::new(&cameras[1]);
    for n in 0..10 {
        let balls = [(DVec3::new(0.0, 0.0, 0.9), 0.95), (DVec3::new(0.0, 0.0, 1.9), 0.2)];
        track.add(n * PERIOD, &mask(&cameras[0], &rays(&cameras[0]), &balls));
        whole.add(n * PERIOD, &mask(&cameras[1], &rays(&cameras[1]), &balls));
    }
    let pencil = Pencil::new(&track, &whole).unwrap();
    let sides = pencil.tangents(&track).map(|side| side.len());
    assert!(sides.contains(&0) && pencil.tangents(&whole).iter().all(|side| side.len() == 10), "{sides:?}");
}

#[test]
fn a_camera_that_sees_another_movement_is_told_nothing_of() {
    let mut random = SplitMix64(8);
    let cameras = ring(4);
    let seeds = [4, 4, 4, 77];
    let tracks: Vec<SilhouetteTrack> =
        cameras.iter().zip(seeds).map(|(camera, seed)| track(camera, 0, 0, seed, &mut random)).collect();
    let lags: Vec<_> = estimate_silhouette_lags(&tracks, 250_000_000).into_iter().map(|e| e.lag_nanos).collect();
    assert!(lags[1].is_some_and(|lag| lag.abs() < 1_000_000) && lags[2].is_some_and(|lag| lag.abs() < 1_000_000));
    assert_eq!(lags[3], None, "{lags:?}");
}

#[test]
fn nothing_that_moves_tells_nothing() {
    let cameras = ring(3);
    let mut random = SplitMix64(11);
    let tracks: Vec<SilhouetteTrack> = cameras
        .iter()
        .map(|camera| {
            let (mut track, rays) = (SilhouetteTrack::new(camera), rays(camera));
            for n in 0..240 {
                let tremble = 0.004 * random.unit();
                track.add(n * PERIOD, &mask(camera, &rays, &[(DVec3::new(0.0, 0.0, 1.0 + tremble), 0.4)]));
            }
            track
        })
        .collect();
    let lags: Vec<_> = estimate_silhouette_lags(&tracks, 250_000_000).into_iter().map(|e| e.lag_nanos).collect();
    assert_eq!(lags, [Some(0), None, None]);
}

#[test]
fn too_little_and_senseless_input_is_borne() {
    assert!(estimate_silhouette_lags(&[], 1).is_empty());
    let cameras = ring(2);
    let good = mask(&cameras[0], &rays(&cameras[0]), &balls(0.0, 1));
    let [width, height] = cameras[0].size();
    let mut odd = SilhouetteTrack::new(&cameras[0]);
    odd.add(5, &Mask::new(width, height, vec![0; (width * height) as usize]).unwrap());
    odd.add(5, &Mask::new(height, width, vec![255; (width * height) as usize]).unwrap());
    assert!(odd.masks() == 0);
    odd.add(5, &good);
    odd.add(5, &good);
    odd.add(4, &good);
    assert_eq!(odd.masks(), 1);
    // All of the image: every corner is cut.
    odd.add(i64::MAX, &Mask::new(width, height, vec![255; (width * height) as usize]).unwrap());
    assert_eq!(odd.masks(), 2);
    let mut blind = SilhouetteTrack::new(&Camera {
        intrinsics: Intrinsics { focal_px: DVec2::splat(f64::NAN), ..cameras[0].intrinsics },
        ..cameras[0].clone()
    });
    blind.add(0, &good);
    let twice = [odd.clone(), odd.clone(), blind, SilhouetteTrack::new(&cameras[1])];
    let lags: Vec<_> = estimate_silhouette_lags(&twice, i64::MAX).into_iter().map(|e| e.lag_nanos).collect();
    assert_eq!(lags, [Some(0), None, None, None]);
}

#[test]
fn regular_movement_has_more_than_one_lag_and_none_is_reported() {
    let cameras = ring(2);
    let rays: Vec<Vec<DVec3>> = cameras.iter().map(rays).collect();
    let told = |rate: f64| {
        let tracks: Vec<SilhouetteTrack> = (cameras.iter().zip(&rays))
            .map(|(camera, rays)| {
                let mut track = SilhouetteTrack::new(camera);
                for n in 0..240 {
                    let height = 1.0 + 0.2 * (rate * (n * PERIOD) as f64 * 1e-9).sin();
                    track.add(n * PERIOD, &mask(camera, rays, &[(DVec3::new(0.0, 0.0, height), 0.4)]));
                }
                track
            })
            .collect();
        estimate_silhouette_lags(&tracks, 250_000_000)[1].lag_nanos
    };
    // Five times a second, and once in two seconds, of which half a second either way shows no second one.
    assert_eq!(told(31.4), None);
    assert!(told(3.0).is_some_and(|lag| lag.abs() < 2_000_000));
}

#[test]
fn pairs_are_joined_by_their_weights() {
    // Four cameras that know each other well, and the first one badly: the mean of what it says counts.
    let mut pairs: Vec<PairLag> = [10.0, -6.0, -5.0, -7.0]
        .into_iter()
        .enumerate()
        .map(|(i, lag)| PairLag { first: 0, second: i + 1, lag, weight: 1.0 })
        .collect();
    for first in 1..5 {
        pairs.extend((first + 1..5).map(|second| PairLag { first, second, lag: 0.0, weight: 700.0 }));
    }
    let lags = balanced(6, &pairs);
    assert!((1..5).all(|slot| lags[slot].lag.is_some_and(|lag| (lag + 2.0).abs() < 0.1)), "{lags:?}");
    assert!((1..5).all(|slot| (lags[slot].variance - 0.25).abs() < 0.01), "{lags:?}");
    assert!(lags[5].lag.is_none() && lags[0].lag == Some(0.0));
}
