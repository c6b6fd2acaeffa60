//! Medians and percentiles of slices.

/// Returns the median and reorders the values; the upper of the two middle ones for an even count, `None` for an empty
/// slice. NaN sorts above infinity.
#[must_use]
pub fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Returns the largest value with at most the fraction `share`, 0..=1, of the others below it, and reorders the values; `None` for an
/// empty slice. NaN sorts above infinity.
///
/// ```
/// let mut errors_mm = [4.0, 1.0, 9.0, 2.0, 3.0];
/// assert_eq!(flyrig_solve::percentile(&mut errors_mm, 0.95), Some(4.0));
/// assert_eq!(flyrig_solve::percentile(&mut errors_mm, 1.0), Some(9.0));
/// assert_eq!(flyrig_solve::median(&mut errors_mm), Some(3.0));
/// ```
#[must_use]
pub fn percentile(values: &mut [f64], share: f64) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let at = (last as f64 * share) as usize;
    Some(*values.select_nth_unstable_by(at.min(last), f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use flyrig_model::SplitMix64;

    use super::*;

    #[test]
    fn medians_and_percentiles_match_a_sorted_copy() {
        assert_eq!((median(&mut []), percentile(&mut [], 0.5)), (None, None));
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [f64::NAN, 1.0, 2.0]), Some(2.0));
        let mut random = SplitMix64(1);
        for count in 1..50 {
            let mut values: Vec<f64> = (0..count).map(|_| random.signed()).collect();
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            assert_eq!(median(&mut values), Some(sorted[count / 2]));
            for share in [0.0, 0.05, 0.5, 0.95, 1.0] {
                let expected = sorted.get(((sorted.len() as f64 - 1.0) * share) as usize).copied();
                assert_eq!(percentile(&mut values, share), expected);
            }
        }
    }
}
