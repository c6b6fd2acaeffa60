//! Growth of Gaussians on a stretched surface, so that skirts and coats show no holes.
//!
//! ```
//! use flyrig_model::stretch;
//!
//! // Squared distances between the nodes: at rest 1, now 6.25. The surface is 2.5 times as long.
//! assert_eq!(stretch::growth(1.0f64, 6.25, f64::sqrt), 2.0);
//! // Gaussians overlap: a stretch of 1.2 opens no holes.
//! assert_eq!(stretch::growth(1.0f64, 1.44, f64::sqrt), 1.0);
//! ```

use core::ops::{Div, Mul};

/// Stretch up to which neighbouring Gaussians still close the surface; larger ones would only blur it.
const CLOSED: f32 = 1.25;
/// Largest growth, a factor.
const MOST_GROWTH: f32 = 4.0;

/// Returns the factor, 1 to 4, by which a Gaussian's standard deviation grows.
///
/// `rest` and `now` are sums of squared distances between the nodes that move the Gaussian, square metres, at rest and in the
/// present. The stretch is the root of their ratio; growth starts at a stretch of 1.25. Nodes without extent and numbers that are not finite give 1.
#[inline]
#[must_use]
pub fn growth<T>(rest: T, now: T, sqrt: impl Fn(T) -> T) -> T
where
    T: Copy + PartialOrd + From<f32> + Mul<Output = T> + Div<Output = T>,
{
    let (closed, most) = (T::from(CLOSED), T::from(MOST_GROWTH));
    // NaN fails each comparison. The root is taken only where it counts.
    let is_finite = now < T::from(f32::INFINITY);
    if rest > T::from(0.0) && is_finite && now > closed * closed * rest {
        let growth = sqrt(now / rest) / closed;
        if growth < most { growth } else { most }
    } else {
        T::from(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SplitMix64;

    /// The formula as it stood in the crate `stream`.
    fn of_stream(rest: f32, now: f32) -> f32 {
        let is_longer = rest > 0.0 && now.is_finite() && now > 1.25 * 1.25 * rest;
        if is_longer { (libm::sqrtf(now / rest) / 1.25).min(4.0) } else { 1.0 }
    }

    /// The formula as it stood in the crate `body`.
    fn of_body(then: f64, now: f64) -> f64 {
        let longer = if then > 0.0 && now.is_finite() { (now / then).sqrt() / 1.25 } else { 1.0 };
        longer.clamp(1.0, 4.0)
    }

    fn check(rest: f64, now: f64) {
        // Sums of squares in `body` are never negative; differences in `stream` may be, by rounding.
        if now.is_nan() || now >= 0.0 {
            let (ours, theirs) = (growth(rest, now, f64::sqrt), of_body(rest, now));
            assert_eq!(ours.to_bits(), theirs.to_bits(), "{rest} {now}: {ours} {theirs}");
        }
        let (rest, now) = (rest as f32, now as f32);
        let (ours, theirs) = (growth(rest, now, libm::sqrtf), of_stream(rest, now));
        assert_eq!(ours.to_bits(), theirs.to_bits(), "{rest} {now}: {ours} {theirs}");
    }

    #[test]
    fn every_bit_is_that_of_both_written_out_formulas() {
        let mut random = SplitMix64(11);
        for _ in 0..300_000 {
            let rest = random.unit() * 10f64.powi(random.below(9) as i32 - 6);
            check(rest, rest * 20.0 * random.unit());
            // Around the start of growth and around the largest one.
            for edge in [1.5625, 25.0] {
                let now = edge * rest;
                for now in [now.next_down().next_down(), now.next_down(), now, now.next_up(), now.next_up().next_up()] {
                    check(rest, now);
                }
                let single = (edge * rest) as f32;
                for now in [single.next_down(), single, single.next_up()] {
                    check(f64::from(rest as f32), f64::from(now));
                }
            }
        }
        for poison in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, -1.0] {
            check(poison, 1.0);
            check(1.0, poison);
            check(poison, poison);
        }
    }
}
