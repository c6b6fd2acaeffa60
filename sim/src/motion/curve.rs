//! Closed curves through a few knots, of which the clips are made.

use std::f64::consts::PI;

/// Evaluates at `phase` (modulo 1) the closed curve through `(phase, value)` knots with increasing phases in 0..1. Once
/// differentiable everywhere, the seam included, and never beyond its knots: a piecewise cubic with the slopes of
/// Fritsch and Butland (A Method for Constructing Local Monotone Piecewise Cubic Interpolants, SIAM J. Sci. Stat.
/// Comput. 5, 1984).
pub(crate) fn closed(phase: f64, knots: &[(f64, f64)]) -> f64 {
    let count = knots.len();
    if count < 2 {
        return knots.first().map_or(0.0, |knot| knot.1);
    }
    let phase = phase.rem_euclid(1.0);
    let next = knots.partition_point(|knot| knot.0 <= phase);
    let knot = |i: usize| {
        // Two rounds of knots before, so that `i - 1` exists.
        let (t, v) = knots[i % count];
        (t + (i / count) as f64 - 2.0, v)
    };
    let at = next + 2 * count - 1;
    let secant = |i: usize| {
        let (a, b) = (knot(i), knot(i + 1));
        ((b.0 - a.0).max(1e-9), (b.1 - a.1) / (b.0 - a.0).max(1e-9))
    };
    let slope = |i: usize| {
        let ((h0, d0), (h1, d1)) = (secant(i - 1), secant(i));
        if d0 * d1 <= 0.0 {
            return 0.0;
        }
        let share = (h0 + 2.0 * h1) / (3.0 * (h0 + h1));
        d0 * d1 / (share * d1 + (1.0 - share) * d0)
    };
    let ((t0, v0), (width, rise)) = (knot(at), secant(at));
    let s = (phase - t0) / width;
    hermite(s, [v0, v0 + rise * width], [slope(at) * width, slope(at + 1) * width])
}

/// Rises from 0 at `t <= 0` to 1 at `t >= 1`, with zero slope at either end.
pub(crate) fn ease(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Evaluates the cubic from `values[0]` to `values[1]` over `t` in 0..=1 with these slopes at the ends.
pub(crate) fn hermite(t: f64, values: [f64; 2], slopes: [f64; 2]) -> f64 {
    let rise = values[1] - values[0];
    values[0]
        + t * (slopes[0] + t * (3.0 * rise - 2.0 * slopes[0] - slopes[1] + t * (slopes[0] + slopes[1] - 2.0 * rise)))
}

/// Evaluates a bump: 0 at both ends of 0..=1, 1 in the middle, zero slope at the ends.
pub(crate) fn hump(t: f64) -> f64 {
    (PI * t.clamp(0.0, 1.0)).sin().powi(2)
}

/// Returns a smooth closed sequence nowhere below the given one: the largest of `2 * radius + 1` neighbours, averaged
/// over as many with a cosine window.
pub(crate) fn smooth_above(values: &[f64], radius: usize) -> Vec<f64> {
    let count = values.len();
    let around = |i: usize| (0..=2 * radius).map(move |k| (i + count * (radius + 1) + k - radius) % count);
    let largest: Vec<f64> =
        (0..count).map(|i| around(i).map(|k| values[k]).fold(f64::NEG_INFINITY, f64::max)).collect();
    let weights: Vec<f64> = (1..=2 * radius + 1).map(|k| hump(k as f64 / (2 * radius + 2) as f64)).collect();
    let total: f64 = weights.iter().sum();
    (0..count).map(|i| around(i).zip(&weights).map(|(k, weight)| largest[k] * weight).sum::<f64>() / total).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_curve_meets_its_knots_stays_between_them_and_has_no_seam() {
        let knots = [(0.1, 0.0), (0.3, 1.0), (0.35, 1.2), (0.8, 0.5), (0.9, 0.5)];
        for (t, v) in knots {
            assert!((closed(t, &knots) - v).abs() < 1e-12 && (closed(t - 3.0, &knots) - v).abs() < 1e-9);
        }
        let mut before = (closed(-2e-4, &knots), closed(-1e-4, &knots));
        for i in 0..20_000 {
            let now = closed(f64::from(i) * 1e-4, &knots);
            assert!((0.0..=1.2 + 1e-12).contains(&now));
            // A jump of the slope would be far larger than the curvature times the step.
            assert!((now - 2.0 * before.1 + before.0).abs() < 2e-5, "{i}: {now}");
            before = (before.1, now);
        }
        let spiky: Vec<f64> = (0..50).map(|i| f64::from(i % 25 == 3)).collect();
        let smooth = smooth_above(&spiky, 4);
        assert!(smooth.iter().zip(&spiky).all(|(s, v)| *s >= v - 1e-12 && *s <= 1.0 + 1e-12));
        assert!(smooth[15].abs() < 1e-12 && (0..50).all(|i| (smooth[(i + 1) % 50] - smooth[i]).abs() < 0.21));
        assert!((closed(0.3, &[(0.0, 4.0)]) - 4.0).abs() < 1e-15 && closed(0.3, &[]).abs() < 1e-15);
    }
}
