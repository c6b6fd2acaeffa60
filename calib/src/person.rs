//! Calibration of a rig from one person who moves in front of it: better poses of the cameras and their time offsets.
//!
//! Landmarks and silhouettes of the person are found in each camera independently. The unknowns are the cameras' poses, one time
//! offset per camera, and the positions of the landmarks at up to a few hundred instants. The residuals are reprojection errors of the
//! landmarks, deviations from constant limb lengths, and differences between the outermost epipolar planes that are tangent to the
//! silhouettes of two cameras. The old calibration is a prior, which also fixes world frame and scale.

mod problem;
mod rays;
mod smoothing;
mod tangents;
mod tracks;
mod untangle;

use flyrig_solve::{Convergence, RigidMotion, block_covariance, log_rotation, median, minimize_blocks};
use flyrig_types::{Camera, Intrinsics, Isometry, Rig};
use glam::DVec3;
use nalgebra::SMatrix;

use crate::error::CalibError;
use crate::projection::project;
use crate::uncertainty::pose_deviation;
use problem::{Known, PersonEstimate, PersonProblem, Spread};
use rays::{Ray, motions, nearest};
pub use tangents::OutlineCorner;
pub use tracks::PersonTracks;
use untangle::untangled;

/// Minimum interval between two instants, seconds.
const INSTANT_S: f64 = 0.025;
/// Maximum number of instants times cameras.
const MOST_IMAGES: usize = 800;
/// Number of instants with independent errors; more instants share this weight, since the network repeats its errors in similar images.
const INDEPENDENT: f64 = 3.0;
/// Fewest landmarks seen by two cameras at an instant.
const LEAST_LANDMARKS: usize = 6;
/// Fewest instants of a solve.
const LEAST_INSTANTS: usize = 10;
/// Rounds of estimating spreads and lengths.
const ROUNDS: usize = 5;
/// Standard deviation of a coordinate over the median distance of a two-dimensional normal error.
const SIGMA_PER_MEDIAN: f64 = 1.0 / 1.177;
/// Standard deviation over the median absolute deviation of a normal distribution.
const SIGMA_PER_DEVIATION: f64 = 1.48;
/// Least standard deviation of a landmark, pixels.
const LEAST_SIGMA_PX: f64 = 0.5;
/// Weight of the standard deviation over all landmarks in that of one landmark, in measurements.
const POOLED: f64 = 10.0;
/// Least standard deviation of a limb's length, metres: landmarks lie on clothes and skin.
const LEAST_LIMB_M: f64 = 0.005;
/// Least extent over which a quarter of the landmarks must move, metres.
const LEAST_EXTENT_M: f64 = 0.1;
/// Least standard deviation of the angle between tangent planes, radians.
const LEAST_TOUCH: f64 = 5e-4;
/// Options of [`calibrate_person`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PersonOptions {
    /// Whether to estimate time offsets.
    pub lags: bool,
    /// Standard deviation of a camera's orientation in the old calibration, radians.
    pub turn_sigma: f64,
    /// Standard deviation of a camera's position in it, metres.
    pub place_sigma_m: f64,
    /// Standard deviation of a time offset, seconds.
    pub lag_sigma_s: f64,
}

impl Default for PersonOptions {
    fn default() -> Self {
        Self { lags: true, turn_sigma: 0.01, place_sigma_m: 0.02, lag_sigma_s: 0.1 }
    }
}

/// Camera after [`calibrate_person`].
#[derive(Debug, Clone, PartialEq)]
pub struct PersonCamera {
    /// Median reprojection error of the landmarks with the old calibration and now, pixels.
    pub error_px: (f64, f64),
    /// Rotation, degrees, and displacement, millimetres, from the old pose.
    pub moved: (f64, f64),
    /// Standard deviation of its direction and place, with the old calibration as a prior: degrees, millimetres.
    pub deviation: (f64, f64),
    /// Mean displacement of the person in this camera's image caused by the change of pose, pixels.
    pub moved_px: f64,
    /// Mean displacement between solves of the first and the second half of the take, pixels; `None` if one of them
    /// fails.
    pub halves_px: Option<f64>,
    /// Time offset, to be subtracted from the timestamps, and its standard deviation; seconds.
    pub lag_s: (f64, f64),
    /// Difference between the time offsets of the two halves, seconds.
    pub lag_halves_s: Option<f64>,
}

/// How well the cameras agree on a person.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Agreement {
    /// Median reprojection error of the landmarks, pixels.
    pub error_px: f64,
    /// Standard deviation of the angle between outermost tangent planes of two cameras, radians; `None` without silhouettes.
    pub planes_rad: Option<f64>,
}

/// Result of [`calibrate_person`].
#[derive(Debug, Clone, PartialEq)]
pub struct PersonFit {
    /// The refined rig in the world frame of the old calibration.
    pub rig: Rig,
    /// Cameras per slot.
    pub cameras: Vec<PersonCamera>,
    /// Number of instants used.
    pub instants: usize,
    /// Median standard deviation of a landmark's coordinate, pixels.
    pub sigma_px: f64,
    /// Standard deviation of the angle between outermost tangent planes of two cameras, with the old calibration and now; radians.
    /// `None` without silhouettes.
    pub planes_rad: Option<(f64, f64)>,
    /// Agreement with the old calibration and now, over both halves of the take, each judged by the solve of the other half. `None` where
    /// a half has too few instants.
    pub kept_back: Option<(Agreement, Agreement)>,
    /// Left-right confusions of the network that were corrected: groups of limbs in an image.
    pub corrections: usize,
}

/// Refines poses and time offsets of a rig from one moving person. `limbs` are pairs of landmarks at a constant distance; `mirrored` are
/// groups of (left, right) landmarks that the network confuses together.
///
/// # Errors
/// [`CalibError::PersonTracks`] for tracks of another rig, [`CalibError::PersonOpen`] when too few cameras see the
/// person at the same time, [`CalibError::PersonStill`] when the person stands still.
pub fn calibrate_person(
    rig: &Rig,
    tracks: &PersonTracks,
    limbs: &[(usize, usize)],
    mirrored: &[Vec<(usize, usize)>],
    options: PersonOptions,
) -> Result<PersonFit, CalibError> {
    let pairs = || limbs.iter().chain(mirrored.iter().flatten());
    if tracks.cameras() != rig.cameras.len() || pairs().any(|(a, b)| *a.max(b) >= tracks.landmarks()) {
        return Err(CalibError::PersonTracks {
            cameras: tracks.cameras(),
            expected: rig.cameras.len(),
            landmarks: tracks.landmarks(),
        });
    }
    let (tracks, corrections) = untangled(rig, tracks, mirrored);
    let whole = solve(rig, &tracks, limbs, options, None).ok_or(CalibError::PersonOpen)?;
    let extent_m = whole.extent_m();
    if extent_m < LEAST_EXTENT_M {
        return Err(CalibError::PersonStill { extent_mm: 1e3 * extent_m });
    }
    let part = |from, to| solve(rig, &tracks.part(from, to), limbs, options, Some(&whole.estimate));
    let (first, second) = rayon::join(|| part(0.0, 0.5), || part(0.5, 1.0));
    let halves = first.zip(second);
    let kept_back = halves.as_ref().and_then(|(first, second)| kept_back(rig, &tracks, [first, second]));
    let before = motions(rig);
    let cameras = (0..rig.cameras.len())
        .map(|slot| {
            let (now, then) = (whole.estimate.cameras[slot], before[slot]);
            let shift = |a: &RigidMotion, b: &RigidMotion| whole.shift_px(rig, slot, a, b);
            let halves = halves.as_ref().map(|(a, b)| (&a.estimate, &b.estimate));
            PersonCamera {
                error_px: whole.error_px[slot],
                moved: (
                    log_rotation(now.rotation * then.rotation.inverse()).length().to_degrees(),
                    1e3 * now.inverse().translation.distance(then.inverse().translation),
                ),
                deviation: pose_deviation(&whole.poses[slot], &now),
                moved_px: shift(&then, &now),
                halves_px: halves.map(|(a, b)| shift(&a.cameras[slot], &b.cameras[slot])),
                lag_s: (whole.estimate.lags_s[slot], whole.lag_sigma_s[slot]),
                lag_halves_s: halves.map(|(a, b)| (a.lags_s[slot] - b.lags_s[slot]).abs()),
            }
        })
        .collect();
    let refined = Rig {
        cameras: rig
            .cameras
            .iter()
            .zip(&whole.estimate.cameras)
            .map(|(camera, motion)| Camera {
                camera_from_world: Isometry::new(motion.rotation, motion.translation),
                ..camera.clone()
            })
            .collect(),
        world_up: rig.world_up,
    };
    refined.validate().map_err(|_| CalibError::PersonOpen)?;
    Ok(PersonFit {
        rig: refined,
        cameras,
        instants: whole.estimate.points.len(),
        sigma_px: whole.sigma_px,
        planes_rad: whole.planes_rad,
        kept_back,
        corrections,
    })
}

/// Result of one solve.
struct Solved {
    estimate: PersonEstimate,
    lag_sigma_s: Vec<f64>,
    /// Covariance of each camera's pose: rotation vector, then shift, applied on the left.
    poses: Vec<SMatrix<f64, 6, 6>>,
    /// Median reprojection error by slot, with the old calibration and now.
    error_px: Vec<(f64, f64)>,
    sigma_px: f64,
    planes_rad: Option<(f64, f64)>,
    /// Camera, instant, and landmark of each observation.
    seen: Vec<(usize, usize, usize)>,
}

impl Solved {
    /// Returns the distance over which landmarks move, metres: the upper quartile over landmarks of the range that holds four fifths of
    /// the instants.
    fn extent_m(&self) -> f64 {
        let landmarks = self.estimate.points.first().map_or(0, Vec::len);
        let mut extents: Vec<f64> = (0..landmarks)
            .filter_map(|landmark| {
                let mut instants: Vec<usize> =
                    self.seen.iter().filter(|(.., seen)| *seen == landmark).map(|(_, instant, _)| *instant).collect();
                instants.sort_unstable();
                instants.dedup();
                let places = || instants.iter().map(|instant| self.estimate.points[*instant][landmark]);
                let middle = places().sum::<DVec3>() / instants.len().max(1) as f64;
                let mut off: Vec<f64> = places().map(|place| place.distance(middle)).collect();
                off.sort_by(f64::total_cmp);
                off.get(off.len() * 4 / 5).map(|radius| 2.0 * radius)
            })
            .collect();
        extents.sort_by(f64::total_cmp);
        extents.get(extents.len() * 3 / 4).copied().unwrap_or(0.0)
    }

    /// Returns the mean distance between the person's images under two poses of a camera, pixels.
    fn shift_px(&self, rig: &Rig, slot: usize, a: &RigidMotion, b: &RigidMotion) -> f64 {
        let project = |motion: &RigidMotion, point| project(&rig.cameras[slot].intrinsics, motion.apply(point));
        let shifts: Vec<f64> = self
            .seen
            .iter()
            .filter(|(camera, ..)| *camera == slot)
            .filter_map(|(_, instant, landmark)| {
                let point = self.estimate.points[*instant][*landmark];
                Some(project(a, point)?.distance(project(b, point)?))
            })
            .collect();
        shifts.iter().sum::<f64>() / shifts.len().max(1) as f64
    }
}

/// Judges each half's solve, and the old calibration, by the other half.
fn kept_back(rig: &Rig, tracks: &PersonTracks, halves: [&Solved; 2]) -> Option<(Agreement, Agreement)> {
    let unseen = [tracks.part(0.5, 1.0), tracks.part(0.0, 0.5)];
    let old = PersonEstimate { cameras: motions(rig), lags_s: vec![0.0; rig.cameras.len()], points: Vec::new() };
    let judge = |estimates: [&PersonEstimate; 2]| {
        let (mut errors, mut angles) = (Vec::new(), Vec::new());
        for (part, estimate) in unseen.iter().zip(estimates) {
            judge_half(rig, part, estimate, &mut errors, &mut angles)?;
        }
        let planes_rad = median(&mut angles).map(|angle| SIGMA_PER_DEVIATION * angle);
        Some(Agreement { error_px: median(&mut errors)?, planes_rad })
    };
    Some((judge([&old, &old])?, judge(halves.map(|half| &half.estimate))?))
}

/// Collects reprojection errors, pixels, and angles between tangent planes, radians, of tracks that an estimate was not made from.
fn judge_half(
    rig: &Rig,
    tracks: &PersonTracks,
    estimate: &PersonEstimate,
    errors: &mut Vec<f64>,
    angles: &mut Vec<f64>,
) -> Option<()> {
    let intrinsics: Vec<Intrinsics> = rig.cameras.iter().map(|camera| camera.intrinsics).collect();
    let intervals_s: Vec<f64> = (0..rig.cameras.len()).map(|slot| tracks.interval_s(slot)).collect();
    let instants = instants(&intrinsics, tracks, &intervals_s, estimate)?;
    let mut at = estimate.clone();
    at.points = vec![vec![DVec3::ZERO; tracks.landmarks()]; instants.len()];
    let known = Known {
        intrinsics: &intrinsics,
        tracks,
        intervals_s: &intervals_s,
        instants: &instants,
        limbs: &[],
        before: at.clone(),
        prior: (1.0, 1.0),
        lag_sigma_s: 1.0,
        lags: false,
        ahead: rig.center_of_attention(),
    };
    triangulate(&known, &mut at);
    each_error(&known, &at, |_, _, px| errors.push(px));
    let touches = (0..instants.len()).flat_map(|instant| known.touches(&at, instant));
    angles.extend(touches.map(|(.., found)| found.angle.abs()));
    Some(())
}

fn solve(
    rig: &Rig,
    tracks: &PersonTracks,
    limbs: &[(usize, usize)],
    options: PersonOptions,
    start: Option<&PersonEstimate>,
) -> Option<Solved> {
    let cameras = rig.cameras.len();
    let intrinsics: Vec<Intrinsics> = rig.cameras.iter().map(|camera| camera.intrinsics).collect();
    let intervals_s: Vec<f64> = (0..cameras).map(|slot| tracks.interval_s(slot)).collect();
    let old = motions(rig);
    let mut estimate = PersonEstimate {
        cameras: start.map_or_else(|| old.clone(), |start| start.cameras.clone()),
        lags_s: start.map_or_else(|| vec![0.0; cameras], |start| start.lags_s.clone()),
        points: Vec::new(),
    };
    let instants = instants(&intrinsics, tracks, &intervals_s, &estimate)?;
    estimate.points = vec![vec![DVec3::ZERO; tracks.landmarks()]; instants.len()];
    let mut known = Known {
        intrinsics: &intrinsics,
        tracks,
        intervals_s: &intervals_s,
        instants: &instants,
        limbs,
        before: PersonEstimate { cameras: old, lags_s: vec![0.0; cameras], points: Vec::new() },
        prior: (options.turn_sigma, options.place_sigma_m),
        lag_sigma_s: options.lag_sigma_s,
        lags: options.lags,
        ahead: rig.center_of_attention(),
    };
    let mut spread = Spread {
        landmark_px: vec![LEAST_SIGMA_PX; tracks.landmarks()],
        limbs_m: vec![None; limbs.len()],
        touch: LEAST_TOUCH,
        weight: (INDEPENDENT / instants.len() as f64).min(1.0),
    };
    triangulate(&known, &mut estimate);
    let first_errors = errors_by_camera(&known, &estimate);
    let first_planes = planes_rad(&known, &estimate);
    let mut seen = Vec::new();
    let mut lag_sigma_s = vec![0.0; cameras];
    let mut poses = Vec::new();
    for round in 0..ROUNDS {
        known.before.points.clone_from(&estimate.points);
        estimate_spread(&known, &estimate, &mut spread, round > 0);
        let problem = PersonProblem::new(&known, &spread, &estimate);
        let is_last = round + 1 == ROUNDS;
        let convergence =
            Convergence { max_steps: if is_last { 40 } else { 15 }, min_gain: 1e-7, ..Convergence::default() };
        estimate = minimize_blocks(&problem, &estimate, &convergence).ok()?.unknowns;
        if is_last {
            seen = problem.seen().collect();
            let covariance = block_covariance(&problem, &estimate)?;
            poses = (0..cameras).map(|slot| covariance.fixed_view::<6, 6>(6 * slot, 6 * slot).into_owned()).collect();
            for (slot, sigma) in lag_sigma_s.iter_mut().enumerate().skip(1).filter(|_| options.lags) {
                let at = 6 * cameras + slot - 1;
                *sigma = covariance[(at, at)].max(0.0).sqrt();
            }
        }
    }
    let after = errors_by_camera(&known, &estimate);
    Some(Solved {
        error_px: first_errors.into_iter().zip(after).collect(),
        sigma_px: median(&mut spread.landmark_px)?,
        planes_rad: first_planes.zip(planes_rad(&known, &estimate)),
        estimate,
        lag_sigma_s,
        poses,
        seen,
    })
}

/// Returns evenly spaced times at which two cameras see enough landmarks.
fn instants(
    intrinsics: &[Intrinsics],
    tracks: &PersonTracks,
    intervals_s: &[f64],
    at: &PersonEstimate,
) -> Option<Vec<i64>> {
    let (first, last) = tracks.span()?;
    let span_s = last.saturating_sub(first) as f64 * 1e-9;
    let most = (MOST_IMAGES / intrinsics.len().max(1)).max(LEAST_INSTANTS);
    let step = (INSTANT_S.max(span_s / most as f64) * 1e9) as i64;
    let count = usize::try_from(last.saturating_sub(first) / step.max(1)).ok()?;
    let is_good = |nanos: &i64| {
        let seen = |landmark: usize| {
            let sees = |camera: &usize| {
                let stamp = nanos.saturating_add((at.lags_s[*camera] * 1e9) as i64);
                tracks.track(*camera, landmark).at(stamp, intervals_s[*camera]).is_some()
            };
            (0..intrinsics.len()).filter(sees).count() > 1
        };
        (0..tracks.landmarks()).filter(|landmark| seen(*landmark)).count() >= LEAST_LANDMARKS
    };
    let instants: Vec<i64> = (0..=count as i64).map(|i| first.saturating_add(i * step)).filter(is_good).collect();
    (instants.len() >= LEAST_INSTANTS).then_some(instants)
}

/// Triangulates all landmarks with the current poses.
fn triangulate(known: &Known<'_>, estimate: &mut PersonEstimate) {
    let mut points = estimate.points.clone();
    for (instant, points) in points.iter_mut().enumerate() {
        for (landmark, point) in points.iter_mut().enumerate() {
            let mut rays = Vec::new();
            for camera in 0..estimate.cameras.len() {
                let Some(place) = known.place(estimate, instant, camera, landmark) else { continue };
                let (intrinsics, motion) = (&known.intrinsics[camera], &estimate.cameras[camera]);
                rays.extend(Ray::new(intrinsics, motion, place.pixel, place.confidence));
            }
            // Landmarks without a place count for nothing.
            *point = nearest(&rays).unwrap_or(known.ahead);
        }
    }
    estimate.points = points;
}

/// Returns the median reprojection error by camera, over landmarks seen by two cameras.
fn errors_by_camera(known: &Known<'_>, at: &PersonEstimate) -> Vec<f64> {
    let mut errors = vec![Vec::new(); at.cameras.len()];
    each_error(known, at, |camera, _, px| errors[camera].push(px));
    errors.iter_mut().map(|errors| median(errors).unwrap_or(f64::NAN)).collect()
}

/// Calls `each` with camera, landmark and reprojection error of landmarks seen by at least two cameras.
fn each_error(known: &Known<'_>, at: &PersonEstimate, mut each: impl FnMut(usize, usize, f64)) {
    for instant in 0..at.points.len() {
        for landmark in 0..known.tracks.landmarks() {
            let errors: Vec<(usize, f64)> = (0..at.cameras.len())
                .filter_map(|camera| Some((camera, known.error(at, instant, camera, landmark)?.length())))
                .collect();
            if errors.len() > 1 {
                errors.into_iter().for_each(|(camera, px)| each(camera, landmark, px));
            }
        }
    }
}

/// Returns the robust standard deviation of the angles between outermost tangent planes, radians; `None` without silhouettes.
fn planes_rad(known: &Known<'_>, at: &PersonEstimate) -> Option<f64> {
    let touches = (0..at.points.len()).flat_map(|instant| known.touches(at, instant));
    let mut angles: Vec<f64> = touches.map(|(.., found)| found.angle.abs()).collect();
    Some(SIGMA_PER_DEVIATION * median(&mut angles)?)
}

/// Estimates the standard deviations of landmarks, planes and limb lengths from the residuals.
fn estimate_spread(known: &Known<'_>, at: &PersonEstimate, spread: &mut Spread, with_limbs: bool) {
    let mut errors = vec![Vec::new(); known.tracks.landmarks()];
    each_error(known, at, |_, landmark, px| errors[landmark].push(px));
    let mut all: Vec<f64> = errors.iter().flatten().copied().collect();
    let pooled = SIGMA_PER_MEDIAN * median(&mut all).unwrap_or(LEAST_SIGMA_PX);
    for (errors, sigma) in errors.iter_mut().zip(&mut spread.landmark_px) {
        let count = errors.len() as f64;
        let own = SIGMA_PER_MEDIAN * median(errors).unwrap_or(pooled);
        let square = (count * own * own + POOLED * pooled * pooled) / (count + POOLED);
        *sigma = square.sqrt().max(LEAST_SIGMA_PX);
    }
    spread.touch = planes_rad(known, at).unwrap_or(0.0).max(LEAST_TOUCH);
    // Limb lengths need points that are already refined.
    if !with_limbs {
        return;
    }
    for ((a, b), limb) in known.limbs.iter().zip(&mut spread.limbs_m) {
        let is_seen = |instant: usize, landmark: usize| {
            (0..at.cameras.len()).filter(|&camera| known.place(at, instant, camera, landmark).is_some()).count() > 1
        };
        let mut lengths: Vec<f64> = (0..at.points.len())
            .filter(|&instant| is_seen(instant, *a) && is_seen(instant, *b))
            .map(|instant| at.points[instant][*a].distance(at.points[instant][*b]))
            .collect();
        *limb = if lengths.len() < LEAST_INSTANTS {
            None
        } else {
            median(&mut lengths).and_then(|length| {
                let mut off: Vec<f64> = lengths.iter().map(|other| (other - length).abs()).collect();
                Some((length, (SIGMA_PER_DEVIATION * median(&mut off)?).max(LEAST_LIMB_M)))
            })
        };
    }
}

#[cfg(test)]
#[path = "person/tests.rs"]
mod tests;
