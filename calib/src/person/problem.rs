//! Least squares of cameras, time offsets and the landmarks of a moving person.
//!
//! All landmarks of an instant are eliminated together, since limbs join them.

use flyrig_solve::{BlockProblem, Kernel, Residual, RigidMotion, skew};
use flyrig_types::Intrinsics;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};

use super::tangents::{Eye, Side, Tangency, tangency};
use super::tracks::{PersonTracks, Place};
use crate::projection::{LensModel, project, project_with_derivatives};

/// Robust kernel of landmarks, which lose half their weight at 2 standard deviations.
const LANDMARK_KERNEL: Kernel = Kernel::Cauchy(2.0);
const LIMB_KERNEL: Kernel = Kernel::Cauchy(2.0);
/// Robust kernel of priors, so that a bumped camera shifts the others only a little.
const PRIOR_KERNEL: Kernel = Kernel::Huber(1.0);
/// Weight of a landmark relative to a tangent plane: the network's errors depend on the viewing direction and persist over time,
/// those of silhouettes hardly do (docs/benchmarks/calibration.md).
const LANDMARK_WEIGHT: f64 = 0.1;
/// Standard deviation of a landmark from its start, metres: determines landmarks seen by one camera only.
const LOOSE_M: f64 = 2.0;

/// Unknowns of the problem.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PersonEstimate {
    pub cameras: Vec<RigidMotion>,
    /// Time offsets, subtracted from the timestamps, seconds; the first camera's is fixed.
    pub lags_s: Vec<f64>,
    /// Landmarks per instant, metres in the world.
    pub points: Vec<Vec<DVec3>>,
}

/// Kind of a residual.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Term {
    /// Reprojection error of a landmark.
    Seen { instant: usize, camera: usize, landmark: usize },
    /// Angle between the tangent planes of two cameras.
    Touch { instant: usize, cameras: [usize; 2], side: Side },
    /// Deviation from a limb's length.
    Limb { instant: usize, limb: usize },
    /// Weak prior of a landmark's position.
    Loose { instant: usize, landmark: usize },
    /// Prior of a camera's pose.
    Camera(usize),
    /// Prior of a camera's time offset.
    Lag(usize),
}

/// Measurements, priors and options.
#[derive(Debug, Clone)]
pub(crate) struct Known<'a> {
    pub intrinsics: &'a [Intrinsics],
    pub tracks: &'a PersonTracks,
    /// Median interval between images by camera, seconds.
    pub intervals_s: &'a [f64],
    /// Times of the instants, nanoseconds.
    pub instants: &'a [i64],
    /// Pairs of landmarks at a constant distance.
    pub limbs: &'a [(usize, usize)],
    /// The old calibration.
    pub before: PersonEstimate,
    /// Standard deviations of a camera's orientation and position there: radians, metres.
    pub prior: (f64, f64),
    /// Standard deviation of a time offset, seconds.
    pub lag_sigma_s: f64,
    /// Whether to estimate time offsets.
    pub lags: bool,
    /// The rig's centre of attention, metres in the world.
    pub ahead: DVec3,
}

/// Standard deviations, estimated alternately with the unknowns.
#[derive(Debug, Clone)]
pub(crate) struct Spread {
    /// Per landmark, pixels.
    pub landmark_px: Vec<f64>,
    /// Length of each limb and its standard deviation, metres.
    pub limbs_m: Vec<Option<(f64, f64)>>,
    /// Standard deviation of the angle between tangent planes, radians.
    pub touch: f64,
    /// Weight of one instant, below 1 because errors of nearby instants are correlated.
    pub weight: f64,
}

/// The least squares problem.
pub(crate) struct PersonProblem<'a> {
    known: &'a Known<'a>,
    spread: &'a Spread,
    terms: Vec<Term>,
    sizes: Vec<usize>,
}

impl<'a> PersonProblem<'a> {
    pub fn new(known: &'a Known<'a>, spread: &'a Spread, at: &PersonEstimate) -> Self {
        let (cameras, landmarks) = (known.intrinsics.len(), known.tracks.landmarks());
        let mut terms: Vec<Term> = (0..cameras).map(Term::Camera).collect();
        if known.lags {
            terms.extend((1..cameras).map(Term::Lag));
        }
        for instant in 0..known.instants.len() {
            let mut is_fixed = vec![false; landmarks];
            for (landmark, is_fixed) in is_fixed.iter_mut().enumerate() {
                let seen: Vec<usize> =
                    (0..cameras).filter(|&camera| known.error(at, instant, camera, landmark).is_some()).collect();
                terms.push(Term::Loose { instant, landmark });
                if seen.len() > 1 {
                    *is_fixed = true;
                    terms.extend(seen.into_iter().map(|camera| Term::Seen { instant, camera, landmark }));
                }
            }
            terms.extend(known.touches(at, instant).map(|(cameras, side, _)| Term::Touch { instant, cameras, side }));
            let limbs = known
                .limbs
                .iter()
                .enumerate()
                .filter(|(limb, (a, b))| spread.limbs_m[*limb].is_some() && is_fixed[*a] && is_fixed[*b]);
            terms.extend(limbs.map(|(limb, _)| Term::Limb { instant, limb }));
        }
        let mut sizes = vec![6; cameras];
        if known.lags {
            sizes.extend(vec![1; cameras.saturating_sub(1)]);
        }
        sizes.extend(vec![3 * landmarks; known.instants.len()]);
        Self { known, spread, terms, sizes }
    }

    /// Returns camera, instant and landmark of each reprojection residual.
    pub fn seen(&self) -> impl Iterator<Item = (usize, usize, usize)> {
        self.terms.iter().filter_map(|term| match *term {
            Term::Seen { instant, camera, landmark } => Some((camera, instant, landmark)),
            _ => None,
        })
    }

    /// Whether a residual compares tangent planes.
    #[cfg(test)]
    pub fn is_touch(&self, index: usize) -> bool {
        matches!(self.terms[index], Term::Touch { .. })
    }

    fn seen_residual(
        &self,
        at: &PersonEstimate,
        [instant, camera, landmark]: [usize; 3],
        with_jacobians: bool,
    ) -> Option<Residual> {
        let weigh = |error: DVec2, place: Option<Place>| Residual {
            error: DVector::from_column_slice(&(error / self.spread.landmark_px[landmark]).to_array()),
            jacobians: Vec::new(),
            kernel: LANDMARK_KERNEL,
            weight: place.map_or(0.0, |place| LANDMARK_WEIGHT * self.spread.weight * place.confidence),
        };
        // A changed time offset has moved the instant beyond the end of the track.
        let Some(place) = self.known.place(at, instant, camera, landmark) else {
            return Some(weigh(DVec2::ZERO, None));
        };
        let point = at.points[instant][landmark];
        let local = at.cameras[camera].apply(point);
        if !with_jacobians {
            let pixel = project(&self.known.intrinsics[camera], local)?;
            return Some(weigh(pixel - place.pixel, Some(place)));
        }
        let projected = project_with_derivatives(&self.known.intrinsics[camera], LensModel::Radial1, local)?;
        let mut residual = weigh(projected.pixel - place.pixel, Some(place));
        let inverse = 1.0 / self.spread.landmark_px[landmark];
        let by_local = DMatrix::from_fn(2, 3, |row, column| inverse * projected.by_point[column][row]);
        let [by_turn, by_shift, by_place] = at.cameras[camera].apply_jacobian(point).map(|by| &by_local * matrix(by));
        let mut by_camera = DMatrix::zeros(2, 6);
        by_camera.columns_mut(0, 3).copy_from(&by_turn);
        by_camera.columns_mut(3, 3).copy_from(&by_shift);
        residual.jacobians.push((camera, by_camera));
        if let Some(block) = self.lag_block(camera) {
            let by_lag = DMatrix::from_column_slice(2, 1, &(-place.velocity * inverse).to_array());
            residual.jacobians.push((block, by_lag));
        }
        let mut by_points = DMatrix::zeros(2, 3 * self.known.tracks.landmarks());
        by_points.columns_mut(3 * landmark, 3).copy_from(&by_place);
        residual.jacobians.push((self.first_eliminated() + instant, by_points));
        Some(residual)
    }

    fn touch_residual(
        &self,
        at: &PersonEstimate,
        instant: usize,
        cameras: [usize; 2],
        side: Side,
        with_jacobians: bool,
    ) -> Residual {
        let inverse = 1.0 / self.spread.touch;
        let found = self.known.tangency(at, instant, cameras, side, with_jacobians);
        let mut residual = Residual {
            error: DVector::from_element(1, found.map_or(0.0, |found| found.angle * inverse)),
            jacobians: Vec::new(),
            kernel: LANDMARK_KERNEL,
            weight: if found.is_some() { self.spread.weight } else { 0.0 },
        };
        if let Some(found) = found.filter(|_| with_jacobians) {
            for ((camera, by_camera), by_lag) in cameras.into_iter().zip(found.by_cameras).zip(found.by_lags) {
                residual.jacobians.push((camera, DMatrix::from_row_slice(1, 6, &by_camera.map(|by| by * inverse))));
                if let Some(block) = self.lag_block(camera) {
                    residual.jacobians.push((block, DMatrix::from_element(1, 1, by_lag * inverse)));
                }
            }
        }
        residual
    }

    fn lag_block(&self, camera: usize) -> Option<usize> {
        (self.known.lags && camera > 0).then(|| self.known.intrinsics.len() + camera - 1)
    }

    fn limb_residual(&self, at: &PersonEstimate, instant: usize, limb: usize) -> Option<Residual> {
        let (a, b) = self.known.limbs[limb];
        let (length, sigma) = self.spread.limbs_m[limb]?;
        let points = &at.points[instant];
        let between = points[a] - points[b];
        let along = between.try_normalize().unwrap_or(DVec3::X) / sigma;
        let mut by_points = DMatrix::zeros(1, 3 * points.len());
        by_points.columns_mut(3 * a, 3).copy_from_slice(&along.to_array());
        by_points.columns_mut(3 * b, 3).copy_from_slice(&(-along).to_array());
        Some(Residual {
            error: DVector::from_element(1, (between.length() - length) / sigma),
            jacobians: vec![(self.first_eliminated() + instant, by_points)],
            kernel: LIMB_KERNEL,
            weight: self.spread.weight,
        })
    }

    fn camera_residual(&self, at: &PersonEstimate, camera: usize) -> Residual {
        let (turn_sigma, place_sigma) = self.known.prior;
        let (now, before) = (&at.cameras[camera], &self.known.before.cameras[camera]);
        let quaternion = now.rotation * before.rotation.inverse();
        let quaternion = if quaternion.w < 0.0 { -quaternion } else { quaternion };
        let turn = 2.0 * DVec3::new(quaternion.x, quaternion.y, quaternion.z);
        let moved = now.inverse().translation - before.inverse().translation;
        let error: Vec<f64> =
            (turn / turn_sigma).to_array().into_iter().chain((moved / place_sigma).to_array()).collect();
        let mut by_camera = DMatrix::zeros(6, 6);
        // After exp(δ): 2 q' = 2 q + w δ - q × δ.
        let by_turn = (DMat3::IDENTITY * quaternion.w - skew(0.5 * turn)) * (1.0 / turn_sigma);
        by_camera.view_mut((0, 0), (3, 3)).copy_from(&matrix(by_turn));
        // The place is -Rᵀ t; after exp(δ) R and t + s it is -Rᵀ (t + s + t × δ).
        let back = DMat3::from_quat(now.rotation.inverse()) * (-1.0 / place_sigma);
        by_camera.view_mut((3, 0), (3, 3)).copy_from(&matrix(back * skew(now.translation)));
        by_camera.view_mut((3, 3), (3, 3)).copy_from(&matrix(back));
        Residual {
            error: DVector::from_vec(error),
            jacobians: vec![(camera, by_camera)],
            kernel: PRIOR_KERNEL,
            weight: 1.0,
        }
    }
}

impl Known<'_> {
    /// Compares the outermost tangent planes of all pairs of cameras at an instant.
    pub fn touches<'b>(
        &'b self,
        at: &'b PersonEstimate,
        instant: usize,
    ) -> impl Iterator<Item = ([usize; 2], Side, Tangency)> + 'b {
        let count = self.intrinsics.len();
        let pairs = (0..count).flat_map(move |a| (a + 1..count).map(move |b| [a, b]));
        let sides = pairs.flat_map(|pair| [Side::Low, Side::High].map(|side| (pair, side)));
        sides.filter_map(move |(pair, side)| Some((pair, side, self.tangency(at, instant, pair, side, false)?)))
    }

    fn tangency(
        &self,
        at: &PersonEstimate,
        instant: usize,
        cameras: [usize; 2],
        side: Side,
        with_derivatives: bool,
    ) -> Option<Tangency> {
        let eye = |camera: usize| Eye {
            camera: at.cameras[camera],
            outlines: self.tracks.outlines(camera),
            stamp: self.stamp(at, instant, camera),
            interval_s: self.intervals_s[camera],
        };
        // From the old calibration, so that it stays fixed while cameras move.
        let middle =
            self.ahead - 0.5 * cameras.map(|c| self.before.cameras[c].inverse().translation).iter().sum::<DVec3>();
        tangency(cameras.map(eye), side, middle.try_normalize()?, with_derivatives)
    }

    fn stamp(&self, at: &PersonEstimate, instant: usize, camera: usize) -> i64 {
        self.instants[instant].saturating_add((at.lags_s[camera] * 1e9) as i64)
    }

    /// Returns the smoothed landmark of a camera at an instant.
    pub fn place(&self, at: &PersonEstimate, instant: usize, camera: usize, landmark: usize) -> Option<Place> {
        self.tracks.track(camera, landmark).at(self.stamp(at, instant, camera), self.intervals_s[camera])
    }

    /// Returns the reprojection error of a landmark, pixels; `None` where it is not seen or cannot be projected.
    pub fn error(&self, at: &PersonEstimate, instant: usize, camera: usize, landmark: usize) -> Option<DVec2> {
        let place = self.place(at, instant, camera, landmark)?;
        let local = at.cameras[camera].apply(at.points[instant][landmark]);
        Some(project(&self.intrinsics[camera], local)? - place.pixel)
    }
}

impl BlockProblem for PersonProblem<'_> {
    type Unknowns = PersonEstimate;

    fn block_sizes(&self) -> &[usize] {
        &self.sizes
    }

    fn first_eliminated(&self) -> usize {
        self.sizes.len() - self.known.instants.len()
    }

    fn residual_count(&self) -> usize {
        self.terms.len()
    }

    fn residual(&self, at: &PersonEstimate, index: usize, with_jacobians: bool) -> Option<Residual> {
        match self.terms[index] {
            Term::Seen { instant, camera, landmark } => {
                self.seen_residual(at, [instant, camera, landmark], with_jacobians)
            }
            Term::Touch { instant, cameras, side } => {
                Some(self.touch_residual(at, instant, cameras, side, with_jacobians))
            }
            Term::Limb { instant, limb } => self.limb_residual(at, instant, limb),
            Term::Camera(camera) => Some(self.camera_residual(at, camera)),
            Term::Lag(camera) => Some(Residual {
                error: DVector::from_element(
                    1,
                    (at.lags_s[camera] - self.known.before.lags_s[camera]) / self.known.lag_sigma_s,
                ),
                jacobians: vec![(self.lag_block(camera)?, DMatrix::from_element(1, 1, 1.0 / self.known.lag_sigma_s))],
                kernel: Kernel::Squares,
                weight: 1.0,
            }),
            Term::Loose { instant, landmark } => {
                let moved = at.points[instant][landmark] - self.known.before.points[instant][landmark];
                let mut by_points = DMatrix::zeros(3, 3 * self.known.tracks.landmarks());
                for axis in 0..3 {
                    by_points[(axis, 3 * landmark + axis)] = 1.0 / LOOSE_M;
                }
                Some(Residual {
                    error: DVector::from_column_slice(&(moved / LOOSE_M).to_array()),
                    jacobians: vec![(self.first_eliminated() + instant, by_points)],
                    kernel: Kernel::Squares,
                    weight: 1.0,
                })
            }
        }
    }

    fn moved(&self, at: &PersonEstimate, step: &[f64]) -> PersonEstimate {
        let mut at = at.clone();
        let mut vectors = step.chunks_exact(3).map(|v| DVec3::new(v[0], v[1], v[2]));
        let mut next = || vectors.next().unwrap_or_default();
        for camera in &mut at.cameras {
            let (turn, shift) = (next(), next());
            *camera = camera.moved(turn, shift);
        }
        let lags = if self.known.lags { at.cameras.len().saturating_sub(1) } else { 0 };
        let rest = &step[6 * at.cameras.len()..];
        for (lag, by) in at.lags_s.iter_mut().skip(1).zip(&rest[..lags]) {
            *lag += by;
        }
        let points = at.points.iter_mut().flatten();
        for (point, by) in points.zip(rest[lags..].chunks_exact(3)) {
            *point += DVec3::new(by[0], by[1], by[2]);
        }
        at
    }
}

fn matrix(m: DMat3) -> DMatrix<f64> {
    DMatrix::from_column_slice(3, 3, &m.to_cols_array())
}
