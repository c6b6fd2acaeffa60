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

/// Sums the lanes of eight lists at once, each in a fixed order: halves of two lists form one, so that no addition has idle lanes.
#[inline(always)]
pub(crate) fn sums(lists: &[Lanes; LANES]) -> Lanes {
    // Lanes i and i + 4, then i and i + 2, then both that are left.
    let fours: [Lanes; 4] = from_fn(|n| {
        let [a, b] = [&lists[2 * n], &lists[2 * n + 1]];
        from_fn(|i| if i < 4 { a[i] + a[i + 4] } else { b[i - 4] + b[i] })
    });
    let twos: [Lanes; 2] = from_fn(|n| {
        let [a, b] = [&fours[2 * n], &fours[2 * n + 1]];
        from_fn(|i| {
            let (from, at) = (if i < 4 { a } else { b }, 4 * (i % 4 / 2) + i % 2);
            from[at] + from[at + 2]
        })
    });
    from_fn(|i| {
        let from = &twos[i / 4];
        from[2 * (i % 4)] + from[2 * (i % 4) + 1]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_summed() {
        let lists: [Lanes; LANES] = from_fn(|n| from_fn(|i| (n * LANES + i) as f32));
        let expected: Lanes = lists.map(|lanes| lanes.iter().sum());
        for (found, expected) in sums(&lists).into_iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
    }

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
