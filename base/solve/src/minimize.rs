//! Levenberg-Marquardt minimization.

use nalgebra::DVector;

use crate::normal::NormalEquations;

/// Cost to minimize.
pub trait Problem {
    /// Unknowns, on any manifold.
    type Unknowns: Clone;
    /// Form of the normal equations.
    type Normal: NormalEquations;

    /// Returns the cost, half a robust sum of squares; not finite where it is undefined.
    fn cost(&self, at: &Self::Unknowns) -> f64;

    /// Returns the normal equations of a step from `at`; `None` where there are none.
    fn linearize(&self, at: &Self::Unknowns) -> Option<Self::Normal>;

    /// Returns the unknowns after a step.
    fn moved(&self, at: &Self::Unknowns, step: &DVector<f64>) -> Self::Unknowns;
}

/// Damping and convergence criteria.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Convergence {
    /// Largest number of attempted steps.
    pub max_steps: usize,
    /// Relative decrease of the cost by an accepted step below which the minimization has converged.
    pub min_gain: f64,
    /// Largest element of the gradient below which the minimization has converged; 0 disables the criterion.
    pub max_gradient: f64,
    /// Initial damping, as a fraction of the diagonal.
    pub damping: f64,
    /// Range of the damping; the minimization ends when more would be needed.
    pub damping_range: (f64, f64),
    /// Factors of the damping after an accepted and after a rejected step.
    pub damping_factors: (f64, f64),
    /// Term added to the diagonal, which keeps unknowns in place that nothing depends on.
    pub floor: f64,
}

impl Default for Convergence {
    fn default() -> Self {
        Self {
            max_steps: 100,
            min_gain: 1e-12,
            max_gradient: 0.0,
            damping: 1e-3,
            damping_range: (1e-7, 1e6),
            damping_factors: (0.2, 10.0),
            floor: 1e-9,
        }
    }
}

/// Reason for the end of a minimization.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// The gradient vanished, or an accepted step gained less than [`Convergence::min_gain`].
    Converged,
    /// No step of any damping lowers the cost: a minimum up to rounding, or a wrong derivative.
    NoDescent,
    /// The number of steps reached its limit.
    StepLimit,
    /// The normal equations could not be formed.
    NoEquations,
}

/// Result of a minimization.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution<U> {
    /// Best unknowns found.
    pub unknowns: U,
    /// Cost of the unknowns, at most that of the start.
    pub cost: f64,
    /// Number of attempted steps, rejected ones included.
    pub steps: usize,
    /// Reason for the end.
    pub stop: Stop,
}

/// Minimizes a cost from a start by damped Gauss-Newton steps; only steps that lower the cost are accepted. `None` when the start has no
/// finite cost.
pub fn minimize<P: Problem>(problem: &P, start: &P::Unknowns, options: &Convergence) -> Option<Solution<P::Unknowns>> {
    let mut unknowns = start.clone();
    let mut cost = problem.cost(&unknowns);
    if !cost.is_finite() {
        return None;
    }
    let mut damping = options.damping;
    let mut steps = 0;
    let stop = 'outer: loop {
        if steps >= options.max_steps {
            break Stop::StepLimit;
        }
        let Some(normal) = problem.linearize(&unknowns) else { break Stop::NoEquations };
        if normal.gradient_max() < options.max_gradient {
            break Stop::Converged;
        }
        loop {
            steps += 1;
            let candidate = normal.step(damping, options.floor).map(|step| problem.moved(&unknowns, &step));
            let candidate_cost = candidate.as_ref().map_or(f64::INFINITY, |candidate| problem.cost(candidate));
            if let Some(candidate) = candidate
                && candidate_cost < cost
            {
                let gain = (cost - candidate_cost) / cost.max(1e-12);
                unknowns = candidate;
                cost = candidate_cost;
                damping = (damping * options.damping_factors.0).max(options.damping_range.0);
                if gain < options.min_gain {
                    break 'outer Stop::Converged;
                }
                break;
            }
            damping *= options.damping_factors.1;
            if damping > options.damping_range.1 {
                break 'outer Stop::NoDescent;
            }
            if steps >= options.max_steps {
                break 'outer Stop::StepLimit;
            }
        }
    };
    Some(Solution { unknowns, cost, steps, stop })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::normal::DenseNormal;
    use nalgebra::DMatrix;

    /// Rosenbrock's valley as two residuals: `1 - x` and `10 (y - x²)`.
    struct Valley;

    impl Problem for Valley {
        type Unknowns = [f64; 2];
        type Normal = DenseNormal;

        fn cost(&self, [x, y]: &[f64; 2]) -> f64 {
            0.5 * ((1.0 - x).powi(2) + 100.0 * (y - x * x).powi(2))
        }

        fn linearize(&self, [x, y]: &[f64; 2]) -> Option<DenseNormal> {
            let jacobian = DMatrix::from_row_slice(2, 2, &[-1.0, 0.0, -20.0 * x, 10.0]);
            let error = DVector::from_column_slice(&[1.0 - x, 10.0 * (y - x * x)]);
            Some(DenseNormal { matrix: jacobian.transpose() * &jacobian, gradient: jacobian.transpose() * error })
        }

        fn moved(&self, at: &[f64; 2], step: &DVector<f64>) -> [f64; 2] {
            [at[0] + step[0], at[1] + step[1]]
        }
    }

    #[test]
    fn the_valley_is_followed_to_its_minimum_and_the_cost_never_grows() {
        for start in [[-1.2, 1.0], [5.0, -3.0], [0.0, 0.0]] {
            let solution = minimize(&Valley, &start, &Convergence::default()).unwrap();
            let [x, y] = solution.unknowns;
            assert!((x - 1.0).abs() < 1e-6 && (y - 1.0).abs() < 1e-6, "{solution:?}");
            assert!(solution.stop != Stop::StepLimit, "{solution:?}");
            let mut last = f64::INFINITY;
            for max_steps in 0..30 {
                let part = minimize(&Valley, &start, &Convergence { max_steps, ..Convergence::default() }).unwrap();
                assert!(part.cost <= last && part.steps <= max_steps);
                last = part.cost;
            }
        }
        let at_minimum = Convergence { max_gradient: 1e-9, ..Convergence::default() };
        let solution = minimize(&Valley, &[1.0, 1.0], &at_minimum).unwrap();
        assert_eq!((solution.steps, solution.stop), (0, Stop::Converged));
        let solution = minimize(&Valley, &[1.0, 1.0], &Convergence::default()).unwrap();
        assert_eq!(solution.stop, Stop::NoDescent);
    }

    #[test]
    fn a_start_that_is_not_finite_is_refused() {
        for bad in [f64::NAN, f64::INFINITY, 1e200] {
            assert!(minimize(&Valley, &[bad, 0.0], &Convergence::default()).is_none());
        }
    }
}
