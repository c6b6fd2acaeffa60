//! Calibration of a rig from one person who moves before it: better poses of the cameras and their time offsets.
//!
//! Landmarks and silhouettes of the person come from the images of each camera by itself. Sought are the cameras' poses, a time
//! offset a camera, and where the landmarks are at some hundred instants. The outermost planes through two cameras' centres that
//! touch the person must touch both silhouettes, and limbs keep their lengths. The calibration before is what holds as far as
//! images leave poses open; it also gives world frame and scale.

mod problem;
mod tangents;
mod tracks;

use flyrig_solve::{Convergence, RigidMotion, block_covariance, log_rotation, median, minimize_blocks};
use flyrig_types::{Camera, Intrinsics, Isometry, Rig};
use glam::{DMat3, DVec2, DVec3};

use crate::{CalibError, projection::project};
use problem::{Estimate, Known, PersonProblem, Spread};
pub use tangents::OutlineCorner;
pub use tracks::PersonTracks;

/// Time between two instants at least, seconds.
const INSTANT_S: f64 = 0.025;
/// Instants times cameras, at most.
const MOST_IMAGES: usize = 800;
/// Instants that say something each; more of them share their weight, for a network errs alike in images that are alike.
const INDEPENDENT: f64 = 3.0;
/// Landmarks that two cameras see at an instant that counts.
const LEAST_LANDMARKS: usize = 6;
/// Instants below which nothing is solved.
const LEAST_INSTANTS: usize = 10;
/// Rounds of estimating spreads and lengths.
const ROUNDS: usize = 5;
/// Standard deviation of a coordinate over the median distance of a two-dimensional normal error.
const SIGMA_PER_MEDIAN: f64 = 1.0 / 1.177;
/// Least standard deviation of a landmark, pixels.
const LEAST_SIGMA_PX: f64 = 0.5;
/// Measurements that the spread of all landmarks counts for, against those of a landmark's own.
const POOLED: f64 = 10.0;
/// Least standard deviation of a limb's length, metres: landmarks lie on clothes and skin.
const LEAST_LIMB_M: f64 = 0.005;

/// Least standard deviation of the angle of a plane that touches the person, radians.
const LEAST_TOUCH: f64 = 5e-4;
/// Rounds of exchanging left and right.
const UNTANGLE_ROUNDS: usize = 3;
/// Left and right are exchanged where that lowers the distances to this share.
const CLEARLY: f64 = 0.5;

/// Options of [`calibrate_person`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PersonOptions {
    /// Whether time offsets are sought.
    pub lags: bool,
    /// Standard deviation of a camera's direction in the calibration before, radians.
    pub turn_sigma: f64,
    /// Standard deviation of a camera's place in it, metres.
    pub place_sigma_m: f64,
    /// Standard deviation of a time offset, seconds.
    pub lag_sigma_s: f64,
}

impl Default for PersonOptions {
    fn default() -> Self {
        Self { lags: true, turn_sigma: 0.01, place_sigma_m: 0.02, lag_sigma_s: 0.1 }
    }
}

/// A camera after [`calibrate_person`].
#[derive(Debug, Clone, PartialEq)]
pub struct PersonCamera {
    /// Median distance of drawn and seen landmarks with the calibration before, and now; pixels.
    pub error_px: (f64, f64),
    /// How much it has turned, degrees, and moved, millimetres.
    pub moved: (f64, f64),
    /// Mean distance by which the person has moved in its image by that, pixels.
    pub moved_px: f64,
    /// The same between solves from the first and the second half of the take; `None` where one of them fails.
    pub halves_px: Option<f64>,
    /// Time offset, subtracted from its stamps, and its standard deviation; seconds.
    pub lag_s: (f64, f64),
    /// Difference of the offsets of both halves, seconds.
    pub lag_halves_s: Option<f64>,
}

/// Result of [`calibrate_person`].
#[derive(Debug, Clone, PartialEq)]
pub struct PersonFit {
    /// The rig in the world of the calibration before.
    pub rig: Rig,
    /// By slot.
    pub cameras: Vec<PersonCamera>,
    /// Instants that were used.
    pub instants: usize,
    /// Typical spread of a landmark's coordinate, pixels.
    pub sigma_px: f64,
}

/// Refines poses and time offsets of a rig from one moving person. `limbs` are pairs of landmarks at a constant
/// distance, `mirrored` groups of pairs (left, right) that the network takes for each other together.
///
/// # Errors
/// When too few cameras see the person at the same time.
pub fn calibrate_person(
    rig: &Rig,
    tracks: &PersonTracks,
    limbs: &[(usize, usize)],
    mirrored: &[Vec<(usize, usize)>],
    options: PersonOptions,
) -> Result<PersonFit, CalibError> {
    let tracks = &untangled(rig, tracks, mirrored);
    let whole = solve(rig, tracks, limbs, options, None).ok_or(CalibError::PersonOpen)?;
    let part = |from, to| solve(rig, &tracks.part(from, to), limbs, options, Some(&whole.estimate));
    let halves = part(0.0, 0.5).zip(part(0.5, 1.0));
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
    Ok(PersonFit { rig: refined, cameras, instants: whole.estimate.points.len(), sigma_px: whole.sigma_px })
}

fn motions(rig: &Rig) -> Vec<RigidMotion> {
    let of = |camera: &Camera| RigidMotion {
        rotation: camera.camera_from_world.rotation,
        translation: camera.camera_from_world.translation,
    };
    rig.cameras.iter().map(of).collect()
}

/// A solution from some of the images.
struct Solved {
    estimate: Estimate,
    lag_sigma_s: Vec<f64>,
    /// By slot: median error with the calibration before and now.
    error_px: Vec<(f64, f64)>,
    sigma_px: f64,
    /// By camera, instant, landmark: what was seen.
    seen: Vec<(usize, usize, usize)>,
}

impl Solved {
    /// Mean distance of the person in an image between two poses of its camera.
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

fn solve(
    rig: &Rig,
    tracks: &PersonTracks,
    limbs: &[(usize, usize)],
    options: PersonOptions,
    start: Option<&Estimate>,
) -> Option<Solved> {
    let cameras = rig.cameras.len();
    let intrinsics: Vec<Intrinsics> = rig.cameras.iter().map(|camera| camera.intrinsics).collect();
    let intervals_s: Vec<f64> = (0..cameras).map(|slot| tracks.interval_s(slot)).collect();
    let old = motions(rig);
    let mut estimate = Estimate {
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
        before: Estimate { cameras: old, lags_s: vec![0.0; cameras], points: Vec::new() },
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
    let mut seen = Vec::new();
    let mut lag_sigma_s = vec![0.0; cameras];
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
        estimate,
        lag_sigma_s,
        seen,
    })
}

/// Times at which enough landmarks are seen by two cameras.
fn instants(intrinsics: &[Intrinsics], tracks: &PersonTracks, intervals_s: &[f64], at: &Estimate) -> Option<Vec<i64>> {
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

/// Exchanges left and right where a camera took one for the other and the other cameras did not.
fn untangled(rig: &Rig, tracks: &PersonTracks, mirrored: &[Vec<(usize, usize)>]) -> PersonTracks {
    let cameras = motions(rig);
    let mut tracks = tracks.clone();
    for _ in 0..UNTANGLE_ROUNDS {
        let before = tracks.clone();
        let intervals_s: Vec<f64> = (0..cameras.len()).map(|slot| before.interval_s(slot)).collect();
        let rays_at = |nanos: i64, landmark: usize| -> Vec<(DVec3, DVec3, f64)> {
            let ray = |(slot, motion): (usize, &RigidMotion)| {
                let place = before.track(slot, landmark).at(nanos, intervals_s[slot])?;
                let ray = ray(&rig.cameras[slot].intrinsics, motion, place.pixel)?;
                Some((ray, motion.inverse().translation, place.confidence))
            };
            cameras.iter().enumerate().filter_map(ray).collect()
        };
        let mut is_same = true;
        for (slot, motion) in cameras.iter().enumerate() {
            let intrinsics = &rig.cameras[slot].intrinsics;
            for nanos in before.times(slot) {
                let drawn = |landmark: usize| {
                    let rays = rays_at(nanos, landmark);
                    (rays.len() > 2).then(|| project(intrinsics, motion.apply(nearest(&rays)?))).flatten()
                };
                for group in mirrored {
                    let (mut as_seen, mut exchanged) = (0.0, 0.0);
                    for (left, right) in group {
                        let seen = |landmark| before.sample(slot, landmark, nanos);
                        let (Some(a), Some(b)) = (seen(*left), seen(*right)) else { continue };
                        let (Some(left), Some(right)) = (drawn(*left), drawn(*right)) else { continue };
                        let far = 0.5 * left.distance(right).max(1.0);
                        let off = |pixel: DVec2, drawn: DVec2| (pixel.distance(drawn) / far).min(2.0);
                        as_seen += off(a, left) + off(b, right);
                        exchanged += off(b, left) + off(a, right);
                    }
                    if exchanged < CLEARLY * as_seen {
                        group.iter().for_each(|(left, right)| tracks.exchange(slot, *left, *right, nanos));
                        is_same = false;
                    }
                }
            }
        }
        if is_same {
            break;
        }
    }
    tracks
}

/// Direction of a pixel in the world.
fn ray(intrinsics: &Intrinsics, camera: &RigidMotion, pixel: DVec2) -> Option<DVec3> {
    let ideal = intrinsics.lens.undistort((pixel - intrinsics.center_px) / intrinsics.focal_px)?;
    Some(camera.rotation.inverse() * ideal.extend(1.0).normalize())
}

/// Places of the landmarks as the cameras see them now, by the shortest distances to their rays.
fn triangulate(known: &Known<'_>, estimate: &mut Estimate) {
    let center = |camera: usize| estimate.cameras[camera].inverse().translation;
    // Somewhere in view for those that nobody sees: they count for nothing.
    let fallback = {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (camera, motion) in estimate.cameras.iter().enumerate() {
            let (across, at) = plane(motion.rotation.inverse() * DVec3::Z, center(camera));
            normal += across;
            right += at;
        }
        normal.inverse() * right
    };
    let mut points = estimate.points.clone();
    for (instant, points) in points.iter_mut().enumerate() {
        for (landmark, point) in points.iter_mut().enumerate() {
            let mut rays = Vec::new();
            for camera in 0..estimate.cameras.len() {
                let Some(place) = known.place(estimate, instant, camera, landmark) else { continue };
                let Some(ray) = ray(&known.intrinsics[camera], &estimate.cameras[camera], place.pixel) else {
                    continue;
                };
                rays.push((ray, center(camera), place.confidence));
            }
            *point = nearest(&rays).unwrap_or(fallback);
        }
    }
    estimate.points = points;
}

/// Matrix across a ray, and its product with a point on the ray.
fn plane(ray: DVec3, at: DVec3) -> (DMat3, DVec3) {
    let across = DMat3::IDENTITY - DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
    (across, across * at)
}

/// Point nearest to rays, of which one that passes far away counts little.
fn nearest(rays: &[(DVec3, DVec3, f64)]) -> Option<DVec3> {
    if rays.len() < 2 {
        return None;
    }
    let mut weights: Vec<f64> = rays.iter().map(|(.., confidence)| *confidence).collect();
    let mut point = DVec3::ZERO;
    for _ in 0..8 {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for ((ray, center, _), weight) in rays.iter().zip(&weights) {
            let (across, at) = plane(*ray, *center);
            normal += across * *weight;
            right += at * *weight;
        }
        if normal.determinant() < 1e-6 * weights.iter().sum::<f64>().powi(3) {
            return None;
        }
        point = normal.inverse() * right;
        for ((ray, center, confidence), weight) in rays.iter().zip(&mut weights) {
            let off = (plane(*ray, point - *center)).1.length();
            *weight = confidence / (1.0 + (off / 0.05).powi(2));
        }
    }
    let is_ahead = rays.iter().all(|(ray, center, _)| ray.dot(point - *center) > 0.1);
    (is_ahead && point.is_finite()).then_some(point)
}

/// Median errors by camera, over landmarks that two cameras see.
fn errors_by_camera(known: &Known<'_>, at: &Estimate) -> Vec<f64> {
    let mut errors = vec![Vec::new(); at.cameras.len()];
    each_error(known, at, |camera, _, px| errors[camera].push(px));
    errors.iter_mut().map(|errors| median(errors).unwrap_or(f64::NAN)).collect()
}

/// Calls `each` with camera, landmark and error of what at least two cameras see.
fn each_error(known: &Known<'_>, at: &Estimate, mut each: impl FnMut(usize, usize, f64)) {
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

/// Spreads of landmarks and limbs as the residuals show them.
fn estimate_spread(known: &Known<'_>, at: &Estimate, spread: &mut Spread, with_limbs: bool) {
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
    let touches = (0..at.points.len()).flat_map(|instant| known.touches(at, instant));
    let mut angles: Vec<f64> = touches.map(|(.., found)| found.angle.abs()).collect();
    spread.touch = (1.48 * median(&mut angles).unwrap_or(0.0)).max(LEAST_TOUCH);
    // Lengths are worth something once the points are.
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
                Some((length, (1.48 * median(&mut off)?).max(LEAST_LIMB_M)))
            })
        };
    }
}

#[cfg(test)]
#[path = "person/tests.rs"]
mod tests;
