//! Damped least squares of one hand on the landmarks of all views.
//!
//! The unknowns are shift and rotation of the wrist relative to the body's pose and 20 angles of the fingers. The cost is
//! half the sum of squared residuals over standard deviations: landmark distances in the images (Cauchy weights), the
//! wrist's change, deviations of angles from the relaxed hand and from the last frame set, limits of angles, and the
//! coupling of a finger's last two joints (the last bends about two thirds as far as the one before: Lin, Wu and Huang,
//! "Modeling the constraints of human hand motion", 2000, eq. 4).

use flyrig_solve::{
    Convergence, DenseNormal, Kernel, Problem, RigidMotion, exp_rotation, left_jacobian_inverse, log_rotation, minimize,
};
use glam::{DQuat, DVec2, DVec3};
use nalgebra::DVector;

use crate::hands::hand_model::{Bends, BentHand, HandModel, moving, range, relaxed};
use crate::hands::hand_net::HAND_LANDMARKS;
use crate::hands::sight::Sight;

/// Number of unknowns: shift, rotation, four angles of five fingers.
const SIZE: usize = 26;
/// Standard deviation of a landmark, metres.
const SPREAD_M: f64 = 0.006;
/// Residual at which a landmark loses half its weight, standard deviations.
const ROBUST: f64 = 2.0;
/// Standard deviations of the body's wrist: place in metres, rotation in radians.
const WRIST_SHIFT_M: f64 = 0.02;
const WRIST_TURN_RAD: f64 = 0.35;
/// Standard deviation beyond an angle's limit, radians.
const LIMIT_RAD: f64 = 0.05;
/// Flexion of the third joint as a share of the second's, and the standard deviation, radians.
const COUPLING: f64 = 2.0 / 3.0;
const COUPLING_RAD: f64 = 0.3;
/// Largest number of solver steps.
const MAX_STEPS: usize = 30;

/// Landmarks of a hand in one view.
#[derive(Debug, Clone)]
pub(crate) struct HandSight {
    pub sight: Sight,
    /// Undistorted pixels from the principal point.
    pub seen: [Option<DVec2>; HAND_LANDMARKS],
}

/// Hand relative to the body's pose.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct HandPose {
    /// Shift of the wrist, world metres.
    pub shift: DVec3,
    /// Rotation applied after the wrist's own, world axes.
    pub turn: DQuat,
    pub bends: Bends,
}

impl HandPose {
    /// Returns the hand in the body's pose with relaxed fingers.
    pub fn relaxed() -> Self {
        Self { shift: DVec3::ZERO, turn: DQuat::IDENTITY, bends: relaxed() }
    }
}

/// Measurements and priors of a hand.
#[derive(Debug, Clone)]
pub(crate) struct HandProblem<'a> {
    pub model: &'a HandModel,
    pub sights: &'a [HandSight],
    /// Rotation of the hand's flesh from canonical axes to the world, and the wrist's place in metres, by the body's pose.
    pub wrist: RigidMotion,
    /// Angles at the last frame set and the standard deviation of their change since, radians.
    pub before: Option<(Bends, f64)>,
}

impl HandProblem<'_> {
    /// Returns the world places of the landmarks, metres, and the bent hand.
    pub fn points(&self, at: &HandPose) -> ([DVec3; HAND_LANDMARKS], BentHand) {
        let bent = self.model.bend(&at.bends);
        let (origin, rotation) = (self.wrist.translation + at.shift, at.turn * self.wrist.rotation);
        (bent.points.map(|point| origin + rotation * point), bent)
    }

    /// Minimises from a start; returns the pose and its cost, `None` when it is not finite.
    pub fn solve(&self, start: &HandPose) -> Option<(HandPose, f64)> {
        let options = Convergence { max_steps: MAX_STEPS, min_gain: 1e-4, ..Convergence::default() };
        let solution = minimize(self, start, &options)?;
        let pose = solution.unknowns;
        let finite = pose.shift.is_finite()
            && pose.turn.is_finite()
            && pose.bends.iter().flatten().all(|angle| angle.is_finite());
        finite.then_some((pose, solution.cost))
    }

    /// Returns the median residual of a view's landmarks, standard deviations and pixels; `None` without any.
    pub fn residual(&self, at: &HandPose, hand: &HandSight) -> Option<(f64, f64)> {
        let (points, _) = self.points(at);
        let (mut sigmas, mut pixels) = (Vec::new(), Vec::new());
        for (point, seen) in points.iter().zip(&hand.seen) {
            let (Some(seen), Some(pixel)) = (seen, hand.sight.project(*point)) else { continue };
            let distance = pixel.distance(*seen);
            sigmas.push(distance / hand.sight.spread_px(self.wrist.translation, SPREAD_M)?);
            pixels.push(distance);
        }
        Some((flyrig_solve::median(&mut sigmas)?, flyrig_solve::median(&mut pixels)?))
    }

    /// Calls `each` with every residual of the angles: pairs (index of the angle, derivative), and the residual.
    fn angle_terms(&self, bends: &Bends, mut each: impl FnMut(&[(usize, f64)], f64)) {
        for (finger, angles) in bends.iter().enumerate() {
            for (k, &angle) in angles.iter().enumerate() {
                let [low, high, mean, sigma] = range(finger, k);
                let index = 6 + 4 * finger + k;
                each(&[(index, 1.0 / sigma)], (angle - mean) / sigma);
                let over = (angle - high).max(0.0) + (angle - low).min(0.0);
                if over != 0.0 {
                    each(&[(index, 1.0 / LIMIT_RAD)], over / LIMIT_RAD);
                }
                if let Some((before, sigma)) = &self.before {
                    each(&[(index, 1.0 / sigma)], (angle - before[finger][k]) / sigma);
                }
            }
            if finger > 0 {
                let index = 6 + 4 * finger;
                each(
                    &[(index + 3, 1.0 / COUPLING_RAD), (index + 2, -COUPLING / COUPLING_RAD)],
                    (angles[3] - COUPLING * angles[2]) / COUPLING_RAD,
                );
            }
        }
    }

    /// Calls `each` with every landmark's index, its world place, the two rows of derivatives by that place, residuals,
    /// weight and cost.
    fn sight_terms(&self, at: &HandPose, mut each: impl FnMut(usize, DVec3, [DVec3; 2], DVec2, f64, f64)) {
        let (points, _) = self.points(at);
        let kernel = Kernel::Cauchy(ROBUST);
        for HandSight { sight, seen } in self.sights {
            let Some(spread) = sight.spread_px(self.wrist.translation, SPREAD_M) else { continue };
            for (index, (point, seen)) in points.iter().zip(seen).enumerate() {
                let Some(seen) = seen else { continue };
                let Some((pixel, rows)) = sight.project_with_derivative(*point) else { continue };
                let error = (pixel - *seen) / spread;
                let (cost, weight) = kernel.weigh(error.length_squared(), sight.trust);
                each(index, *point, rows.map(|row| row / spread), error, weight, cost);
            }
        }
    }
}

impl Problem for HandProblem<'_> {
    type Unknowns = HandPose;
    type Normal = DenseNormal;

    fn cost(&self, at: &HandPose) -> f64 {
        let mut cost = 0.5 * (at.shift / WRIST_SHIFT_M).length_squared();
        cost += 0.5 * (log_rotation(at.turn) / WRIST_TURN_RAD).length_squared();
        self.angle_terms(&at.bends, |_, residual| cost += 0.5 * residual * residual);
        self.sight_terms(at, |_, _, _, _, _, term| cost += term);
        cost
    }

    fn linearize(&self, at: &HandPose) -> Option<DenseNormal> {
        let mut equations = DenseNormal::zeros(SIZE);
        let mut add = |row: &[(usize, f64)], residual: f64, weight: f64| {
            for &(i, a) in row {
                equations.gradient[i] += a * residual * weight;
                for &(j, b) in row {
                    equations.matrix[(i, j)] += a * b * weight;
                }
            }
        };
        for k in 0..3 {
            add(&[(k, 1.0 / WRIST_SHIFT_M)], at.shift[k] / WRIST_SHIFT_M, 1.0);
        }
        let turned = log_rotation(at.turn);
        let derivative = left_jacobian_inverse(turned) * (1.0 / WRIST_TURN_RAD);
        for k in 0..3 {
            let row = derivative.row(k);
            add(&[(3, row.x), (4, row.y), (5, row.z)], turned[k] / WRIST_TURN_RAD, 1.0);
        }
        self.angle_terms(&at.bends, |row, residual| add(row, residual, 1.0));
        let (_, bent) = self.points(at);
        let (origin, rotation) = (self.wrist.translation + at.shift, at.turn * self.wrist.rotation);
        let mut row: Vec<(usize, f64)> = Vec::with_capacity(10);
        self.sight_terms(at, |index, point, rows, error, weight, _| {
            for (by_place, error) in rows.into_iter().zip(error.to_array()) {
                row.clear();
                let by_turn = (point - origin).cross(by_place);
                for k in 0..3 {
                    row.push((k, by_place[k]));
                    row.push((3 + k, by_turn[k]));
                }
                if index > 0 {
                    let (finger, place) = ((index - 1) / 4, (index - 1) % 4);
                    for k in moving(place) {
                        let (axis, pivot) = bent.axes[finger][k];
                        let motion = (rotation * axis).cross(point - origin - rotation * pivot);
                        row.push((6 + 4 * finger + k, motion.dot(by_place)));
                    }
                }
                add(&row, error, weight);
            }
        });
        Some(equations)
    }

    fn moved(&self, at: &HandPose, step: &DVector<f64>) -> HandPose {
        let vector = |from: usize| DVec3::new(step[from], step[from + 1], step[from + 2]);
        HandPose {
            shift: at.shift + vector(0),
            turn: (exp_rotation(vector(3)) * at.turn).normalize(),
            bends: std::array::from_fn(|f| std::array::from_fn(|k| at.bends[f][k] + step[6 + 4 * f + k])),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::view::View;
    use crate::testing::{body, ring};
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    fn wrist() -> RigidMotion {
        RigidMotion { rotation: exp_rotation(DVec3::new(0.8, -0.4, 0.3)), translation: DVec3::new(0.1, -0.2, 1.1) }
    }

    fn truth(seed: u64) -> HandPose {
        let mut rng = StdRng::seed_from_u64(seed);
        let bends = std::array::from_fn(|finger| {
            std::array::from_fn(|k| {
                let [low, high, ..] = range(finger, k);
                rng.random_range(low.max(-0.2)..0.8 * high)
            })
        });
        let mut bends: Bends = bends;
        for finger in &mut bends[1..] {
            finger[3] = COUPLING * finger[2];
        }
        HandPose { shift: DVec3::new(0.01, -0.008, 0.006), turn: exp_rotation(DVec3::new(0.1, -0.15, 0.1)), bends }
    }

    fn sights(model: &HandModel, pose: &HandPose, count: usize) -> Vec<HandSight> {
        let problem = HandProblem { model, sights: &[], wrist: wrist(), before: None };
        let (points, _) = problem.points(pose);
        let carry = RigidMotion { rotation: exp_rotation(DVec3::new(0.0, 0.0, 0.1)), translation: DVec3::X * 0.03 };
        let sight = |(slot, camera): (usize, &flyrig_types::Camera)| {
            let view = View::new(camera);
            let carry = if slot == 1 { carry } else { RigidMotion::IDENTITY };
            let seen = points.map(|point| view.project(carry.apply(point)));
            HandSight { sight: Sight { view, trust: 1.0, carry }, seen }
        };
        ring(count).cameras.iter().enumerate().map(sight).collect()
    }

    #[test]
    fn the_gradient_matches_differences_of_the_cost() {
        let [left, _] = HandModel::pair(&body().with_fingers().unwrap()).unwrap();
        let sights = sights(&left, &truth(1), 3);
        let mut problem = HandProblem { model: &left, sights: &sights, wrist: wrist(), before: None };
        problem.before = Some((relaxed(), 0.3));
        let mut at = truth(2);
        at.bends[1][0] = 1.9;
        let DenseNormal { matrix, gradient } = problem.linearize(&at).unwrap();
        assert!((&matrix - matrix.transpose()).amax() < 1e-9 * matrix.amax());
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
    fn exact_landmarks_of_three_views_bring_the_fingertips_back() {
        for (seed, model) in (10..).zip(HandModel::pair(&body().with_fingers().unwrap()).unwrap()) {
            let truth = truth(seed);
            let sights = sights(&model, &truth, 3);
            let problem = HandProblem { model: &model, sights: &sights, wrist: wrist(), before: None };
            let (found, _) = problem.solve(&HandPose::relaxed()).unwrap();
            let errors = problem
                .points(&found)
                .0
                .iter()
                .zip(problem.points(&truth).0)
                .map(|(a, b)| a.distance(b))
                .fold(0.0, f64::max);
            assert!(errors < 0.006, "largest error {errors} m");
        }
    }

    #[test]
    fn one_wrong_view_of_four_does_not_spoil_the_hand() {
        let [left, _] = HandModel::pair(&body().with_fingers().unwrap()).unwrap();
        let truth = truth(5);
        let mut sights = sights(&left, &truth, 4);
        for seen in sights[2].seen.iter_mut().flatten() {
            *seen = DVec2::new(seen.y + 60.0, -seen.x);
        }
        let problem = HandProblem { model: &left, sights: &sights, wrist: wrist(), before: None };
        let (found, _) = problem.solve(&HandPose::relaxed()).unwrap();
        let mut errors: Vec<f64> =
            problem.points(&found).0.iter().zip(problem.points(&truth).0).map(|(a, b)| a.distance(b)).collect();
        assert!(flyrig_solve::median(&mut errors).unwrap() < 0.008, "{errors:?}");
        assert!(problem.residual(&found, &sights[2]).unwrap().0 > 3.0);
    }

    #[test]
    fn nothing_seen_gives_the_relaxed_hand_and_angles_stay_in_range_whatever_is_seen() {
        let [left, _] = HandModel::pair(&body().with_fingers().unwrap()).unwrap();
        let problem = HandProblem { model: &left, sights: &[], wrist: wrist(), before: None };
        let (found, _) = problem.solve(&truth(3)).unwrap();
        for (a, b) in found.bends.iter().flatten().zip(relaxed().iter().flatten()) {
            assert!((a - b).abs() < 0.05, "{a} {b}");
        }
        let mut backwards = truth(4);
        backwards.bends = [[-1.5, 0.0, -1.5, -1.0]; 5];
        let sights = sights(&left, &backwards, 3);
        let (found, _) = HandProblem { sights: &sights, ..problem }.solve(&HandPose::relaxed()).unwrap();
        for (finger, bend) in found.bends.iter().enumerate() {
            for (k, angle) in bend.iter().enumerate() {
                let [low, high, ..] = range(finger, k);
                assert!((low - 0.4..high + 0.4).contains(angle), "{finger} {k} {angle}");
            }
        }
    }

    #[test]
    fn poisoned_input_gives_no_hand() {
        let [left, _] = HandModel::pair(&body().with_fingers().unwrap()).unwrap();
        let good = truth(1);
        let mut sights = sights(&left, &good, 2);
        let nan = RigidMotion { translation: DVec3::NAN, ..wrist() };
        let problem = HandProblem { model: &left, sights: &sights, wrist: nan, before: None };
        assert!(problem.solve(&HandPose { shift: DVec3::NAN, ..good.clone() }).is_none());
        sights[0].seen[4] = Some(DVec2::NAN);
        let problem = HandProblem { model: &left, sights: &sights, wrist: wrist(), before: None };
        assert!(problem.solve(&good).is_none(), "a landmark that is not finite must be left out before");
    }
}
