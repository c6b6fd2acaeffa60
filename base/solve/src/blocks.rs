//! Robust least squares over small dense blocks of unknowns, such as cameras, boards and points.

use nalgebra::{DMatrix, DVector};

use crate::kernel::Kernel;
use crate::minimize::{Convergence, Problem, Solution, minimize};
use crate::normal::{ArrowNormal, DenseNormal, EliminatedBlock};

/// Residual block and its derivatives.
#[derive(Debug, Clone, PartialEq)]
pub struct Residual {
    /// Elements in units of their standard deviation.
    pub error: DVector<f64>,
    /// Blocks of unknowns with the error's derivative by their steps (rows of the error, columns of the block). Each block occurs once,
    /// at most one of them is eliminated; may be empty where no derivatives are requested.
    pub jacobians: Vec<(usize, DMatrix<f64>)>,
    /// Robust kernel of the error's norm.
    pub kernel: Kernel,
    /// Weight, at least 0; a residual of weight 0 is ignored, even where its error is not finite.
    pub weight: f64,
}

/// Robust least squares problem over blocks of unknowns: half the sum of `weight ρ(|error|²)`.
pub trait BlockProblem {
    /// Unknowns, on any manifold.
    type Unknowns: Clone;

    /// Returns the number of step parameters of each block. A step is the concatenation of the blocks' steps.
    fn block_sizes(&self) -> &[usize];

    /// Returns the first eliminated block; it and all later ones are eliminated (Schur complement), which pays where they are many and
    /// small. By default none are.
    fn first_eliminated(&self) -> usize {
        self.block_sizes().len()
    }

    /// Returns the number of residual blocks.
    fn residual_count(&self) -> usize;

    /// Returns a residual block, with derivatives on request; `None` where it is undefined (a point behind its camera), which makes the
    /// cost infinite, so that steps there are rejected.
    fn residual(&self, at: &Self::Unknowns, index: usize, with_jacobians: bool) -> Option<Residual>;

    /// Returns the unknowns after a step.
    fn moved(&self, at: &Self::Unknowns, step: &[f64]) -> Self::Unknowns;
}

/// Error of a block problem.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BlockError {
    /// A residual block does not fit the unknowns.
    #[error("residual block {index}: {fault}; return Jacobians that match `block_sizes` and the error")]
    Shape {
        /// Index of the residual.
        index: usize,
        /// Fault.
        fault: String,
    },
    /// The cost of the start is not finite.
    #[error(
        "residual block {index} has no finite cost at the start; leave it out or start where it is defined, with a weight \
         of at least 0 and a positive kernel scale"
    )]
    Start {
        /// Index of the residual.
        index: usize,
    },
    /// The sum of all costs is not finite.
    #[error("the residuals' sum at the start is not finite; scale the errors by their standard deviations")]
    Overflow,
}

/// Minimizes a block problem from a start, see [`minimize`].
///
/// ```
/// use flyrig_solve::{BlockProblem, Convergence, Kernel, Residual, minimize_blocks};
/// use nalgebra::{DMatrix, DVector};
///
/// /// Position on a line, measured several times; one measurement is an outlier.
/// struct Position(Vec<f64>);
///
/// impl BlockProblem for Position {
///     type Unknowns = f64;
///     fn block_sizes(&self) -> &[usize] {
///         &[1]
///     }
///     fn residual_count(&self) -> usize {
///         self.0.len()
///     }
///     fn residual(&self, at: &f64, index: usize, _: bool) -> Option<Residual> {
///         let error = DVector::from_element(1, at - self.0[index]);
///         let jacobians = vec![(0, DMatrix::from_element(1, 1, 1.0))];
///         Some(Residual { error, jacobians, kernel: Kernel::Cauchy(0.1), weight: 1.0 })
///     }
///     fn moved(&self, at: &f64, step: &[f64]) -> f64 {
///         at + step[0]
///     }
/// }
///
/// let problem = Position(vec![1.0, 1.02, 0.98, 9.0]);
/// let found = minimize_blocks(&problem, &2.0, &Convergence::default())?;
/// assert!((found.unknowns - 1.0).abs() < 0.02);
/// # Ok::<(), flyrig_solve::BlockError>(())
/// ```
///
/// # Errors
/// When a residual block does not fit the unknowns, or has no finite cost at the start.
pub fn minimize_blocks<P: BlockProblem>(
    problem: &P,
    start: &P::Unknowns,
    options: &Convergence,
) -> Result<Solution<P::Unknowns>, BlockError> {
    for index in 0..problem.residual_count() {
        let residual = problem.residual(start, index, true).ok_or(BlockError::Start { index })?;
        check_shape(problem, &residual).map_err(|fault| BlockError::Shape { index, fault })?;
        if !cost(&residual).is_finite() {
            return Err(BlockError::Start { index });
        }
    }
    minimize(&Assembled(problem), start, options).ok_or(BlockError::Overflow)
}

/// Returns the covariance of the kept unknowns' step parameters at a solution, for weights that are inverse variances. `None` where the
/// residuals leave unknowns undetermined (a free gauge, an eliminated block in too few residuals).
#[must_use]
pub fn block_covariance<P: BlockProblem>(problem: &P, at: &P::Unknowns) -> Option<DMatrix<f64>> {
    Assembled(problem).linearize(at)?.covariance()
}

/// Returns the largest difference between a residual block's Jacobians and central differences of its error with a step, relative to
/// the larger of 1 and the difference quotient; for tests of problems. `None` where the residual is undefined or does not fit the
/// unknowns.
#[must_use]
pub fn jacobian_error<P: BlockProblem>(problem: &P, at: &P::Unknowns, index: usize, step: f64) -> Option<f64> {
    let residual = problem.residual(at, index, true)?;
    check_shape(problem, &residual).ok()?;
    let offsets = offsets(problem.block_sizes());
    let mut worst = 0.0f64;
    for block in 0..problem.block_sizes().len() {
        let analytic = residual.jacobians.iter().find(|(of, _)| *of == block).map(|(_, jacobian)| jacobian);
        for k in 0..problem.block_sizes()[block] {
            let error = |by: f64| {
                let mut flat = vec![0.0; *offsets.last()?];
                flat[offsets[block] + k] = by;
                Some(problem.residual(&problem.moved(at, &flat), index, false)?.error)
            };
            let (above, below) = (error(step)?, error(-step)?);
            for row in 0..residual.error.len() {
                let numeric = (above.get(row)? - below.get(row)?) / (2.0 * step);
                let analytic = analytic.map_or(0.0, |jacobian| jacobian[(row, k)]);
                let off = (analytic - numeric).abs() / numeric.abs().max(1.0);
                // NaN counts as an infinite difference.
                worst = if off.is_nan() { f64::INFINITY } else { worst.max(off) };
            }
        }
    }
    Some(worst)
}

/// Returns the first step parameter of each block, and their total number.
fn offsets(sizes: &[usize]) -> Vec<usize> {
    let ends = sizes.iter().scan(0, |end, size| {
        *end += size;
        Some(*end)
    });
    std::iter::once(0).chain(ends).collect()
}

fn check_shape<P: BlockProblem>(problem: &P, residual: &Residual) -> Result<(), String> {
    let (sizes, first_eliminated) = (problem.block_sizes(), problem.first_eliminated());
    let mut eliminated = 0;
    for (i, (block, jacobian)) in residual.jacobians.iter().enumerate() {
        let size = sizes.get(*block).ok_or_else(|| format!("there is no block {block}"))?;
        if jacobian.shape() != (residual.error.len(), *size) {
            let (rows, columns) = jacobian.shape();
            let expected = residual.error.len();
            return Err(format!("the Jacobian by block {block} is {rows}x{columns} instead of {expected}x{size}"));
        }
        if residual.jacobians[..i].iter().any(|(other, _)| other == block) {
            return Err(format!("block {block} appears twice"));
        }
        eliminated += usize::from(*block >= first_eliminated);
    }
    if eliminated > 1 { Err("it depends on more than one eliminated block".to_owned()) } else { Ok(()) }
}

#[allow(clippy::float_cmp)] // a weight of exactly 0
fn cost(residual: &Residual) -> f64 {
    if residual.weight == 0.0 {
        return 0.0;
    }
    if residual.weight < 0.0 {
        return f64::NAN;
    }
    residual.kernel.weigh(residual.error.norm_squared(), residual.weight).0
}

/// Block problem as a [`Problem`] with normal equations.
struct Assembled<'a, P>(&'a P);

impl<P: BlockProblem> Problem for Assembled<'_, P> {
    type Unknowns = P::Unknowns;
    type Normal = ArrowNormal;

    fn cost(&self, at: &P::Unknowns) -> f64 {
        (0..self.0.residual_count())
            .map(|index| self.0.residual(at, index, false).map_or(f64::INFINITY, |residual| cost(&residual)))
            .fold(0.0, |sum, cost| sum + cost)
    }

    #[allow(clippy::float_cmp)] // a weight of exactly 0
    fn linearize(&self, at: &P::Unknowns) -> Option<ArrowNormal> {
        let sizes = self.0.block_sizes();
        let first_eliminated = self.0.first_eliminated().min(sizes.len());
        let offsets = offsets(sizes);
        let mut kept = DenseNormal::zeros(offsets[first_eliminated]);
        let mut eliminated: Vec<EliminatedBlock> = sizes[first_eliminated..]
            .iter()
            .map(|size| EliminatedBlock { normal: DenseNormal::zeros(*size), coupling: Vec::new() })
            .collect();
        for index in 0..self.0.residual_count() {
            let Residual { error, jacobians, kernel, weight } = {
                let residual = self.0.residual(at, index, true)?;
                check_shape(self.0, &residual).ok()?;
                residual
            };
            if weight == 0.0 {
                continue;
            }
            let (_, weight) = kernel.weigh(error.norm_squared(), weight);
            let own = jacobians.iter().find(|(block, _)| *block >= first_eliminated);
            for (a, ja) in jacobians.iter().filter(|(block, _)| *block < first_eliminated) {
                let weighted = ja.transpose() * weight;
                let mut gradient = kept.gradient.rows_mut(offsets[*a], sizes[*a]);
                gradient += &weighted * &error;
                for (b, jb) in jacobians.iter().filter(|(block, _)| *block < first_eliminated) {
                    let mut part = kept.matrix.view_mut((offsets[*a], offsets[*b]), (sizes[*a], sizes[*b]));
                    part += &weighted * jb;
                }
                if let Some((b, jb)) = own {
                    let coupling = &mut eliminated[b - first_eliminated].coupling;
                    let product = &weighted * jb;
                    match coupling.iter_mut().find(|(row, _)| *row == offsets[*a]) {
                        Some((_, sum)) => *sum += product,
                        None => coupling.push((offsets[*a], product)),
                    }
                }
            }
            if let Some((b, jb)) = own {
                let normal = &mut eliminated[b - first_eliminated].normal;
                let weighted = jb.transpose() * weight;
                normal.gradient += &weighted * &error;
                normal.matrix += &weighted * jb;
            }
        }
        Some(ArrowNormal { kept, eliminated })
    }

    fn moved(&self, at: &P::Unknowns, step: &DVector<f64>) -> P::Unknowns {
        self.0.moved(at, step.as_slice())
    }
}

#[cfg(test)]
#[path = "blocks_tests.rs"]
mod tests;
