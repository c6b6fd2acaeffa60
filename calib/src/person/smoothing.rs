//! Local quadratic fit of unevenly sampled tracks: value and slope at any instant.

use glam::{DMat3, DVec3};

/// Standard deviation of the smoothing window, seconds, and its least value in intervals between images.
const SMOOTH_S: f64 = 0.03;
const SMOOTH_INTERVALS: f64 = 1.0;
/// Radius of the window in standard deviations.
const REACH: f64 = 2.5;
/// Fewest samples of a smoothed value.
const LEAST_SAMPLES: usize = 4;

/// Samples in a window, with their weights in the fitted value and in its slope.
pub(crate) type Weighted<'a, T> = (&'a [T], Vec<(f64, f64)>);

/// Returns the samples around a time with their weights in the value and the slope (per second) of the local quadratic fit there; `None`
/// with too few samples, or samples on one side only.
pub(crate) fn parabola_weights<T>(
    samples: &[T],
    time: impl Fn(&T) -> i64,
    trust: impl Fn(&T) -> f64,
    nanos: i64,
    interval_s: f64,
) -> Option<Weighted<'_, T>> {
    let window = SMOOTH_S.max(SMOOTH_INTERVALS * interval_s);
    let reach = (REACH * window * 1e9) as i64;
    let from = samples.partition_point(|sample| time(sample) < nanos.saturating_sub(reach));
    let count = samples[from..].partition_point(|sample| time(sample) <= nanos.saturating_add(reach));
    let near = &samples[from..from + count];
    let mut normal = DMat3::ZERO;
    let rows: Vec<(DVec3, f64)> = near
        .iter()
        .map(|sample| {
            let x = time(sample).saturating_sub(nanos) as f64 * 1e-9 / window;
            let row = DVec3::new(1.0, x, x * x);
            let weight = (-0.5 * x * x).exp() * trust(sample);
            normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
            (row, weight)
        })
        .collect();
    let is_between = rows.iter().any(|(row, _)| row.y <= 0.0) && rows.iter().any(|(row, _)| row.y >= 0.0);
    if !is_between || near.len() < LEAST_SAMPLES || normal.determinant().abs() < 1e-9 {
        return None;
    }
    let inverse = normal.inverse();
    let weights = rows.into_iter().map(|(row, weight)| {
        let solved = inverse * (row * weight);
        (solved.x, solved.y / window)
    });
    Some((near, weights.collect()))
}
