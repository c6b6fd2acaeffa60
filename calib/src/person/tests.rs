#![allow(clippy::unwrap_used)] // helpers of tests
use super::*;
use crate::testing::{Random, rig_errors, ring};
use flyrig_solve::{BlockProblem as _, jacobian_error};
use glam::DVec2;

/// Limbs of a stick figure, as pairs of landmarks.
const LIMBS: [(usize, usize); 9] = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 5), (5, 6), (0, 7), (7, 8), (8, 9)];

/// Returns the landmarks of a figure that wanders and swings its limbs, metres.
fn figure(t: f64) -> [DVec3; 10] {
    let mut points = [DVec3::ZERO; 10];
    points[0] = DVec3::new(0.4 * (0.9 * t).sin(), 0.4 * (0.7 * t).cos(), 1.0 + 0.1 * (2.1 * t).sin());
    for (i, (a, b)) in LIMBS.iter().enumerate() {
        let phase = i as f64;
        let (turn, rise) = (0.7 * phase + 1.2 * (1.7 * t + phase).sin(), 1.1 * (1.3 * t + 2.0 * phase).sin());
        let along = DVec3::new(turn.cos() * rise.cos(), turn.sin() * rise.cos(), rise.sin());
        points[*b] = points[*a] + along * 0.35;
    }
    points
}

/// Returns the true rig of `count` cameras, a wrong calibration of it, and tracks of the figure with time offsets `lags`.
fn scene(seed: u64, count: usize, noise_px: f64, lags: &[f64], with_outlines: bool) -> (Rig, Rig, PersonTracks) {
    let mut random = Random(seed);
    let truth = Rig { cameras: ring(&mut random, count), world_up: DVec3::Z };
    let mut tracks = PersonTracks::new(count, 10);
    for (slot, camera) in truth.cameras.iter().enumerate() {
        // Errors of a network persist over time.
        let biases: Vec<DVec2> = (0..10).map(|_| DVec2::new(random.normal(), random.normal()) * noise_px).collect();
        for image in 0..240 {
            let t = image as f64 / 30.0 + 0.004 * slot as f64;
            let seen: Vec<_> = figure(t)
                .iter()
                .zip(&biases)
                .map(|(point, bias)| {
                    let noise = DVec2::new(random.normal(), random.normal()) * noise_px;
                    camera.project(*point).map(|pixel| (pixel + noise + *bias, 0.9))
                })
                .collect();
            let stamp = ((t + lags[slot]) * 1e9) as i64;
            tracks.add(slot, stamp, &seen);
            if with_outlines {
                let corner = |point: &DVec3| {
                    let noise = DVec3::new(random.normal(), random.normal(), 0.0) * (noise_px / 900.0);
                    let local = camera.camera_from_world.transform_point(*point);
                    OutlineCorner { ray: (local / local.z + noise).normalize(), is_cut: false }
                };
                tracks.add_outline(slot, stamp, figure(t).iter().map(corner).collect());
            }
        }
    }
    let mut believed = truth.clone();
    for camera in &mut believed.cameras {
        let motion = RigidMotion {
            rotation: camera.camera_from_world.rotation,
            translation: camera.camera_from_world.translation,
        };
        let moved = motion.moved(random.vector().normalize() * 0.0174, DVec3::ZERO);
        let place = motion.inverse().translation + random.vector().normalize() * 0.02;
        camera.camera_from_world = Isometry::new(moved.rotation, -(moved.rotation * place));
    }
    (truth, believed, tracks)
}

/// Returns the error of the worst camera over the volume, pixels.
fn worst_px(rig: &Rig, truth: &Rig) -> f64 {
    rig_errors(&rig.cameras, &truth.cameras).unwrap().iter().map(|error| error.px).fold(0.0, f64::max)
}

#[test]
fn cameras_that_are_a_degree_off_and_late_are_found() {
    let lags = [0.0, 0.053, -0.031, 0.012];
    let mut ratios = Vec::new();
    for (seed, with_outlines, most_px, most_s) in [(5, false, 1.5, 0.006), (6, true, 1.0, 0.004), (7, true, 1.0, 0.004)]
    {
        let (truth, believed, tracks) = scene(seed, 4, 1.0, &lags, with_outlines);
        let fit = calibrate_person(&believed, &tracks, &LIMBS, &[], PersonOptions::default()).unwrap();
        let (before, after) = (worst_px(&believed, &truth), worst_px(&fit.rig, &truth));
        println!("seed {seed}, outlines {with_outlines}: worst camera {before:.2} px before, {after:.2} after");
        assert!(before > 5.0 && after < most_px, "seed {seed}: {before} {after}");
        let (kept_before, kept_after) = fit.kept_back.unwrap();
        println!("kept back: {kept_before:?} -> {kept_after:?}");
        assert!(kept_after.error_px < kept_before.error_px, "{kept_before:?} {kept_after:?}");
        assert_eq!(kept_after.planes_rad.is_some(), with_outlines);
        if let (Some(before), Some(after)) = (kept_before.planes_rad, kept_after.planes_rad) {
            assert!(after < 0.5 * before, "{before} {after}");
        }
        for (camera, lag) in fit.cameras.iter().zip(lags) {
            println!("offset {:.1} ms, in truth {:.1}", 1e3 * camera.lag_s.0, 1e3 * lag);
            assert!((camera.lag_s.0 - lag).abs() < most_s, "seed {seed}: {camera:?} {lag}");
        }
        for ((found, truth), camera) in motions(&fit.rig).iter().zip(motions(&truth)).zip(&fit.cameras) {
            let turn = log_rotation(found.rotation * truth.rotation.inverse()).length().to_degrees();
            let place = 1e3 * found.inverse().translation.distance(truth.inverse().translation);
            println!("off by {turn:.3} degrees and {place:.1} mm, deviations {:?}", camera.deviation);
            ratios.extend([turn / camera.deviation.0, place / camera.deviation.1]);
        }
        // The world stays where it was: cameras move by about what they were off.
        assert!(fit.cameras.iter().all(|camera| camera.moved.1 < 60.0), "{:?}", fit.cameras);
    }
    // Standard deviations are neither far too small nor far too large.
    let mean = (ratios.iter().map(|ratio| ratio * ratio).sum::<f64>() / ratios.len() as f64).sqrt();
    assert!((0.25..2.0).contains(&mean) && ratios.iter().all(|ratio| *ratio < 4.0), "{mean}: {ratios:?}");
}

#[test]
fn right_cameras_stay_where_they_are_and_the_bumped_one_is_found() {
    let (truth, _, tracks) = scene(9, 4, 1.0, &[0.0; 4], true);
    let mut believed = truth.clone();
    let old = motions(&truth)[2].moved(DVec3::new(0.0, 0.0174, 0.0), DVec3::new(0.02, 0.0, 0.0));
    believed.cameras[2].camera_from_world = Isometry::new(old.rotation, old.translation);
    let fit = calibrate_person(&believed, &tracks, &LIMBS, &[], PersonOptions::default()).unwrap();
    let others = fit.cameras.iter().enumerate().filter(|(slot, _)| *slot != 2).map(|(_, camera)| camera.moved_px);
    let most = others.fold(0.0, f64::max);
    println!("the bumped camera moved by {:.2} px, the others by {most:.2} at most", fit.cameras[2].moved_px);
    assert!(fit.cameras[2].moved_px > 3.0 * most, "{:?}", fit.cameras);
    assert!(worst_px(&fit.rig, &truth) < 1.0);
}

#[test]
fn left_and_right_that_one_camera_takes_for_each_other_are_exchanged() {
    let (truth, _, tracks) = scene(4, 4, 0.5, &[0.0; 4], false);
    let mirrored = vec![vec![(2, 6), (4, 9)]];
    let mut mixed = tracks.clone();
    for nanos in mixed.times(1).into_iter().skip(60).take(50) {
        mixed.exchange(1, 2, 6, nanos);
        mixed.exchange(1, 4, 9, nanos);
    }
    assert_ne!(mixed, tracks);
    let (mended, corrections) = untangled(&truth, &mixed, &mirrored);
    assert!(corrections >= 45, "{corrections}");
    let wrong =
        tracks.times(1).iter().filter(|nanos| mended.sample(1, 2, **nanos) != tracks.sample(1, 2, **nanos)).count();
    assert!(wrong < 5, "{wrong} of 50 images are still mixed up");
    assert_eq!(untangled(&truth, &tracks, &mirrored), (tracks, 0), "what is right stays");
}

#[test]
fn too_little_to_see_is_an_error() {
    let (truth, _, tracks) = scene(4, 3, 0.5, &[0.0; 3], true);
    let solve = |tracks: &PersonTracks| {
        calibrate_person(&truth, tracks, &LIMBS, &[], PersonOptions::default()).unwrap_err().to_string()
    };
    let empty = PersonTracks::new(3, 10);
    assert!(solve(&empty).contains("is not seen by two cameras"), "{}", solve(&empty));
    // One camera alone.
    let mut alone = PersonTracks::new(3, 10);
    for i in 0..200 {
        alone.add(1, i * 33_000_000, &[Some((DVec2::new(300.0 + i as f64, 200.0), 1.0)); 10]);
    }
    assert!(solve(&alone).contains("is not seen by two cameras"));
    assert!(solve(&tracks.part(0.0, 0.02)).contains("is not seen by two cameras"));
    let others = PersonTracks::new(2, 10);
    assert!(
        solve(&others).contains("tracks of 2 cameras with 10 landmarks for a rig of 3 cameras"),
        "{}",
        solve(&others)
    );
    let few = PersonTracks::new(3, 5);
    assert!(solve(&few).contains("tracks of 3 cameras with 5 landmarks"), "{}", solve(&few));
    // A statue.
    let mut still = PersonTracks::new(3, 10);
    for (slot, camera) in truth.cameras.iter().enumerate() {
        let seen = figure(1.0).map(|point| camera.project(point).map(|pixel| (pixel, 1.0)));
        (0..100).for_each(|i| still.add(slot, i * 33_000_000, &seen));
    }
    assert!(solve(&still).contains("the person hardly moves"), "{}", solve(&still));
    // Landmarks in the air: no pose explains them, and nothing that is not finite comes out.
    let mut random = Random(3);
    let mut noise = PersonTracks::new(3, 10);
    for i in 0..100 {
        for camera in 0..3 {
            let anywhere = || Some((DVec2::new(random.between(0.0, 1280.0), random.between(0.0, 720.0)), 1.0));
            noise.add(camera, i * 33_000_000, &std::iter::repeat_with(anywhere).take(10).collect::<Vec<_>>());
        }
    }
    if let Ok(fit) = calibrate_person(&truth, &noise, &LIMBS, &[], PersonOptions::default()) {
        fit.rig.validate().unwrap();
    }
}

#[test]
fn derivatives_are_those_of_finite_differences() {
    let (_, believed, tracks) = scene(3, 3, 0.0, &[0.0, 0.02, -0.01], true);
    let intrinsics: Vec<Intrinsics> = believed.cameras.iter().map(|camera| camera.intrinsics).collect();
    let intervals_s = [1.0 / 30.0; 3];
    let old = motions(&believed);
    let mut estimate = PersonEstimate { cameras: old.clone(), lags_s: vec![0.0; 3], points: Vec::new() };
    let instants = instants(&intrinsics, &tracks, &intervals_s, &estimate).unwrap()[..3].to_vec();
    estimate.points = vec![vec![DVec3::ZERO; 10]; 3];
    let mut known = Known {
        intrinsics: &intrinsics,
        tracks: &tracks,
        intervals_s: &intervals_s,
        instants: &instants,
        limbs: &LIMBS,
        before: estimate.clone(),
        prior: (0.02, 0.05),
        lag_sigma_s: 0.1,
        lags: true,
        ahead: believed.center_of_attention(),
    };
    triangulate(&known, &mut estimate);
    known.before.points.clone_from(&estimate.points);
    let spread =
        Spread { landmark_px: vec![1.5; 10], limbs_m: vec![Some((0.33, 0.01)); LIMBS.len()], touch: 1e-3, weight: 0.7 };
    let problem = PersonProblem::new(&known, &spread, &estimate);
    let mut random = Random(8);
    let step: Vec<f64> = (0..problem.block_sizes().iter().sum()).map(|_| 0.01 * random.normal()).collect();
    let at = problem.moved(&estimate, &step);
    assert!(problem.residual_count() > 100);
    let mut off_by_lags = Vec::new();
    for index in 0..problem.residual_count() {
        let error = jacobian_error(&problem, &at, index, 1e-6).unwrap();
        if problem.is_touch(index) {
            off_by_lags.push(error);
        } else {
            assert!(error < 2e-2, "residual {index}: {error}");
        }
    }
    // The parabola through outermost corners is only nearly what the next window gives.
    assert!(off_by_lags.len() > 10 && median(&mut off_by_lags).unwrap() < 0.25, "{off_by_lags:?}");
    let without_lags = Known { lags: false, ..known.clone() };
    let problem = PersonProblem::new(&without_lags, &spread, &estimate);
    for index in (0..problem.residual_count()).filter(|index| problem.is_touch(*index)) {
        let error = jacobian_error(&problem, &estimate, index, 1e-7).unwrap();
        assert!(error < 1e-3, "residual {index}: {error}");
    }
}
