//! Median of a slice.

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Random;

    #[test]
    fn median_matches_a_sorted_copy() {
        assert_eq!(median(&mut []), None);
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [f64::NAN, 1.0, 2.0]), Some(2.0));
        let mut random = Random(1);
        for count in 1..50 {
            let mut values: Vec<f64> = (0..count).map(|_| random.signed()).collect();
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            assert_eq!(median(&mut values), Some(sorted[count / 2]));
        }
    }
}
