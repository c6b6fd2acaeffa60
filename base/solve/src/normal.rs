//! Normal equations of least squares: dense, and with eliminated blocks (Schur complement).

use nalgebra::{Cholesky, DMatrix, DVector, DVectorView, Dyn};

/// Squared pivot of the matrix scaled to a unit diagonal below which it is rank-deficient: 1 - R² of an unknown given the previous
/// ones.
const LEAST_PIVOT: f64 = 1e-12;

/// Operations of a Levenberg-Marquardt step on a linearized problem.
pub trait NormalEquations {
    /// Returns the largest absolute element of the gradient.
    fn gradient_max(&self) -> f64;

    /// Returns the solution `x` of `(N + damping diag(N) + floor I) x = -gradient`; `None` where there is no finite one.
    fn step(&self, damping: f64, floor: f64) -> Option<DVector<f64>>;
}

/// Symmetric matrix and gradient.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseNormal {
    /// Matrix `JᵀWJ`, of which the lower triangle is used.
    pub matrix: DMatrix<f64>,
    /// Gradient `JᵀWe`.
    pub gradient: DVector<f64>,
}

impl DenseNormal {
    /// Creates equations of `size` unknowns, all 0.
    #[must_use]
    pub fn zeros(size: usize) -> Self {
        Self { matrix: DMatrix::zeros(size, size), gradient: DVector::zeros(size) }
    }

    /// Factors the undamped matrix; `None` when it is rank-deficient or not finite.
    #[must_use]
    pub fn factor(&self) -> Option<Factor> {
        Factor::new(&self.matrix)
    }

    /// Returns the undamped step to the minimum and the covariance of the unknowns; `None` when the matrix is
    /// rank-deficient or not finite.
    #[must_use]
    pub fn minimum(&self) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let factor = self.factor()?;
        let step = -factor.solve(&column(&self.gradient)).column(0);
        Some((step, factor.covariance()))
    }
}

impl NormalEquations for DenseNormal {
    fn gradient_max(&self) -> f64 {
        max_abs(&self.gradient)
    }

    fn step(&self, damping: f64, floor: f64) -> Option<DVector<f64>> {
        let step = -Cholesky::new(damped(&self.matrix, damping, floor))?.solve(&self.gradient);
        step.iter().all(|value| value.is_finite()).then_some(step)
    }
}

fn max_abs(values: &DVector<f64>) -> f64 {
    values.iter().fold(0.0, |most, value| most.max(value.abs()))
}

fn damped(matrix: &DMatrix<f64>, damping: f64, floor: f64) -> DMatrix<f64> {
    let mut damped = matrix.clone();
    for k in 0..damped.nrows() {
        damped[(k, k)] += damping * matrix[(k, k)] + floor;
    }
    damped
}

/// Cholesky factors of a positive definite matrix, scaled to a unit diagonal so that unknowns may have any units.
#[derive(Debug, Clone)]
pub struct Factor {
    cholesky: Cholesky<f64, Dyn>,
    /// Inverse square root of the diagonal.
    scale: DVector<f64>,
}

impl Factor {
    /// Factors a symmetric matrix, of which the lower triangle is used; `None` when it is not square, rank-deficient or not finite.
    #[must_use]
    pub fn new(matrix: &DMatrix<f64>) -> Option<Self> {
        if !matrix.is_square() {
            return None;
        }
        let scale = matrix.diagonal().map(|value| 1.0 / value.sqrt());
        let scaled = DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |r, c| matrix[(r, c)] * scale[r] * scale[c]);
        // The upper triangle is not read.
        if !scale.iter().all(|v| v.is_finite()) || !scaled.lower_triangle().iter().all(|v| v.is_finite()) {
            return None;
        }
        let cholesky = Cholesky::new(scaled)?;
        let is_regular = cholesky.l_dirty().diagonal().iter().all(|pivot| pivot * pivot > LEAST_PIVOT);
        is_regular.then_some(Self { cholesky, scale })
    }

    /// Returns `matrix⁻¹ right`, of equally many rows.
    #[must_use]
    pub fn solve(&self, right: &DMatrix<f64>) -> DMatrix<f64> {
        let rows = |m: &mut DMatrix<f64>| m.column_iter_mut().for_each(|mut c| c.component_mul_assign(&self.scale));
        let mut solution = right.clone();
        rows(&mut solution);
        self.cholesky.solve_mut(&mut solution);
        rows(&mut solution);
        solution
    }

    /// Returns the inverse of the matrix: the covariance of the unknowns for weights that are inverse variances.
    #[must_use]
    pub fn covariance(&self) -> DMatrix<f64> {
        let mut inverse = self.cholesky.inverse();
        for c in 0..inverse.ncols() {
            for r in 0..inverse.nrows() {
                inverse[(r, c)] *= self.scale[r] * self.scale[c];
            }
        }
        inverse
    }
}

/// Block of unknowns that is coupled to kept unknowns only, such as a point in view of cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct EliminatedBlock {
    /// Equations of the block alone.
    pub normal: DenseNormal,
    /// First kept unknown, and the matrix that couples the kept unknowns from there on (rows) with the block (columns).
    pub coupling: Vec<(usize, DMatrix<f64>)>,
}

/// Normal equations in which some blocks are coupled to kept unknowns only, never to each other. Their unknowns follow the kept ones.
#[derive(Debug, Clone, PartialEq)]
pub struct ArrowNormal {
    /// Equations of the kept unknowns alone.
    pub kept: DenseNormal,
    /// Eliminated blocks, in order.
    pub eliminated: Vec<EliminatedBlock>,
}

impl ArrowNormal {
    /// Eliminates the blocks: returns the equations of the kept unknowns and the factors of each block. `None` when a block is
    /// rank-deficient.
    fn reduced(&self, damping: f64, floor: f64) -> Option<(DenseNormal, Vec<Factor>)> {
        let mut kept =
            DenseNormal { matrix: damped(&self.kept.matrix, damping, floor), gradient: self.kept.gradient.clone() };
        let mut factors = Vec::with_capacity(self.eliminated.len());
        for block in &self.eliminated {
            let factor = Factor::new(&damped(&block.normal.matrix, damping, floor))?;
            let own = factor.solve(&column(&block.normal.gradient));
            for (row, left) in &block.coupling {
                let mut gradient = kept.gradient.rows_mut(*row, left.nrows());
                gradient -= left * &own;
                let weighted = factor.solve(&left.transpose());
                for (col, right) in &block.coupling {
                    // The lower triangle is enough.
                    if col <= row {
                        let mut part = kept.matrix.view_mut((*row, *col), (left.nrows(), right.nrows()));
                        part -= (right * &weighted).transpose();
                    }
                }
            }
            factors.push(factor);
        }
        Some((kept, factors))
    }

    /// Returns the marginal covariance of the kept unknowns; `None` when the equations are rank-deficient (a free gauge, a point in view
    /// of one camera).
    #[must_use]
    pub fn covariance(&self) -> Option<DMatrix<f64>> {
        Some(self.reduced(0.0, 0.0)?.0.factor()?.covariance())
    }
}

impl NormalEquations for ArrowNormal {
    fn gradient_max(&self) -> f64 {
        let eliminated = self.eliminated.iter().map(|block| block.normal.gradient_max());
        eliminated.fold(self.kept.gradient_max(), f64::max)
    }

    fn step(&self, damping: f64, floor: f64) -> Option<DVector<f64>> {
        let (reduced, factors) = self.reduced(damping, floor)?;
        let mut step = reduced.step(0.0, 0.0)?.as_slice().to_vec();
        for (block, factor) in self.eliminated.iter().zip(&factors) {
            let mut right = block.normal.gradient.clone();
            for (row, left) in &block.coupling {
                right += left.transpose() * DVectorView::from_slice(&step[*row..row + left.nrows()], left.nrows());
            }
            step.extend(factor.solve(&column(&right)).iter().map(|value| -value));
        }
        step.iter().all(|value| value.is_finite()).then(|| DVector::from_vec(step))
    }
}

fn column(vector: &DVector<f64>) -> DMatrix<f64> {
    DMatrix::from_column_slice(vector.len(), 1, vector.as_slice())
}

#[cfg(test)]
mod tests {
    use flyrig_model::SplitMix64;

    use super::*;

    /// Returns equations of random residuals with one eliminated block each, in arrow form and dense.
    fn arrow(random: &mut SplitMix64, kept: [usize; 3], eliminated: usize, rows: usize) -> (ArrowNormal, DenseNormal) {
        let size: usize = kept.iter().sum();
        let mut dense = DenseNormal::zeros(size + 3 * eliminated);
        let starts = [0, kept[0], kept[0] + kept[1]];
        for row in 0..rows {
            let mut jacobian = DMatrix::zeros(2, dense.gradient.len());
            let error = DVector::from_fn(2, |_, _| random.signed());
            for k in 0..3 {
                if row % 3 != k {
                    jacobian.view_mut((0, starts[k]), (2, kept[k])).iter_mut().for_each(|v| *v = random.signed());
                }
            }
            let mut own = jacobian.view_mut((0, size + 3 * (row % eliminated)), (2, 3));
            own.iter_mut().for_each(|v| *v = random.signed());
            dense.matrix += jacobian.transpose() * &jacobian;
            dense.gradient += jacobian.transpose() * error;
        }
        let blocks = (0..eliminated).map(|i| {
            let at = size + 3 * i;
            EliminatedBlock {
                normal: DenseNormal {
                    matrix: dense.matrix.view((at, at), (3, 3)).into_owned(),
                    gradient: dense.gradient.rows(at, 3).into_owned(),
                },
                coupling: (0..3)
                    .map(|k| (starts[k], dense.matrix.view((starts[k], at), (kept[k], 3)).into_owned()))
                    .collect(),
            }
        });
        let own = DenseNormal {
            matrix: dense.matrix.view((0, 0), (size, size)).into_owned(),
            gradient: dense.gradient.rows(0, size).into_owned(),
        };
        (ArrowNormal { kept: own, eliminated: blocks.collect() }, dense)
    }

    #[test]
    fn eliminating_blocks_changes_neither_step_nor_covariance() {
        let mut random = SplitMix64(31);
        for kept in [[3, 6, 15], [1, 1, 1], [6, 6, 6]] {
            let (arrow, dense) = arrow(&mut random, kept, 5, 90);
            for damping in [0.0, 1e-3, 10.0] {
                let (a, b) = (arrow.step(damping, 1e-9).unwrap(), dense.step(damping, 1e-9).unwrap());
                assert!((&a - &b).amax() < 1e-10 * b.amax().max(1.0), "{kept:?} {damping}: {}", (&a - &b).amax());
            }
            assert!((arrow.gradient_max() - dense.gradient_max()).abs() < 1e-15);
            let size = kept.iter().sum();
            let all = dense.matrix.clone().lu().try_inverse().unwrap();
            let covariance = arrow.covariance().unwrap();
            assert!((&covariance - all.view((0, 0), (size, size))).amax() < 1e-10 * covariance.amax(), "{kept:?}");
        }
    }

    #[test]
    fn factors_match_lu_whatever_the_units() {
        let mut random = SplitMix64(32);
        for units in [1.0, 1e9] {
            let rows = DMatrix::from_fn(12, 6, |_, c| random.signed() * if c < 3 { units } else { 1.0 / units });
            let normal = DenseNormal { matrix: rows.transpose() * &rows, gradient: DVector::zeros(6) };
            let factor = normal.factor().unwrap();
            let inverse = normal.matrix.clone().lu().try_inverse().unwrap();
            let covariance = factor.covariance();
            let worst = covariance.iter().zip(inverse.iter()).map(|(a, b)| (a - b).abs() / b.abs()).fold(0.0, f64::max);
            assert!(worst < 1e-9, "{worst}");
            let right = DVector::from_fn(6, |_, _| random.signed());
            let (minimum, _) = DenseNormal { gradient: right.clone(), ..normal }.minimum().unwrap();
            let off = (&minimum + &inverse * &right).component_div(&(&inverse * &right));
            assert!(off.amax() < 1e-9, "{off}");
            let solved = factor.solve(&DMatrix::identity(6, 6));
            let worst = covariance.iter().zip(solved.iter()).map(|(a, b)| (a - b).abs() / b.abs()).fold(0.0, f64::max);
            assert!(worst < 1e-9, "{worst}");
        }
    }

    #[test]
    fn rank_deficient_and_poisoned_matrices_are_refused() {
        let row = DMatrix::from_row_slice(1, 3, &[1.0, 2.0, 3.0]);
        let deficient = row.transpose() * &row;
        assert!(Factor::new(&deficient).is_none());
        assert!(Factor::new(&DMatrix::zeros(2, 2)).is_none() && Factor::new(&DMatrix::zeros(2, 3)).is_none());
        assert!(Factor::new(&DMatrix::from_element(2, 2, f64::NAN)).is_none());
        assert!(Factor::new(&DMatrix::from_diagonal_element(2, 2, f64::INFINITY)).is_none());
        assert!(Factor::new(&DMatrix::from_row_slice(2, 2, &[1.0, 0.0, f64::NAN, 1.0])).is_none());
        assert!(Factor::new(&DMatrix::from_diagonal_element(2, 2, -1.0)).is_none());
        let normal = DenseNormal { matrix: deficient, gradient: DVector::from_element(3, 1.0) };
        assert!(normal.step(1e-3, 1e-9).is_some(), "damping makes it definite");
        let poisoned = DenseNormal { gradient: DVector::from_element(3, f64::NAN), ..normal };
        assert!(poisoned.step(1e-3, 1e-9).is_none());
        assert_eq!(DenseNormal::zeros(0).step(0.0, 0.0).map(|step| step.len()), Some(0));
    }
}
