//! Calibration of a whole rig from a board that its cameras see together. The rig is also solved from either half of
//! the shots, as a check.

use flyrig_solve::{RigidMotion, log_rotation};
use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Rig};
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::SMatrix;

use crate::adjust::{Adjusted, adjust};
use crate::board::Board;
use crate::bundle::{BoardShot, BoardView, Estimate, Free, bend_shares};
use crate::error::CalibError;
use crate::projection::LensModel;
use crate::start::{Pair, rig_start, rms};
use crate::uncertainty::{Uncertainty, pose_deviation};

/// Options of [`calibrate_rig`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RigOptions {
    /// Lens coefficients to refine; `None` keeps the lenses.
    pub lens: Option<LensModel>,
    /// Whether to estimate a time offset per camera.
    pub lags: bool,
    /// Whether to estimate the bend of the board.
    pub bend: bool,
    /// Whether the first shot's board lies on the floor, which gives height 0 and the up direction.
    pub floor_first: bool,
}

/// Camera of a calibrated rig.
#[derive(Debug, Clone, PartialEq)]
pub struct RigCamera {
    /// Root mean square reprojection error, pixels.
    pub rms_px: f64,
    /// Corners that it saw, of all shots.
    pub corners: Vec<CornerError>,
    /// Number of views of the board.
    pub views: usize,
    /// Standard deviation of its orientation and position relative to the first camera: degrees, millimetres. `None`
    /// where the views leave it undetermined.
    pub deviation: Option<(f64, f64)>,
    /// Uncertainty across its image and in the centre of the boards; `None` where the views leave the pose
    /// undetermined.
    pub uncertainty: Option<Uncertainty>,
    /// Difference of its orientation and position between the solves from either half of the shots: degrees,
    /// millimetres.
    pub halves: Option<(f64, f64)>,
    /// Time offset, subtracted from its timestamps, and its standard deviation; seconds.
    pub lag_s: (f64, f64),
}

/// Observed corner of a board and its reprojection error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CornerError {
    /// Observed pixel.
    pub pixel: DVec2,
    /// Reprojection error (projected minus observed), pixels.
    pub off_px: DVec2,
}

/// Calibrated rig and its accuracy.
#[derive(Debug, Clone)]
pub struct RigFit {
    /// Cameras, in a world in metres with z up.
    pub rig: Rig,
    /// Results per camera, in rig order.
    pub cameras: Vec<RigCamera>,
    /// Pairs of cameras that saw the board together.
    pub pairs: Vec<Pair>,
    /// Root mean square reprojection error, pixels.
    pub rms_px: f64,
    /// Standard deviation of a corner's coordinate without outliers, pixels.
    pub sigma_px: f64,
    /// Depth range of the board's surface and its standard deviation, where a bend was estimated; millimetres.
    pub bend_mm: Option<(f64, f64)>,
    /// Times of the shots, nanoseconds, and their errors, pixels.
    pub shots: Vec<(i64, f64)>,
}

impl RigFit {
    /// Returns the largest ratio of the difference between the halves to the part that noise explains (two standard
    /// deviations of each), with its camera. Above 1 there is another cause: a time offset, blur, a bent board, a lens.
    #[must_use]
    pub fn worst_disagreement(&self) -> Option<(usize, f64)> {
        let ratio = |camera: &RigCamera| {
            let ((deg, mm), (deg_sigma, mm_sigma)) = (camera.halves?, camera.deviation?);
            // Each half has twice the variance, and their difference twice that again.
            Some((deg / (4.0 * deg_sigma)).max(mm / (4.0 * mm_sigma)))
        };
        let ratios = self.cameras.iter().enumerate().filter_map(|(slot, camera)| Some((slot, ratio(camera)?)));
        ratios.max_by(|a, b| a.1.total_cmp(&b.1))
    }
}

/// Calibrates a rig whose lenses are at least roughly known.
///
/// # Errors
/// [`CalibError::NotLinked`], [`CalibError::RigOpen`].
pub fn calibrate_rig(
    board: &Board,
    ids: &[CameraId],
    intrinsics: &[Intrinsics],
    shots: &[BoardShot],
    options: RigOptions,
) -> Result<RigFit, CalibError> {
    if intrinsics.len() != ids.len() || ids.is_empty() {
        return Err(CalibError::RigOpen);
    }
    let is_known = |view: &&BoardView| view.camera < ids.len();
    let known = |shot: &BoardShot| BoardShot { views: shot.views.iter().filter(is_known).cloned().collect(), ..*shot };
    let shots: Vec<BoardShot> = shots.iter().map(known).collect();
    let (start, pairs, shots) = rig_start(board, &shots, ids, intrinsics)?;
    let points: Vec<DVec3> = (0..board.corner_count()).map(|index| board.corner(index)).collect();
    let free = Free { lens: options.lens, lags: options.lags, bend: options.bend };
    let fit = adjust(&points, &shots, start, free).ok_or(CalibError::RigOpen)?;
    let halves: Vec<Option<Estimate>> =
        [0, 1].map(|half| half_solve(&points, &shots, &fit.estimate, free, half)).into();
    let boards = &fit.estimate.boards;
    let middle = boards.iter().map(|pose| pose.apply(board.middle())).sum::<DVec3>() / boards.len().max(1) as f64;
    let cameras = (0..ids.len()).map(|slot| camera(&fit, &shots, free, slot, &halves, middle)).collect();
    let up = world_up(&fit, options.floor_first);
    let world = world_from_rig(board, &fit, up, options.floor_first);
    let rig = Rig {
        cameras: ids
            .iter()
            .zip(&fit.estimate.cameras)
            .map(|(id, solved)| {
                let motion = solved.camera_from_rig * world.inverse();
                Camera {
                    time_offset_nanos: 0,
                    color: Default::default(),
                    id: id.clone(),
                    intrinsics: solved.intrinsics,
                    camera_from_world: Isometry::new(motion.rotation, motion.translation),
                }
            })
            .collect(),
        world_up: DVec3::Z,
    };
    rig.validate().map_err(|_| CalibError::RigOpen)?;
    let of_shot = |off: &Vec<Vec<DVec2>>| rms(off.iter().flatten().map(|off| off.length()));
    Ok(RigFit {
        cameras,
        pairs,
        rms_px: rms(fit.errors_px()),
        sigma_px: fit.sigma_px,
        bend_mm: options.bend.then(|| bend_mm(&points, &fit)),
        shots: shots.iter().map(|shot| shot.nanos).zip(fit.off_px.iter().map(of_shot)).collect(),
        rig,
    })
}

/// Solves again from alternate shots.
fn half_solve(points: &[DVec3], shots: &[BoardShot], at: &Estimate, free: Free, half: usize) -> Option<Estimate> {
    let every_second = |i: &usize| i % 2 == half;
    let part: Vec<BoardShot> = (0..shots.len()).filter(every_second).map(|i| shots[i].clone()).collect();
    let boards = (0..shots.len()).filter(every_second).map(|i| at.boards[i]).collect();
    let start = Estimate { cameras: at.cameras.clone(), boards, bend_m: at.bend_m };
    let seen = |slot: usize| part.iter().flat_map(|shot| &shot.views).any(|view| view.camera == slot);
    if !(0..at.cameras.len()).all(seen) {
        return None;
    }
    let fit = adjust(points, &part, start, free)?;
    fit.covariance.as_ref()?;
    Some(fit.estimate)
}

fn camera(
    fit: &Adjusted,
    shots: &[BoardShot],
    free: Free,
    slot: usize,
    halves: &[Option<Estimate>],
    middle: DVec3,
) -> RigCamera {
    let mut corners = Vec::new();
    let mut views = 0;
    for (shot, of_shot) in shots.iter().zip(&fit.off_px) {
        for (view, of_view) in shot.views.iter().zip(of_shot) {
            if view.camera == slot {
                let errors = view.corners.iter().zip(of_view);
                corners.extend(errors.map(|(seen, off)| CornerError { pixel: seen.pixel, off_px: *off }));
                views += 1;
            }
        }
    }
    let solved = &fit.estimate.cameras[slot];
    let pose = solved.camera_from_rig;
    let covariance = fit.covariance.as_ref().map(|covariance| match slot {
        // The others are measured against the first one.
        0 => SMatrix::zeros(),
        _ => covariance.fixed_view::<6, 6>(6 * (slot - 1), 6 * (slot - 1)).into_owned(),
    });
    let deviation = covariance.map(|covariance| pose_deviation(&covariance, &pose));
    let uncertainty = covariance.map(|covariance| Uncertainty::new(&covariance, &pose, &solved.intrinsics, middle));
    let difference = |a: &RigidMotion, b: &RigidMotion| {
        let turn = log_rotation(a.rotation * b.rotation.inverse()).length().to_degrees();
        (turn, 1e3 * a.inverse().translation.distance(b.inverse().translation))
    };
    let halves = match halves {
        [Some(a), Some(b)] => Some(difference(&a.cameras[slot].camera_from_rig, &b.cameras[slot].camera_from_rig)),
        _ => None,
    };
    let lag_sigma = fit.covariance.as_ref().filter(|_| free.lags && slot > 0).map_or(0.0, |covariance| {
        let others = fit.estimate.cameras.len() - 1;
        let at = covariance.nrows() - 3 * usize::from(free.bend) - others + slot - 1;
        covariance[(at, at)].max(0.0).sqrt()
    });
    RigCamera {
        rms_px: rms(corners.iter().map(|corner| corner.off_px.length())),
        corners,
        views,
        deviation,
        uncertainty,
        halves,
        lag_s: (fit.estimate.cameras[slot].lag_s, lag_sigma),
    }
}

/// Returns the size of the bend: the depth range of the surface over the corners, and the standard deviation of the
/// least certain corner.
fn bend_mm(points: &[DVec3], fit: &Adjusted) -> (f64, f64) {
    let shares = bend_shares(points);
    let depth = |share: &[f64; 3]| fit.estimate.bend_m.iter().zip(share).map(|(bend, share)| bend * share).sum::<f64>();
    let (least, most) =
        shares.iter().map(depth).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), z| (a.min(z), b.max(z)));
    let deviation = fit.covariance.as_ref().map_or(f64::INFINITY, |covariance| {
        let block = covariance.fixed_view::<3, 3>(covariance.nrows() - 3, covariance.nrows() - 3);
        let of = |share: &[f64; 3]| {
            let share = nalgebra::Vector3::from(*share);
            (share.transpose() * block * share)[(0, 0)].max(0.0).sqrt()
        };
        shares.iter().map(of).fold(0.0, f64::max)
    });
    (1e3 * (most - least), 1e3 * deviation)
}

/// Returns the up direction in the rig's axes: normal to the board on the floor, or the cameras' mean up direction.
fn world_up(fit: &Adjusted, floor_first: bool) -> DVec3 {
    match fit.estimate.boards.first().filter(|_| floor_first) {
        Some(first) => first.rotation * DVec3::NEG_Z,
        None => {
            let above = |camera: &crate::bundle::SolvedCamera| camera.camera_from_rig.rotation.inverse() * DVec3::NEG_Y;
            fit.estimate.cameras.iter().map(above).sum::<DVec3>().normalize_or(DVec3::NEG_Y)
        }
    }
}

/// Returns the transform to world axes: z up; the origin is the centre of the board on the floor, or of all boards; the
/// first camera looks along y.
fn world_from_rig(board: &Board, fit: &Adjusted, up: DVec3, floor_first: bool) -> RigidMotion {
    let middle = |pose: &RigidMotion| pose.apply(board.middle());
    let boards = &fit.estimate.boards;
    let origin = match boards.first().filter(|_| floor_first) {
        Some(first) => middle(first),
        None => boards.iter().map(middle).sum::<DVec3>() / boards.len().max(1) as f64,
    };
    let forward = (DVec3::Z - up * up.z).try_normalize().unwrap_or_else(|| up.any_orthonormal_vector());
    let right = forward.cross(up);
    let world_from_rig = DMat3::from_cols(right, forward, up).transpose();
    let rotation = DQuat::from_mat3(&world_from_rig).normalize();
    RigidMotion { rotation, translation: -(rotation * origin) }
}
