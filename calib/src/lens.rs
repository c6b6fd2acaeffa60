//! Calibration of one lens from a board in many poses; the lens model is chosen by the error of held-out views.

use flyrig_solve::RigidMotion;
use flyrig_types::{CameraId, Intrinsics, Lens};
use glam::{DVec2, DVec3};

use crate::adjust::{Adjusted, adjust};
use crate::board::Board;
use crate::bundle::{BoardShot, BoardView, Estimate, Free, SolvedCamera};
use crate::error::CalibError;
use crate::homography::{focal_length, homography};
use crate::projection::LensModel;
use crate::start::{board_poses, rms};

/// Most views in a solve, those that differ most.
const MOST_VIEWS: usize = 60;
/// Fewest views that determine a lens.
const LEAST_VIEWS: usize = 4;
/// Largest movement of corners between two views that count as equal, pixels.
const SAME_PX: f64 = 1.0;
/// Interval of the views that are held out of the solves that choose the lens model.
const HOLD_OUT_EVERY: usize = 4;
/// Fraction of the held-out error of the simpler model below which a richer one is chosen.
const WORTH: f64 = 0.97;
/// Initial focal lengths tried besides the estimated one, in widths of the image.
const FOCAL_WIDTHS: [f64; 5] = [0.33, 0.5, 0.8, 1.2, 2.0];
/// Angle of corners from the optical axis above which a fisheye is tried, radians: closer to it, all lenses are alike.
const FISHEYE_FROM_RAD: f64 = 0.45;
/// Largest accepted standard deviation of the focal length, relative to it.
const MOST_FOCAL_SHARE: f64 = 0.02;
/// Multiple of the median view's error above which a view is reported as suspect.
const SUSPECT: f64 = 3.0;
/// Cells of the image, across and down, that corners should cover.
const CELLS: (usize, usize) = (8, 6);

/// Calibrated lens and its accuracy.
#[derive(Debug, Clone)]
pub struct LensFit {
    /// The lens.
    pub intrinsics: Intrinsics,
    /// Model of its coefficients.
    pub model: LensModel,
    /// Root mean square reprojection error, pixels.
    pub rms_px: f64,
    /// Standard deviation of a corner's coordinate without outliers, pixels.
    pub sigma_px: f64,
    /// Standard deviations of fx, fy, cx, cy, pixels.
    pub deviations_px: [f64; 4],
    /// Error of held-out views per lens model, pixels.
    pub held_out_px: Vec<(LensModel, f64)>,
    /// Timestamps of the views that were used and their errors, pixels.
    pub views: Vec<(i64, f64)>,
    /// Timestamps of views that fit far worse than the others.
    pub suspects: Vec<i64>,
    /// Fraction of the image's cells that corners cover, in 0..=1.
    pub coverage: f64,
}

/// Calibrates a lens.
///
/// # Errors
/// [`CalibError::TooFewViews`], [`CalibError::LensOpen`] where the boards leave it undetermined.
pub fn calibrate_lens(
    board: &Board,
    camera: &CameraId,
    size: [u32; 2],
    views: &[BoardView],
) -> Result<LensFit, CalibError> {
    let chosen = different_views(views, MOST_VIEWS);
    if chosen.len() < LEAST_VIEWS {
        let (camera, found, different) = (camera.clone(), views.len(), chosen.len());
        return Err(CalibError::TooFewViews { camera, found, different, needed: LEAST_VIEWS });
    }
    let points: Vec<DVec3> = (0..board.corner_count()).map(|index| board.corner(index)).collect();
    let open = || CalibError::LensOpen { camera: camera.clone() };
    let straight = first_guess(board, &points, size, &chosen, LensModel::Radial1);
    let is_wide = straight.is_none_or(|lens| widest_angle(&lens, &chosen) > FISHEYE_FROM_RAD);
    let fisheye = if is_wide { first_guess(board, &points, size, &chosen, LensModel::Fisheye) } else { None };
    let rough = |model| if model == LensModel::Fisheye { fisheye } else { straight };
    let (kept_out, kept): (Vec<_>, Vec<_>) = chosen.iter().enumerate().partition(|(i, _)| i % HOLD_OUT_EVERY == 1);
    let unpack = |views: Vec<(usize, &BoardView)>| views.into_iter().map(|(_, view)| view.clone()).collect::<Vec<_>>();
    let (kept_out, kept) = (unpack(kept_out), unpack(kept));
    let mut held_out_px = Vec::new();
    let mut best: Option<(LensModel, f64)> = None;
    for model in LensModel::ALL {
        let Some(rough) = rough(model) else { continue };
        let Some(fit) = solve(board, &points, &rough, &kept, Some(model)) else { continue };
        let lens = fit.estimate.cameras[0].intrinsics;
        let Some(test) = solve(board, &points, &lens, &kept_out, None) else { continue };
        let error = test.sigma_px;
        held_out_px.push((model, error));
        if best.is_none_or(|(_, least)| error < WORTH * least) {
            best = Some((model, error));
        }
    }
    let model = best.ok_or_else(open)?.0;
    let fit = rough(model).and_then(|rough| solve(board, &points, &rough, &chosen, Some(model))).ok_or_else(open)?;
    let intrinsics = fit.estimate.cameras[0].intrinsics;
    let covariance = fit.covariance.as_ref().ok_or_else(open)?;
    let deviation = |k: usize| covariance[(k, k)].max(0.0).sqrt();
    let deviations_px = [0, 1, 2, 3].map(deviation);
    if !(deviations_px[0] < MOST_FOCAL_SHARE * intrinsics.focal_px.x
        && deviations_px[1] < MOST_FOCAL_SHARE * intrinsics.focal_px.y)
    {
        return Err(open());
    }
    let of_view = |off: &Vec<Vec<DVec2>>| rms(off.iter().flatten().map(|off| off.length()));
    let errors: Vec<f64> = fit.off_px.iter().map(of_view).collect();
    let stamps = chosen.iter().map(|view| view.nanos);
    let mut sorted = errors.clone();
    let median = flyrig_solve::median(&mut sorted).unwrap_or(0.0);
    let suspects = stamps.clone().zip(&errors).filter(|(_, error)| **error > SUSPECT * median).map(|(nanos, _)| nanos);
    Ok(LensFit {
        suspects: suspects.collect(),
        intrinsics,
        model,
        rms_px: rms(fit.errors_px()),
        sigma_px: fit.sigma_px,
        deviations_px,
        held_out_px,
        views: stamps.zip(errors).collect(),
        coverage: coverage(size, views),
    })
}

/// Returns the fraction of the image's cells with a corner.
fn coverage(size: [u32; 2], views: &[BoardView]) -> f64 {
    let mut cells = vec![false; CELLS.0 * CELLS.1];
    for corner in views.iter().flat_map(|view| &view.corners) {
        let cell =
            |at: f64, side: u32, count: usize| ((at / f64::from(side) * count as f64).max(0.0) as usize).min(count - 1);
        cells[cell(corner.pixel.y, size[1], CELLS.1) * CELLS.0 + cell(corner.pixel.x, size[0], CELLS.0)] = true;
    }
    cells.iter().filter(|cell| **cell).count() as f64 / cells.len() as f64
}

/// Selects up to `most` views that show the board differently from each other, in the order of time.
pub(crate) fn different_views(views: &[BoardView], most: usize) -> Vec<BoardView> {
    // Four numbers that change with the board's place, size and tilt, pixels.
    let sketch = |view: &BoardView| -> [DVec2; 4] {
        let pixels: Vec<DVec2> = view.corners.iter().map(|corner| corner.pixel).collect();
        let middle = pixels.iter().sum::<DVec2>() / pixels.len().max(1) as f64;
        let farthest = |along: DVec2| {
            let key = |p: &&DVec2| (**p - middle).dot(along);
            pixels.iter().max_by(|a, b| key(a).total_cmp(&key(b))).copied().unwrap_or(middle)
        };
        [middle, farthest(DVec2::X), farthest(DVec2::Y), farthest(DVec2::new(-1.0, -1.0))]
    };
    let sketches: Vec<[DVec2; 4]> = views.iter().map(sketch).collect();
    let apart =
        |a: usize, b: usize| sketches[a].iter().zip(&sketches[b]).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
    // Always the one that differs most from all chosen ones.
    let mut distance = vec![f64::INFINITY; views.len()];
    let mut chosen = Vec::new();
    while chosen.len() < most {
        let usable = (0..views.len()).filter(|&i| distance[i] > SAME_PX && !views[i].corners.is_empty());
        let Some(next) = usable.max_by(|&a, &b| distance[a].total_cmp(&distance[b]).then(b.cmp(&a))) else { break };
        chosen.push(next);
        for (i, distance) in distance.iter_mut().enumerate() {
            *distance = distance.min(apart(next, i));
        }
    }
    chosen.sort_unstable();
    chosen.into_iter().map(|i| views[i].clone()).collect()
}

/// Returns the largest angle between the optical axis and a corner's ray, radians; 90 degrees where a corner has none.
fn widest_angle(lens: &Intrinsics, views: &[BoardView]) -> f64 {
    let angle = |pixel: DVec2| {
        let ideal = lens.lens.undistort((pixel - lens.center_px) / lens.focal_px);
        ideal.map_or(std::f64::consts::FRAC_PI_2, |ideal| ideal.length().atan())
    };
    views.iter().flat_map(|view| &view.corners).map(|corner| angle(corner.pixel)).fold(0.0, f64::max)
}

/// Fits a lens of few coefficients from several focal lengths and returns the best.
fn first_guess(
    board: &Board,
    points: &[DVec3],
    size: [u32; 2],
    views: &[BoardView],
    model: LensModel,
) -> Option<Intrinsics> {
    let center = DVec2::new(f64::from(size[0]) - 1.0, f64::from(size[1]) - 1.0) * 0.5;
    let planes: Vec<_> = views
        .iter()
        .filter_map(|view| {
            let pairs: Vec<_> = view
                .corners
                .iter()
                .map(|corner| (board.corner(corner.index).truncate(), (corner.pixel - center) / f64::from(size[0])))
                .collect();
            homography(&pairs)
        })
        .collect();
    let focal_px = focal_length(&planes).into_iter().filter(|widths| (0.1..20.0).contains(widths)).chain(FOCAL_WIDTHS);
    let mut best: Option<(f64, Intrinsics)> = None;
    for widths in focal_px {
        let start = Intrinsics {
            width: size[0],
            height: size[1],
            focal_px: DVec2::splat(widths * f64::from(size[0])),
            center_px: center,
            lens: model.start(Lens::PINHOLE),
        };
        let Some(fit) = solve(board, points, &start, views, Some(model)) else { continue };
        if best.is_none_or(|(error, _)| fit.sigma_px < error) {
            best = Some((fit.sigma_px, fit.estimate.cameras[0].intrinsics));
        }
    }
    best.map(|(_, intrinsics)| intrinsics)
}

/// Solves for the boards and, where a model is given, the lens.
fn solve(
    board: &Board,
    points: &[DVec3],
    lens: &Intrinsics,
    views: &[BoardView],
    model: Option<LensModel>,
) -> Option<Adjusted> {
    let lens = &Intrinsics { lens: model.map_or(lens.lens, |model| model.start(lens.lens)), ..*lens };
    let (mut shots, mut boards) = (Vec::new(), Vec::new());
    for view in views {
        // A lens that is still wrong leaves large errors: any pose that puts the board before the camera is a start.
        if let Some(pose) = board_poses(board, lens, view).first() {
            shots.push(BoardShot { nanos: view.nanos, views: vec![BoardView { camera: 0, ..view.clone() }] });
            boards.push(*pose);
        }
    }
    // Every view counts: a focal length that fits half of them is no better.
    if boards.len() < views.len().min(LEAST_VIEWS) || boards.is_empty() || boards.len() < views.len() * 3 / 4 {
        return None;
    }
    let camera = SolvedCamera { camera_from_rig: RigidMotion::IDENTITY, intrinsics: *lens, lag_s: 0.0 };
    let start = Estimate { cameras: vec![camera], boards, bend_m: [0.0; 3] };
    adjust(points, &shots, start, Free { lens: model, ..Free::default() })
}
