//! Robust kernels of residuals.

/// Cost `ρ(s)` of a squared residual norm `s`, close to `s` for small ones. Scales are in units of the residual's norm and must be
/// positive; otherwise costs are not finite, which [`crate::minimize`] rejects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kernel {
    /// Least squares: `ρ(s) = s`.
    Squares,
    /// Linear beyond the scale.
    Huber(f64),
    /// Logarithmic: `c² ln(1 + s/c²)`. A residual of the scale's size loses half its weight.
    Cauchy(f64),
    /// Bounded: `s / (1 + s/c²)`, at most `c²`.
    GemanMcClure(f64),
}

impl Kernel {
    /// Returns the cost `½ importance ρ(square)` and the weight `importance ρ'(square)` of iteratively reweighted least
    /// squares, with which `weight Jᵀe` is the cost's gradient.
    #[must_use]
    pub fn weigh(self, square: f64, importance: f64) -> (f64, f64) {
        match self {
            Self::Squares => (0.5 * importance * square, importance),
            Self::Huber(scale) => {
                let norm = square.sqrt();
                if scale.is_nan() || scale <= 0.0 {
                    (f64::NAN, f64::NAN)
                } else if norm <= scale {
                    (0.5 * importance * square, importance)
                } else {
                    (importance * scale * (norm - 0.5 * scale), importance * scale / norm)
                }
            }
            Self::Cauchy(scale) => {
                let square_scale = check(scale);
                (
                    0.5 * importance * square_scale * (square / square_scale).ln_1p(),
                    importance / (1.0 + square / square_scale),
                )
            }
            Self::GemanMcClure(scale) => {
                let shrink = 1.0 / (1.0 + square / check(scale));
                (0.5 * importance * square * shrink, importance * shrink * shrink)
            }
        }
    }
}

/// Returns the square of a scale; NaN where it is not positive.
fn check(scale: f64) -> f64 {
    if scale > 0.0 { scale * scale } else { f64::NAN }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KERNELS: [Kernel; 4] = [Kernel::Squares, Kernel::Huber(1.5), Kernel::Cauchy(1.5), Kernel::GemanMcClure(1.5)];

    #[test]
    fn weights_are_the_derivatives_of_the_costs() {
        for kernel in KERNELS {
            for square in [0.01f64, 0.5, 2.24, 2.26, 7.0, 1e4] {
                let step = 1e-6 * square;
                let (above, below) = (kernel.weigh(square + step, 3.0).0, kernel.weigh(square - step, 3.0).0);
                // d(½ρ)/ds is half the weight.
                let numeric = (above - below) / step;
                let weight = kernel.weigh(square, 3.0).1;
                assert!((numeric - weight).abs() < 1e-5 * weight.max(1e-4), "{kernel:?} {square}: {numeric} {weight}");
            }
        }
    }

    #[test]
    fn small_residuals_count_as_squares_and_large_ones_less() {
        for kernel in KERNELS {
            assert_eq!(kernel.weigh(0.0, 2.0), (0.0, 2.0));
            let (cost, _) = kernel.weigh(1e-8, 2.0);
            assert!((cost - 1e-8).abs() < 1e-15);
        }
        assert!((Kernel::Cauchy(1.5).weigh(2.25, 2.0).1 - 1.0).abs() < 1e-15);
        assert!(Kernel::GemanMcClure(1.5).weigh(1e12, 2.0).0 <= 2.25);
        assert!((Kernel::Huber(1.5).weigh(900.0, 1.0).0 - (1.5 * 30.0 - 1.125)).abs() < 1e-12);
    }

    #[test]
    fn senseless_scales_and_residuals_give_costs_that_are_not_finite() {
        for scale in [0.0, -1.0, f64::NAN] {
            for kernel in [Kernel::Huber(scale), Kernel::Cauchy(scale), Kernel::GemanMcClure(scale)] {
                assert!(!kernel.weigh(1.0, 1.0).0.is_finite(), "{kernel:?}");
            }
        }
        for kernel in KERNELS {
            assert!(!kernel.weigh(f64::NAN, 1.0).0.is_finite() && !kernel.weigh(f64::INFINITY, 1.0).0.is_finite());
        }
    }
}
