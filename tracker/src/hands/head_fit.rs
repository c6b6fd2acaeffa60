//! Damped least squares of the head's rotation on the face landmarks of all views.
//!
//! The unknowns are shift and rotation relative to the body's pose and the size of the face. The landmarks lie at measured
//! places of an average face ([`FACE_POINTS`](crate::hands::face_points::FACE_POINTS)); size and shift absorb the
//! differences between people.

use flyrig_solve::{
    Convergence, DenseNormal, Kernel, Problem, RigidMotion, exp_rotation, left_jacobian_inverse, log_rotation, minimize,
};
use glam::{DQuat, DVec2, DVec3};
use nalgebra::DVector;

use crate::hands::sight::Sight;

/// Number of unknowns: shift, rotation, logarithm of the size.
const SIZE: usize = 7;
/// Standard deviation of a landmark, metres.
const SPREAD_M: f64 = 0.005;
/// Residual at which a landmark loses half its weight, standard deviations.
const ROBUST: f64 = 2.0;
/// Standard deviations of the body's head: place in metres, rotation in radians, logarithm of the size.
const SHIFT_M: f64 = 0.02;
const TURN_RAD: f64 = 0.5;
const LN_SIZE: f64 = 0.08;
/// Number of independent measurements that the landmarks of a view are worth: more of them share their weight, since their
/// errors are correlated.
const COUNT: f64 = 12.0;
/// Largest number of solver steps.
const MAX_STEPS: usize = 20;

/// Landmarks of the face in one view.
#[derive(Debug, Clone)]
pub(crate) struct FaceSight {
    pub sight: Sight,
    /// Undistorted pixels from the principal point, and the place on the head: canonical axes from the head's joint,
    /// metres.
    pub seen: Vec<(DVec2, DVec3)>,
}

/// Head relative to the body's pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct HeadPose {
    /// Shift of the joint, world metres.
    pub shift: DVec3,
    /// Rotation applied after the head's own, world axes.
    pub turn: DQuat,
    /// Logarithm of the size of the face.
    pub ln_size: f64,
}

impl HeadPose {
    /// Returns the head in the body's pose.
    pub fn unmoved() -> Self {
        Self { shift: DVec3::ZERO, turn: DQuat::IDENTITY, ln_size: 0.0 }
    }
}

/// Measurements and priors of the head.
#[derive(Debug, Clone)]
pub(crate) struct HeadProblem<'a> {
    pub sights: &'a [FaceSight],
    /// Rotation of the head's flesh from canonical axes to the world, and its joint's place in metres, by the body's pose.
    pub head: RigidMotion,
}

impl HeadProblem<'_> {
    /// Minimises from the body's head; `None` when the result is not finite.
    pub fn solve(&self) -> Option<HeadPose> {
        let options = Convergence { max_steps: MAX_STEPS, min_gain: 1e-5, ..Convergence::default() };
        let pose = minimize(self, &HeadPose::unmoved(), &options)?.unknowns;
        (pose.shift.is_finite() && pose.turn.is_finite() && pose.ln_size.is_finite()).then_some(pose)
    }

    /// Returns the world place of a point of the head, metres.
    fn place(&self, at: &HeadPose, point: DVec3) -> DVec3 {
        self.head.translation + at.shift + at.turn * (self.head.rotation * point) * at.ln_size.exp()
    }

    /// Returns the median residual of a view's landmarks, standard deviations and pixels; `None` without any.
    pub fn residual(&self, at: &HeadPose, face: &FaceSight) -> Option<(f64, f64)> {
        let spread = face.sight.spread_px(self.head.translation, SPREAD_M)?;
        let distance =
            |(seen, point): &(DVec2, DVec3)| Some(face.sight.project(self.place(at, *point))?.distance(*seen));
        let mut pixels: Vec<f64> = face.seen.iter().filter_map(distance).collect();
        let median = flyrig_solve::median(&mut pixels)?;
        Some((median / spread, median))
    }

    /// Calls `each` with every landmark's world place, the two rows of derivatives by it, residuals, weight and cost.
    fn sight_terms(&self, at: &HeadPose, mut each: impl FnMut(DVec3, [DVec3; 2], DVec2, f64, f64)) {
        let kernel = Kernel::Cauchy(ROBUST);
        for FaceSight { sight, seen } in self.sights {
            let Some(spread) = sight.spread_px(self.head.translation, SPREAD_M) else { continue };
            let importance = sight.trust * (COUNT / seen.len() as f64).min(1.0);
            for (seen, point) in seen {
                let place = self.place(at, *point);
                let Some((pixel, rows)) = sight.project_with_derivative(place) else { continue };
                let error = (pixel - *seen) / spread;
                let (cost, weight) = kernel.weigh(error.length_squared(), importance);
                each(place, rows.map(|row| row / spread), error, weight, cost);
            }
        }
    }
}

impl Problem for HeadProblem<'_> {
    type Unknowns = HeadPose;
    type Normal = DenseNormal;

    fn cost(&self, at: &HeadPose) -> f64 {
        let mut cost = 0.5 * (at.shift / SHIFT_M).length_squared();
        cost += 0.5 * (log_rotation(at.turn) / TURN_RAD).length_squared();
        cost += 0.5 * (at.ln_size / LN_SIZE).powi(2);
        self.sight_terms(at, |_, _, _, _, term| cost += term);
        cost
    }

    fn linearize(&self, at: &HeadPose) -> Option<DenseNormal> {
        let mut equations = DenseNormal::zeros(SIZE);
        let mut add = |row: [f64; SIZE], residual: f64, weight: f64| {
            for i in 0..SIZE {
                equations.gradient[i] += row[i] * residual * weight;
                for j in 0..SIZE {
                    equations.matrix[(i, j)] += row[i] * row[j] * weight;
                }
            }
        };
        let turned = log_rotation(at.turn);
        let derivative = left_jacobian_inverse(turned) * (1.0 / TURN_RAD);
        for k in 0..3 {
            let mut row = [0.0; SIZE];
            row[k] = 1.0 / SHIFT_M;
            add(row, at.shift[k] / SHIFT_M, 1.0);
            let [x, y, z] = derivative.row(k).to_array();
            add([0.0, 0.0, 0.0, x, y, z, 0.0], turned[k] / TURN_RAD, 1.0);
        }
        add([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0 / LN_SIZE], at.ln_size / LN_SIZE, 1.0);
        let joint = self.head.translation + at.shift;
        self.sight_terms(at, |place, rows, error, weight, _| {
            for (by_place, error) in rows.into_iter().zip(error.to_array()) {
                let by_turn = (place - joint).cross(by_place);
                let [a, b, c] = by_place.to_array();
                let [d, e, f] = by_turn.to_array();
                add([a, b, c, d, e, f, (place - joint).dot(by_place)], error, weight);
            }
        });
        Some(equations)
    }

    fn moved(&self, at: &HeadPose, step: &DVector<f64>) -> HeadPose {
        HeadPose {
            shift: at.shift + DVec3::new(step[0], step[1], step[2]),
            turn: (exp_rotation(DVec3::new(step[3], step[4], step[5])) * at.turn).normalize(),
            ln_size: at.ln_size + step[6],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::view::View;
    use crate::testing::ring;

    fn head() -> RigidMotion {
        RigidMotion { rotation: exp_rotation(DVec3::new(1.4, 0.1, 0.2)), translation: DVec3::new(0.05, -0.1, 1.5) }
    }

    fn truth() -> HeadPose {
        HeadPose {
            shift: DVec3::new(0.004, -0.006, 0.003),
            turn: exp_rotation(DVec3::new(0.2, -0.15, 0.25)),
            ln_size: 0.04,
        }
    }

    fn sights(count: usize) -> Vec<FaceSight> {
        let problem = HeadProblem { sights: &[], head: head() };
        let point = |k: usize| {
            let t = k as f64;
            DVec3::new(0.05 * (1.3 * t).sin(), 0.08 + 0.06 * (2.1 * t).cos(), 0.09 + 0.02 * (0.7 * t).sin())
        };
        let sight = |camera: &flyrig_types::Camera| {
            let view = View::new(camera);
            let seen = (0..30).filter_map(|k| Some((view.project(problem.place(&truth(), point(k)))?, point(k))));
            let seen: Vec<_> = seen.collect();
            FaceSight { sight: Sight { view, trust: 1.0, carry: RigidMotion::IDENTITY }, seen }
        };
        ring(count).cameras.iter().map(sight).collect()
    }

    #[test]
    fn the_gradient_matches_differences_of_the_cost() {
        let sights = sights(2);
        let problem = HeadProblem { sights: &sights, head: head() };
        let at = HeadPose { ln_size: -0.03, ..HeadPose::unmoved() };
        let DenseNormal { gradient, .. } = problem.linearize(&at).unwrap();
        for k in 0..SIZE {
            const STEP: f64 = 1e-6;
            let mut step = DVector::zeros(SIZE);
            step[k] = STEP;
            let forward = problem.cost(&problem.moved(&at, &step));
            step[k] = -STEP;
            let numeric = (forward - problem.cost(&problem.moved(&at, &step))) / (2.0 * STEP);
            assert!((numeric - gradient[k]).abs() < 1e-4 * (1.0 + numeric.abs()), "{k}: {numeric} {}", gradient[k]);
        }
    }

    #[test]
    fn the_turn_is_found_from_two_views_and_from_one() {
        for (count, limit) in [(3, 0.03), (2, 0.03), (1, 0.08)] {
            let sights = sights(count);
            let found = HeadProblem { sights: &sights, head: head() }.solve().unwrap();
            let off = found.turn.angle_between(truth().turn);
            assert!(off < limit, "{count} views: {off} rad");
        }
    }

    #[test]
    fn no_view_leaves_the_head_and_poison_gives_none() {
        let found = HeadProblem { sights: &[], head: head() }.solve().unwrap();
        assert!(found.turn.angle_between(DQuat::IDENTITY) < 1e-9);
        let mut sights = sights(2);
        sights[0].seen[3].0 = DVec2::NAN;
        assert!(HeadProblem { sights: &sights, head: head() }.solve().is_none());
        assert!(HeadProblem { sights: &[], head: head() }.residual(&found, &sights[0]).is_some());
    }
}
