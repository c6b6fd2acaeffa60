//! Quantisation to whole steps.

use crate::integers::MOST;

/// Returns the level of a value in steps, at most [`MOST`] in magnitude; values less than `1 - round_up` beyond a level round down to it,
/// NaN to 0.
///
/// It has no branch and no check of an impossible overflow, so that loops over it are vectorised.
#[inline]
pub(crate) fn quantise(value: f32, round_up: f32) -> i32 {
    // The cast saturates, and takes NaN to 0.
    let magnitude = ((value.abs() + round_up) as i32).min(MOST);
    let sign = value.to_bits().cast_signed() >> 31;
    (magnitude ^ sign).wrapping_sub(sign)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_fall_to_the_levels_around_them() {
        for (value, round_up, expected) in [
            (0.0, 0.3, 0),
            (-0.0, 0.3, 0),
            (0.69, 0.3, 0),
            (-0.69, 0.3, 0),
            (0.71, 0.3, 1),
            (-0.71, 0.3, -1),
            (7.49, 0.5, 7),
            (-7.51, 0.5, -8),
            (1e9, 0.5, MOST),
            (f32::NEG_INFINITY, 0.5, -MOST),
            (f32::NAN, 0.5, 0),
        ] {
            assert_eq!(quantise(value, round_up), expected, "{value} {round_up}");
        }
    }
}
