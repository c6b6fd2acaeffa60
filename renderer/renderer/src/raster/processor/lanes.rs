//! Arithmetic on eight pixels of a row at once.

use std::array::from_fn;

/// Pixels of a row that are computed together.
pub(crate) const LANES: usize = 8;

/// One number per pixel.
pub(crate) type Lanes = [f32; LANES];

/// Computes 2^x for x from -100 to 100, with a relative error of 2e-7; below, 2^-100.
///
/// Uses no multiply-add: it rounds once on processors that have it and twice on others, so that equal input would give
/// different bytes.
#[inline(always)]
pub(crate) fn exp2(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer, which is then in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    // ln(2)^n / n!
    const C1: f32 = std::f32::consts::LN_2;
    const C2: f32 = 0.240_226_5;
    const C3: f32 = 0.055_504_11;
    const C4: f32 = 0.009_618_129;
    const C5: f32 = 0.001_333_355_8;
    const C6: f32 = 0.000_154_035_3;
    let x = if x > -100.0 { x } else { -100.0 };
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    let power = 1.0 + f * (C1 + f * (C2 + f * (C3 + f * (C4 + f * (C5 + f * C6)))));
    f32::from_bits(power.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// Sums the lanes in a fixed order.
#[inline(always)]
pub(crate) fn sum(lanes: &Lanes) -> f32 {
    let [a, b, c, d]: [f32; 4] = from_fn(|i| lanes[i] + lanes[i + 4]);
    (a + c) + (b + d)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_of_two_are_exact_to_rounding() {
        let mut worst = 0.0f64;
        for i in -199_000..199_000 {
            let x = i as f32 * 5e-4;
            let expected = f64::from(x).exp2();
            worst = worst.max((f64::from(exp2(x)) / expected - 1.0).abs());
        }
        assert!(worst < 2.5e-7, "{worst}");
        for x in [f32::NEG_INFINITY, f32::NAN, -1e30, -101.0] {
            assert!(exp2(x) <= f32::MIN_POSITIVE * 1e9 && exp2(x) > 0.0, "{x}: {}", exp2(x));
        }
    }
}
