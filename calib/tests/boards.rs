//! Calibration from simulated corners against the truth.

use flyrig_calib::{
    Board, BoardShot, BoardView, CalibError, LensModel, Pattern, RigFit, RigOptions, calibrate_lens, calibrate_rig,
    testing::{Random, bent_shots, pose_errors, ring, shots, view},
};
use flyrig_solve::{PointPair, align_rigid};
use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Lens};
use glam::{DMat3, DQuat, DVec2, DVec3};

const SIZE: [u32; 2] = [1280, 720];

fn board() -> Board {
    Board { columns: 9, rows: 6, square_mm: 40.0, pattern: Pattern::Chessboard }
}

fn ids(cameras: &[Camera]) -> Vec<CameraId> {
    cameras.iter().map(|camera| camera.id.clone()).collect()
}

fn lenses(cameras: &[Camera]) -> Vec<Intrinsics> {
    cameras.iter().map(|camera| camera.intrinsics).collect()
}

#[test]
fn a_rig_is_found_from_boards_and_knows_how_well() {
    let (mut inside, mut all) = (0, 0);
    for (seed, count) in [(1, 3), (2, 4), (3, 6), (4, 8)] {
        let mut random = Random(seed);
        let cameras = ring(&mut random, count);
        let shots = shots(&mut random, &board(), &cameras, 60, 0.2);
        let fit = calibrate_rig(&board(), &ids(&cameras), &lenses(&cameras), &shots, RigOptions::default()).unwrap();
        assert!((0.17..0.23).contains(&fit.sigma_px), "{count} cameras: {} px", fit.sigma_px);
        for (camera, (deg, mm)) in fit.cameras[1..].iter().zip(pose_errors(&fit.rig.cameras, &cameras)) {
            let (deg_sigma, mm_sigma) = camera.deviation.unwrap();
            assert!(deg < 0.1 && mm < 4.0, "{count} cameras: {deg} degrees, {mm} mm");
            inside += usize::from(deg < 2.0 * deg_sigma) + usize::from(mm < 2.0 * mm_sigma);
            all += 2;
        }
        let (_, ratio) = fit.worst_disagreement().unwrap();
        assert!(ratio < 1.5, "{count} cameras: halves disagree {ratio} times as much as noise explains");
    }
    // Lengths of three numbers, of which two standard deviations hold more than 95 %.
    assert!(inside * 100 >= 90 * all, "{inside} of {all} within two standard deviations");
}

#[test]
fn a_bent_board_is_found_out() {
    let mut random = Random(11);
    let cameras = ring(&mut random, 5);
    let solve = |shots: &[BoardShot], bend| {
        let options = RigOptions { bend, ..RigOptions::default() };
        calibrate_rig(&board(), &ids(&cameras), &lenses(&cameras), shots, options).unwrap()
    };
    let bent = bent_shots(&mut random, (&board(), 0.004), &cameras, 60, 0.1);
    let (flat, heeded) = (solve(&bent, false), solve(&bent, true));
    let (mm, sigma) = heeded.bend_mm.unwrap();
    assert!((mm - 4.0).abs() < 4.0 * sigma && sigma < 0.2, "{mm} +-{sigma}");
    assert!((0.085..0.115).contains(&heeded.sigma_px) && flat.sigma_px > 0.15, "{} {}", heeded.sigma_px, flat.sigma_px);
    let worst = |fit: &RigFit| {
        let errors = pose_errors(&fit.rig.cameras, &cameras);
        errors.into_iter().map(|(_, mm)| mm).fold(0.0, f64::max)
    };
    assert!(worst(&heeded) < worst(&flat), "{} {}", worst(&heeded), worst(&flat));
    // Of a flat one nothing is claimed.
    let plain = shots(&mut random, &board(), &cameras, 60, 0.1);
    let (mm, sigma) = solve(&plain, true).bend_mm.unwrap();
    assert!(mm < 5.0 * sigma, "{mm} +-{sigma}");
}

/// Simulates views of a tilted board in front of a camera, up to `reach` metres from the optical axis.
fn before(random: &mut Random, camera: &Camera, count: usize, reach: f64) -> Vec<BoardView> {
    let mut views = Vec::new();
    while views.len() < count {
        let tilt = DQuat::from_scaled_axis(DVec3::new(random.normal(), random.normal(), random.normal()) * 0.4);
        let place = DVec3::new(
            random.between(-reach, reach),
            random.between(-0.6 * reach, 0.6 * reach),
            random.between(0.5, 1.2),
        );
        let pose = Isometry::new(tilt, place - tilt * board().middle());
        let back = camera.camera_from_world.inverse();
        let pose = Isometry::new(back.rotation * pose.rotation, back.transform_point(pose.translation));
        if let Some(mut view) = view(random, &board(), camera, 0, &pose, 0.15) {
            view.nanos = views.len() as i64;
            views.push(view);
        }
    }
    views
}

#[test]
fn a_fisheye_and_a_wide_lens_are_found() {
    for (lens, focal, expected) in [
        (Lens::Fisheye { coefficients: [0.03, -0.008, 0.002, -0.0004] }, 420.0, LensModel::Fisheye),
        (
            Lens::Rational { radial: [6.0, 1.5, 0.02, 6.4, 3.1, 0.15], tangential: [0.006, -0.004] },
            520.0,
            LensModel::Rational,
        ),
    ] {
        let mut random = Random(15);
        let mut camera = ring(&mut random, 1).remove(0);
        camera.intrinsics.lens = lens;
        camera.intrinsics.focal_px = DVec2::new(focal, 1.003 * focal);
        let views = before(&mut random, &camera, 60, 1.4);
        let fit = calibrate_lens(&board(), &camera.id, SIZE, &views).unwrap();
        assert_eq!(fit.model, expected, "{:?}", fit.held_out_px);
        assert!((0.12..0.18).contains(&fit.sigma_px), "{}", fit.sigma_px);
        // Rays agree over all that boards covered, out to the corners; a turn of the camera, which poses take up, apart.
        let ray = |i: &Intrinsics, pixel: DVec2| {
            i.lens.undistort((pixel - i.center_px) / i.focal_px).map(|ideal| ideal.extend(1.0).normalize())
        };
        let grid = || {
            (0..7).flat_map(|x| {
                (0..5).map(move |y| DVec2::new(100.0 + 180.0 * f64::from(x), 80.0 + 140.0 * f64::from(y)))
            })
        };
        let rays = |i: &Intrinsics| grid().map(|pixel| ray(i, pixel).unwrap()).collect::<Vec<_>>();
        let (found, truth) = (rays(&fit.intrinsics), rays(&camera.intrinsics));
        // With every ray's opposite, centroids are zero and the alignment is a turn alone.
        let opposite = |side: f64| {
            move |(from, to): (&DVec3, &DVec3)| PointPair { from: *from * side, to: *to * side, weight: 1.0 }
        };
        let rays = || found.iter().zip(&truth);
        let pairs: Vec<PointPair> = rays().map(opposite(1.0)).chain(rays().map(opposite(-1.0))).collect();
        let turn = align_rigid(&pairs).unwrap().motion().rotation;
        let off: Vec<f64> = rays().map(|(found, truth)| (turn * *found).angle_between(*truth) * focal).collect();
        let rms = (off.iter().map(|px| px * px).sum::<f64>() / off.len() as f64).sqrt();
        let worst = off.iter().copied().fold(0.0, f64::max);
        let deviation = fit.deviations_px.into_iter().fold(0.0, f64::max);
        assert!(deviation < 2.0 && rms < 1.5 * deviation && worst < 3.0 * deviation, "{rms} {worst} {deviation} px");
    }
}

#[test]
fn a_lens_is_found_with_the_coefficients_that_pay() {
    let mut random = Random(5);
    let camera = ring(&mut random, 1).remove(0);
    let views = before(&mut random, &camera, 40, 0.5);
    let fit = calibrate_lens(&board(), &camera.id, SIZE, &views).unwrap();
    let truth = camera.intrinsics;
    let off = (fit.intrinsics.focal_px - truth.focal_px).abs();
    assert!(off.max_element() < 3.0 * fit.deviations_px[0].max(fit.deviations_px[1]), "{off} {:?}", fit.deviations_px);
    assert!(off.max_element() < 4.0, "{off}");
    assert!(
        matches!(fit.model, LensModel::RadialTangential | LensModel::RadialTangential3 | LensModel::Radial2),
        "{:?}",
        fit.held_out_px
    );
    // Over the part of the image that boards covered, rays agree.
    for x in [200.0, 640.0, 1080.0] {
        for y in [150.0, 360.0, 570.0] {
            let ray = |i: &Intrinsics| {
                i.lens.undistort((DVec2::new(x, y) - i.center_px) / i.focal_px).unwrap().extend(1.0).normalize()
            };
            let px = ray(&fit.intrinsics).angle_between(ray(&truth)) * truth.focal_px.x;
            assert!(px < 8.0, "{px} px at {x} {y}: a shift that the pose takes up");
        }
    }
    assert!(fit.suspects.is_empty() && fit.coverage > 0.5);

    // One image repeated, and two images.
    let repeated = vec![views[0].clone(); 30];
    let error = calibrate_lens(&board(), &camera.id, SIZE, &repeated).unwrap_err().to_string();
    assert!(error.contains("1 of them different"), "{error}");
    assert!(matches!(
        calibrate_lens(&board(), &camera.id, SIZE, &views[..2]),
        Err(CalibError::TooFewViews { found: 2, different: 2, .. })
    ));
}

#[test]
fn boards_without_tilt_leave_the_lens_open() {
    let mut random = Random(6);
    let camera = Camera { camera_from_world: Isometry::IDENTITY, ..ring(&mut random, 1).remove(0) };
    let views: Vec<BoardView> = (0..20)
        .filter_map(|i| {
            let turn = DQuat::from_rotation_z(0.2 * f64::from(i));
            let middle = DVec3::new(random.between(-0.2, 0.2), random.between(-0.1, 0.1), 1.0);
            view(&mut random, &board(), &camera, 0, &Isometry::new(turn, middle - turn * board().middle()), 0.2)
        })
        .collect();
    assert!(views.len() > 5);
    let error = calibrate_lens(&board(), &camera.id, SIZE, &views).unwrap_err().to_string();
    assert!(error.contains("tilt the board"), "{error}");
}

#[test]
fn cameras_that_share_no_board_are_listed_in_groups() {
    let mut random = Random(7);
    let cameras = ring(&mut random, 4);
    let mut shots = shots(&mut random, &board(), &cameras, 80, 0.2);
    for shot in &mut shots {
        let low = shot.views[0].camera < 2;
        shot.views.retain(|view| (view.camera < 2) == low);
    }
    let error = calibrate_rig(&board(), &ids(&cameras), &lenses(&cameras), &shots, RigOptions::default()).unwrap_err();
    assert!(error.to_string().contains("[00 01] and [02 03]"), "{error}");
    for nothing in [&[][..], &shots[..0]] {
        assert!(calibrate_rig(&board(), &ids(&cameras), &lenses(&cameras), nothing, RigOptions::default()).is_err());
    }
}

#[test]
fn wrong_views_and_poisoned_corners_are_left_out() {
    let mut random = Random(8);
    let cameras = ring(&mut random, 4);
    let mut shots = shots(&mut random, &board(), &cameras, 60, 0.2);
    // One view in twelve shows the board turned by half, as a wrong detection does, and some corners are nowhere.
    let last = board().corner_count() - 1;
    for (i, shot) in shots.iter_mut().enumerate() {
        if i % 12 == 5 {
            shot.views[0].corners.iter_mut().for_each(|corner| corner.index = last - corner.index);
        }
        if i % 10 == 3 {
            shot.views[1].corners[7].pixel += DVec2::new(40.0, -25.0);
        }
    }
    shots[20].views[0].corners[0].pixel = DVec2::NAN;
    shots[21].views[0].corners.truncate(2);
    shots[22].views.clear();
    let fit = calibrate_rig(&board(), &ids(&cameras), &lenses(&cameras), &shots, RigOptions::default()).unwrap();
    for (deg, mm) in pose_errors(&fit.rig.cameras, &cameras) {
        assert!(deg < 0.15 && mm < 6.0, "{deg} degrees, {mm} mm");
    }
}

#[test]
fn time_offsets_are_found_from_a_board_that_moves() {
    let mut random = Random(9);
    let cameras = ring(&mut random, 4);
    let lags_s = [0.0, 0.031, -0.045, 0.012];
    // A board that swings on a smooth path, 15 shots a second.
    let pose_at = |secs: f64| {
        // Upright, facing all cameras in turn, tilted to and fro.
        let turn = DQuat::from_rotation_z(0.9 * secs)
            * DQuat::from_rotation_x(0.4 * (1.7 * secs).sin() - std::f64::consts::FRAC_PI_2)
            * DQuat::from_rotation_z(0.3 * (1.3 * secs).sin());
        let middle = DVec3::new(0.4 * (1.3 * secs).sin(), 0.4 * (0.8 * secs).cos(), 0.8 + 0.2 * (1.9 * secs).sin());
        Isometry::new(turn, middle - turn * board().middle())
    };
    let mut shots = Vec::new();
    for i in 0..300 {
        let nanos = i * 66_000_000;
        let mut views = Vec::new();
        for (slot, camera) in cameras.iter().enumerate() {
            // Its stamp says `nanos`, but it was taken `lag` earlier.
            let pose = pose_at(nanos as f64 * 1e-9 - lags_s[slot]);
            if let Some(seen) = view(&mut random, &board(), camera, slot, &pose, 0.2) {
                views.push(BoardView { nanos, ..seen });
            }
        }
        if !views.is_empty() {
            shots.push(BoardShot { nanos, views });
        }
    }
    let solve = |lags| {
        let options = RigOptions { lags, ..RigOptions::default() };
        calibrate_rig(&board(), &ids(&cameras), &lenses(&cameras), &shots, options).unwrap()
    };
    let (without, with) = (solve(false), solve(true));
    assert!(with.sigma_px < 0.25 && without.sigma_px > 1.5 * with.sigma_px, "{} {}", without.sigma_px, with.sigma_px);
    for (camera, lag) in with.cameras.iter().zip(lags_s) {
        let (found, sigma) = camera.lag_s;
        assert!((found - lag).abs() < 0.001 + 3.0 * sigma && sigma < 0.001, "{found} +-{sigma}, in truth {lag}");
    }
    for (deg, mm) in pose_errors(&with.rig.cameras, &cameras) {
        assert!(deg < 0.1 && mm < 4.0, "{deg} degrees, {mm} mm");
    }
}

#[test]
fn the_board_on_the_floor_gives_height_and_up() {
    let mut random = Random(10);
    let cameras = ring(&mut random, 4);
    let mut shots = shots(&mut random, &board(), &cameras, 40, 0.1);
    // Lies on the floor with its face up: its z axis points down.
    let turn = DQuat::from_mat3(&DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0))) * DQuat::from_rotation_z(0.4);
    let pose = Isometry::new(turn, DVec3::new(0.1, -0.1, 0.0) - turn * board().middle());
    let views: Vec<BoardView> = cameras
        .iter()
        .enumerate()
        .filter_map(|(slot, camera)| view(&mut random, &board(), camera, slot, &pose, 0.1))
        .collect();
    assert!(views.len() > 1);
    shots.insert(0, BoardShot { nanos: -1_000_000_000, views });
    let options = RigOptions { floor_first: true, ..RigOptions::default() };
    let fit = calibrate_rig(&board(), &ids(&cameras), &lenses(&cameras), &shots, options).unwrap();
    for (found, truth) in fit.rig.cameras.iter().zip(&cameras) {
        assert!((found.position().z - truth.position().z).abs() < 0.006, "{} {}", found.position(), truth.position());
    }
}
