//! Offset and drift between two clocks: robust weighted line fit to integer nanoseconds.
//!
//! Times and offsets of clocks exceed the 53 bits of an `f64`. The fit subtracts an anchor time and a base offset in
//! integers first; only the small remainder becomes a float. Differences are taken modulo 2⁶⁴: they must be below 2⁶³ ns
//! (292 years), the times themselves may be anywhere.

use crate::percentile::median;

/// Standard deviation of a normal distribution over the median of its absolute values.
const SIGMA_PER_MEDIAN: f64 = 1.4826;

/// Comparison of two clocks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineSample {
    /// Time of the first clock, nanoseconds.
    pub time_nanos: i64,
    /// Second clock minus first clock at that time, nanoseconds.
    pub offset_nanos: i64,
    /// Inverse variance, in any unit; samples of weight 0 are ignored.
    pub weight: f64,
}

/// Clock offset as a line: `offset(time) = offset_nanos + drift * (time - anchor_nanos)`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ClockLine {
    /// Time at which the offset is `offset_nanos`, nanoseconds.
    pub anchor_nanos: i64,
    /// Offset at the anchor, nanoseconds.
    pub offset_nanos: i64,
    /// Slope; 1e-6 is one part per million.
    pub drift: f64,
}

impl ClockLine {
    /// Returns the difference of the offset at a time from that at the anchor, nanoseconds.
    #[must_use]
    pub fn drifted_nanos(&self, time_nanos: i64) -> i64 {
        (self.drift * time_nanos.wrapping_sub(self.anchor_nanos) as f64).round() as i64
    }

    /// Returns the offset at a time, nanoseconds; saturates at the ends of `i64`.
    #[must_use]
    pub fn offset_at(&self, time_nanos: i64) -> i64 {
        self.offset_nanos.saturating_add(self.drifted_nanos(time_nanos))
    }
}

/// Outlier rejection of a line fit. The first fit uses all samples, so that outliers must be few: at most about a fifth where they lie
/// on one side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineGate {
    /// Number of fits, each without the outliers of the previous one; at least 1.
    pub rounds: usize,
    /// Distance from the line beyond which samples are outliers, in standard deviations (1.4826 times the median distance).
    pub sigmas: f64,
    /// Distance from the line within which samples are never outliers, nanoseconds.
    pub least_nanos: f64,
}

/// Options of [`fit_line`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineOptions {
    /// Smallest number of samples for which the drift is fitted; it is 0 with fewer.
    pub least_drift_samples: usize,
    /// Prior for a drift of 0: standard deviation of a sample of weight 1, seconds, over that of the drift. 0 for no prior.
    pub drift_prior_secs: f64,
    /// Largest drift; steeper fits are clamped. Infinite for no limit.
    pub max_drift: f64,
    /// Outlier rejection, if any.
    pub gate: Option<LineGate>,
}

impl Default for LineOptions {
    fn default() -> Self {
        Self { least_drift_samples: 2, drift_prior_secs: 0.0, max_drift: f64::INFINITY, gate: None }
    }
}

/// Result of [`fit_line`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineFit {
    /// Line with the given anchor.
    pub line: ClockLine,
    /// Weighted root mean square distance of the inliers, nanoseconds.
    pub residual_nanos: f64,
    /// Number of samples that are not outliers.
    pub inliers: usize,
}

/// Fits offset and drift by weighted least squares around an anchor time and a base offset (near the samples, for precision).
///
/// ```
/// use flyrig_solve::{LineOptions, LineSample, fit_line};
///
/// // The second clock is 5 ms ahead and gains 20 parts per million.
/// let sample = |i: i64| LineSample { time_nanos: i * 1_000_000_000, offset_nanos: 5_000_000 + 20_000 * i, weight: 1.0 };
/// let samples: Vec<LineSample> = (0..10).map(sample).collect();
/// let options = LineOptions { least_drift_samples: 2, drift_prior_secs: 0.0, max_drift: f64::INFINITY, gate: None };
/// let fit = fit_line(&samples, 0, 5_000_000, &options).unwrap();
/// assert_eq!(fit.line.offset_at(100_000_000_000), 7_000_000);
/// assert!((fit.line.drift - 20e-6).abs() < 1e-12);
/// ```
///
/// `None` without a sample of positive weight, and when a weight is negative or not finite or the fit is not finite.
#[must_use]
pub fn fit_line(
    samples: &[LineSample],
    anchor_nanos: i64,
    base_offset_nanos: i64,
    options: &LineOptions,
) -> Option<LineFit> {
    if !samples.iter().all(|sample| sample.weight >= 0.0 && sample.weight.is_finite()) {
        return None;
    }
    // Seconds from the anchor, nanoseconds off the base, weight.
    let points: Vec<[f64; 3]> = samples
        .iter()
        .filter(|sample| sample.weight > 0.0)
        .map(|sample| {
            let x = sample.time_nanos.wrapping_sub(anchor_nanos) as f64 * 1e-9;
            [x, sample.offset_nanos.wrapping_sub(base_offset_nanos) as f64, sample.weight]
        })
        .collect();
    if points.is_empty() {
        return None;
    }
    let mut kept = points.clone();
    let mut line = (0.0, 0.0);
    for _ in 0..options.gate.map_or(1, |gate| gate.rounds.max(1)) {
        line = least_squares(&kept, options)?;
        let Some(gate) = options.gate else { break };
        let off = |[x, y, _]: &[f64; 3]| (y - line.0 - line.1 * x).abs();
        let mut distances: Vec<f64> = points.iter().map(off).collect();
        let limit = (median(&mut distances)? * SIGMA_PER_MEDIAN * gate.sigmas).max(gate.least_nanos);
        kept = points.iter().copied().filter(|point| off(point) <= limit).collect();
    }
    let (intercept, slope) = line;
    let total: f64 = kept.iter().map(|[.., weight]| weight).sum();
    let squares: f64 = kept.iter().map(|[x, y, weight]| weight * (y - intercept - slope * x).powi(2)).sum();
    Some(LineFit {
        line: ClockLine {
            anchor_nanos,
            offset_nanos: base_offset_nanos.wrapping_add(intercept.round() as i64),
            drift: slope * 1e-9,
        },
        residual_nanos: if kept.is_empty() { 0.0 } else { (squares / total).sqrt() },
        inliers: kept.len(),
    })
}

/// Returns intercept and slope (nanoseconds, and nanoseconds per second) of points (x, y, weight), centred for precision.
fn least_squares(points: &[[f64; 3]], options: &LineOptions) -> Option<(f64, f64)> {
    let total: f64 = points.iter().map(|[.., weight]| weight).sum();
    let (mx, my) =
        points.iter().fold((0.0, 0.0), |(mx, my), [x, y, weight]| (mx + weight * x / total, my + weight * y / total));
    let (sxx, sxy) = points.iter().fold((0.0, 0.0), |(sxx, sxy), [x, y, weight]| {
        (sxx + weight * (x - mx).powi(2), sxy + weight * ((x - mx) * (y - my)))
    });
    let sxx = sxx + options.drift_prior_secs.powi(2);
    let slope = if points.len() >= options.least_drift_samples && sxx > 0.0 { sxy / sxx } else { 0.0 };
    let most = options.max_drift * 1e9;
    let slope = if slope.abs() > most { most.copysign(slope) } else { slope };
    let intercept = my - slope * mx;
    (intercept.is_finite() && slope.is_finite()).then_some((intercept, slope))
}

#[cfg(test)]
mod tests {
    use flyrig_model::SplitMix64;

    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn sample(time_nanos: i64, offset_nanos: i64) -> LineSample {
        LineSample { time_nanos, offset_nanos, weight: 1.0 }
    }

    /// Solves the uncentred normal equations, with the prior as a row of its own, by Cramer's rule.
    fn reference(samples: &[LineSample], anchor: i64, base: i64, prior: f64) -> (f64, f64) {
        let [mut w, mut x, mut y, mut xx, mut xy] = [0.0, 0.0, 0.0, prior * prior, 0.0];
        for sample in samples {
            let dx = (i128::from(sample.time_nanos) - i128::from(anchor)) as f64 * 1e-9;
            let dy = (i128::from(sample.offset_nanos) - i128::from(base)) as f64;
            w += sample.weight;
            x += sample.weight * dx;
            y += sample.weight * dy;
            xx += sample.weight * dx * dx;
            xy += sample.weight * dx * dy;
        }
        let slope = (w * xy - x * y) / (w * xx - x * x);
        ((y - slope * x) / w, slope)
    }

    #[test]
    fn weighted_fit_with_a_prior_matches_cramers_rule() {
        let mut random = SplitMix64(21);
        for round in 0..200 {
            let base = (random.signed() * 1e18) as i64;
            let anchor = (random.signed() * 1e18) as i64;
            let samples: Vec<LineSample> = (0..3 + round % 30)
                .map(|i| LineSample {
                    time_nanos: anchor + i * SECOND - (random.signed() * 1e8) as i64,
                    offset_nanos: base + i * 50_000 + (random.signed() * 1e6) as i64,
                    weight: 0.01 + random.signed().abs(),
                })
                .collect();
            let prior = if round % 2 == 0 { 0.0 } else { 3.0 * random.signed().abs() };
            let options = LineOptions { drift_prior_secs: prior, ..LineOptions::default() };
            let fit = fit_line(&samples, anchor, base, &options).unwrap();
            let (intercept, slope) = reference(&samples, anchor, base, prior);
            assert!((fit.line.drift * 1e9 - slope).abs() < 1e-9 * (1.0 + slope.abs()), "{fit:?} {slope}");
            let off = fit.line.offset_nanos - base;
            assert!((off as f64 - intercept).abs() <= 0.5 + 1e-6, "{off} {intercept}");
            assert_eq!(fit.inliers, samples.len());
        }
    }

    #[test]
    fn huge_times_and_offsets_lose_no_nanosecond() {
        for (anchor, base) in [(0, 0), (i64::MAX - 5 * SECOND, i64::MIN + 7), (i64::MIN, i64::MAX)] {
            let samples: Vec<LineSample> = (0..100)
                .map(|i| {
                    let dt = i * SECOND / 10 - 5 * SECOND;
                    sample(anchor.wrapping_add(dt), base.wrapping_add(3 + dt / 100_000))
                })
                .collect();
            let fit = fit_line(&samples, anchor, base, &LineOptions::default()).unwrap();
            assert_eq!(fit.line.offset_nanos, base.wrapping_add(3), "{anchor}");
            assert!((fit.line.drift - 1e-5).abs() < 1e-15, "{}", fit.line.drift);
            assert!(fit.residual_nanos < 1e-3, "{fit:?}");
            assert_eq!(fit.line.drifted_nanos(anchor.wrapping_add(SECOND)), 10_000);
        }
    }

    #[test]
    fn a_tenth_of_outliers_is_rejected() {
        let mut random = SplitMix64(22);
        let samples: Vec<LineSample> = (0..300)
            .map(|i| {
                let wild = if i % 10 == 0 { 50_000_000 + (random.signed() * 4e7) as i64 } else { 0 };
                sample(i * SECOND / 10, 1000 + i * 5_000 + (random.signed() * 100_000.0) as i64 + wild)
            })
            .collect();
        let gate = LineGate { rounds: 6, sigmas: 4.0, least_nanos: 100_000.0 };
        let robust = LineOptions { gate: Some(gate), ..LineOptions::default() };
        let fit = fit_line(&samples, 0, 0, &robust).unwrap();
        assert_eq!(fit.inliers, 270);
        assert!((fit.line.offset_nanos - 1000).abs() < 20_000 && (fit.line.drift - 50e-6).abs() < 2e-6, "{fit:?}");
        let plain = fit_line(&samples, 0, 0, &LineOptions::default()).unwrap();
        assert!(plain.line.offset_nanos > 3_000_000, "the outliers matter: {plain:?}");
    }

    #[test]
    fn few_samples_limits_and_equal_times_give_no_wild_drift() {
        let two = [sample(0, 0), sample(10, 1_000_000)];
        let options = LineOptions { least_drift_samples: 3, ..LineOptions::default() };
        let fit = fit_line(&two, 0, 0, &options).unwrap();
        assert_eq!(fit.line, ClockLine { anchor_nanos: 0, offset_nanos: 500_000, drift: 0.0 });
        let clamped = fit_line(&two, 0, 0, &LineOptions { max_drift: 1e-4, ..LineOptions::default() }).unwrap();
        assert!((clamped.line.drift - 1e-4).abs() < 1e-18 && clamped.line.offset_nanos == 500_000, "{clamped:?}");
        let same = fit_line(&[sample(5, 1), sample(5, 4)], 5, 0, &LineOptions::default()).unwrap();
        assert_eq!((same.line.offset_nanos, same.line.drift.to_bits()), (3, 0));
    }

    #[test]
    fn nothing_and_poison_give_none() {
        let with = |weight: f64| [LineSample { weight, ..sample(0, 0) }, sample(SECOND, 5)];
        let options = LineOptions::default();
        assert_eq!(fit_line(&[], 0, 0, &options), None);
        assert_eq!(fit_line(&with(0.0)[..1], 0, 0, &options), None);
        for weight in [f64::NAN, f64::INFINITY, -1.0] {
            assert_eq!(fit_line(&with(weight), 0, 0, &options), None);
        }
        assert_eq!(fit_line(&with(0.0), 0, 0, &options).unwrap().inliers, 1);
        for drift_prior_secs in [f64::NAN, f64::INFINITY] {
            let fit = fit_line(&with(1.0), 0, 0, &LineOptions { drift_prior_secs, ..options });
            assert!(fit.is_none_or(|fit| fit.line.drift.is_finite()));
        }
        let ends = [sample(i64::MIN, i64::MAX), sample(i64::MAX, i64::MIN), sample(0, 0)];
        let fit = fit_line(&ends, 0, 0, &options).unwrap();
        assert!(fit.line.drift.is_finite() && fit.residual_nanos.is_finite());
        let _ = (fit.line.offset_at(i64::MIN), fit.line.offset_at(i64::MAX));
    }
}
