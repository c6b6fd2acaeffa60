//! Means, percentiles and growth of measured values.

/// Returns the mean; NaN without values.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Returns the value at a share (0..=1) of the sorted values; NaN without values.
pub fn percentile(values: &[f64], share: f64) -> f64 {
    flyrig_solve::percentile(&mut values.to_vec(), share).unwrap_or(f64::NAN)
}

/// Returns the exponent p of `y = c x^p` through points, by least squares of the logarithms.
///
/// Points without a logarithm are ignored. NaN with fewer than two distinct x.
pub fn exponent(points: &[(f64, f64)]) -> f64 {
    let positive = points.iter().filter(|(x, y)| *x > 0.0 && *y > 0.0);
    let logs: Vec<(f64, f64)> = positive.map(|(x, y)| (x.ln(), y.ln())).collect();
    let count = logs.len() as f64;
    let (mean_x, mean_y) =
        (logs.iter().map(|(x, _)| x).sum::<f64>() / count, logs.iter().map(|(_, y)| y).sum::<f64>() / count);
    let covariance: f64 = logs.iter().map(|(x, y)| (x - mean_x) * (y - mean_y)).sum();
    let spread: f64 = logs.iter().map(|(x, _)| (x - mean_x).powi(2)).sum();
    if spread > 1e-9 { covariance / spread } else { f64::NAN }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_are_those_of_powers() {
        let of = |power: f64| exponent(&[1.0f64, 2.0, 5.0, 11.0].map(|x| (x, 3.0 * x.powf(power))));
        for power in [0.0, 0.5, 1.0, 2.0, 3.0] {
            assert!((of(power) - power).abs() < 1e-9, "{power}: {}", of(power));
        }
        for few in [vec![], vec![(1.0, 2.0)], vec![(2.0, 2.0), (2.0, 3.0)], vec![(0.0, 1.0), (1.0, f64::NAN)]] {
            assert!(exponent(&few).is_nan(), "{few:?}");
        }
        // A stage that takes no time (a given pose has no perception) has no exponent.
        assert!(exponent(&[(1.0, 0.0), (2.0, 0.0)]).is_nan());
    }
}
