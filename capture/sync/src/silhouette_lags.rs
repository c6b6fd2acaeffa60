//! Constant time offsets between calibrated cameras, from the silhouettes of a moving person.
//!
//! A plane through the centres of two cameras that is tangent to a body is tangent to its silhouettes in both images
//! (epipolar tangency, e.g. Wong and Cipolla 2001; used for synchronisation by Sinha and Pollefeys 2004). The angles of
//! the two outermost tangent planes are therefore the same for both cameras at one instant, whatever side they see: two
//! curves over time per pair of cameras that differ by the time offset only.

use flyrig_solve::median;
use flyrig_types::{Camera, Mask};
use glam::DVec3;

use crate::hull::{HullCorner, silhouette_hull};
use crate::lags::LagEstimate;
use crate::lags::{Balance, PairLag, balanced};

/// Sampling interval of the curves, nanoseconds.
const STEP: i64 = 4_000_000;
/// Smallest sine of the angle between the baseline and the viewing direction: near the baseline the plane's angle is
/// ill-conditioned.
const LEAST_APART: f64 = 0.35;
/// Largest angle of a silhouette about the baseline, radians; a wider one surrounds the epipole.
const MOST_SPAN: f64 = 2.0;
/// Samples that two curves must share, besides the tested offsets: three quarters of a second.
const LEAST_COMMON: usize = 187;
/// Length of the alternating stretches whose offsets must agree, samples.
const STRETCH: usize = 125;
/// Smallest contrast of a pair: how much better than the mean of all offsets the best one must fit, in 0..=1. Below,
/// masks of too small images mislead.
const LEAST_CONTRAST: f64 = 0.3;
/// Assumed bias of a moving mask's outline, pixels.
const LEANING_PX: f64 = 0.1;
/// Standard error beyond which a time offset is not reported, nanoseconds.
const MOST_ERROR: f64 = 5e6;
/// Fewest samples of a kind of stretches for an offset of their own.
const LEAST_STRETCH: usize = 30;
/// Fraction of the way from the best to the mean fit within which another offset makes the estimate ambiguous.
const AMBIGUOUS: f64 = 0.25;
/// Robust standard deviations from which a difference of two curves is more likely an outlier.
const SCALE: f64 = 1.5;
/// Largest tested offset, nanoseconds.
const MOST: i64 = 1_000_000_000;

/// Silhouettes of one camera over time.
#[derive(Debug, Clone)]
pub struct SilhouetteTrack {
    camera: Camera,
    /// Time, nanoseconds, and convex hull of the silhouette in world axes.
    samples: Vec<(i64, Vec<HullCorner>)>,
}

impl SilhouetteTrack {
    /// Creates an empty track of a camera.
    #[must_use]
    pub fn new(camera: &Camera) -> Self {
        Self { camera: camera.clone(), samples: Vec::new() }
    }

    /// Adds the mask of an image. Ignores masks out of order, of another size than the camera's images, and empty ones.
    pub fn add(&mut self, capture_nanos: i64, mask: &Mask) {
        let is_newer = self.samples.last().is_none_or(|(before, _)| *before < capture_nanos);
        if is_newer && [mask.width(), mask.height()] == self.camera.size() {
            let back = self.camera.camera_from_world.rotation.inverse();
            let in_world = |corner: HullCorner| HullCorner { ray: back * corner.ray, ..corner };
            let hull: Vec<HullCorner> = silhouette_hull(&self.camera, mask).into_iter().map(in_world).collect();
            if hull.len() > 2 {
                self.samples.push((capture_nanos, hull));
            }
        }
    }

    /// Number of masks added so far.
    #[must_use]
    pub fn masks(&self) -> usize {
        self.samples.len()
    }

    /// Returns half of the median interval between masks, nanoseconds.
    fn half_interval(&self) -> f64 {
        let mut gaps: Vec<i64> = self.samples.windows(2).map(|pair| pair[1].0.saturating_sub(pair[0].0)).collect();
        gaps.sort_unstable();
        gaps.get(gaps.len() / 2).map_or(STEP as f64, |gap| *gap as f64 / 2.0)
    }

    fn span(&self) -> Option<(i64, i64)> {
        Some((self.samples.first()?.0, self.samples.last()?.0))
    }
}

/// Estimates the time offsets of all cameras from the first one, of each pair at most `most_nanos` (at most 1 s); two
/// cameras are enough. The correlation of an estimate is its contrast, in 0..=1: how much better the best offset fits
/// than the mean of all. Its disagreement is the standard error, from the noise of the curves, the disagreement of
/// pairs of cameras, and that of alternating half seconds. No offset is reported for a camera whose standard error
/// exceeds 5 ms, or that has nothing in common with the first one (infinite error).
#[must_use]
pub fn estimate_silhouette_lags(tracks: &[SilhouetteTrack], most_nanos: i64) -> Vec<LagEstimate> {
    let count = tracks.len();
    let most = most_nanos.clamp(STEP, MOST);
    let mut pairs: [Vec<PairLag>; 3] = Default::default();
    let mut contrasts = vec![0.0f64; count];
    for first in 0..count {
        for second in first + 1..count {
            for fit in fits(&tracks[first], &tracks[second], most) {
                for (pairs, lag) in pairs.iter_mut().zip(fit.lags) {
                    pairs.extend(lag.map(|lag| PairLag { first, second, lag, weight: fit.weight }));
                }
                for slot in [first, second] {
                    contrasts[slot] = contrasts[slot].max(fit.contrast);
                }
            }
        }
    }
    let [whole, even, odd] = pairs.each_ref().map(|pairs| balanced(count, pairs));
    let errors = standard_errors(&whole, &pairs[0]);
    (0..count)
        .map(|slot| {
            let of_times = match (even[slot].lag, odd[slot].lag) {
                (Some(even), Some(odd)) => (even - odd).abs() / 2.0,
                // One half is uninformative, or its offset lies beyond the tested ones.
                _ => f64::INFINITY,
            };
            let error = errors[slot].max(of_times);
            LagEstimate {
                camera: tracks[slot].camera.id.clone(),
                lag_nanos: whole[slot].lag.filter(|_| error <= MOST_ERROR).map(|lag| lag.round() as i64),
                correlation: contrasts[slot],
                disagreement_nanos: error,
            }
        })
        .collect()
}

/// Returns the standard errors of balanced offsets: from the weights (inverse variances), or larger where the pairs
/// disagree by more.
fn standard_errors(lags: &[Balance], pairs: &[PairLag]) -> Vec<f64> {
    let squares: Vec<f64> = pairs
        .iter()
        .filter_map(|pair| Some(pair.weight * (lags[pair.second].lag? - lags[pair.first].lag? - pair.lag).powi(2)))
        .collect();
    let unknown = lags.iter().skip(1).filter(|lag| lag.lag.is_some()).count();
    let spare = squares.len().saturating_sub(unknown);
    let excess = if spare > 0 { (squares.iter().sum::<f64>() / spare as f64).max(1.0) } else { 1.0 };
    lags.iter().map(|lag| lag.lag.map_or(f64::INFINITY, |_| (lag.variance * excess).sqrt())).collect()
}

/// Fit of one of the two curves of a pair of cameras.
#[derive(Debug)]
struct Fit {
    /// Time offset of the second camera, nanoseconds: from all stretches, from the even and from the odd ones.
    lags: [Option<f64>; 3],
    /// Contrast: improvement of the fit over the mean of all offsets, in 0..=1.
    contrast: f64,
    /// Inverse variance of the lag, 1/ns².
    weight: f64,
}

/// Fits the curves of the lowest and the highest tangents of two cameras.
fn fits(a: &SilhouetteTrack, b: &SilhouetteTrack, most: i64) -> Vec<Fit> {
    let (Some(pencil), Some((a0, a1)), Some((b0, b1))) = (Pencil::new(a, b), a.span(), b.span()) else {
        return Vec::new();
    };
    let start = a0.max(b0);
    let count = usize::try_from(a1.min(b1).saturating_sub(start) / STEP).unwrap_or(0).min(200_000);
    let shifts = usize::try_from(most / STEP).unwrap_or(0);
    if count < LEAST_COMMON + 2 * shifts {
        return Vec::new();
    }
    let trust = Trust {
        leaning: LEANING_PX * (1.0 / a.camera.intrinsics.focal_px.y + 1.0 / b.camera.intrinsics.focal_px.y) / 2.0,
        // Smoothing by a Gaussian of half an interval leaves white noise as alike as samples so far apart.
        apart_nanos: std::f64::consts::PI.sqrt() * (a.half_interval() + b.half_interval()),
    };
    let sides = pencil.tangents(a).into_iter().zip(pencil.tangents(b));
    sides
        .filter_map(|(a_side, b_side)| {
            let a_curve = smoothed(&a_side, a.half_interval(), start, count);
            let b_curve = smoothed(&b_side, b.half_interval(), start, count);
            fit(&a_curve[shifts..count - shifts], &b_curve, &trust)
        })
        .collect()
}

/// Reliability of the curves.
struct Trust {
    /// Assumed bias of a moving outline, radians.
    leaning: f64,
    /// Interval between independent samples, nanoseconds.
    apart_nanos: f64,
}

/// Estimates the time offset between two curves that differ by noise and a constant (calibration and mask errors): the
/// one with the smallest mean robust (Geman-McClure) squared difference. `b` extends beyond `a` by equally many samples
/// on both sides.
fn fit(a: &[f64], b: &[f64], trust: &Trust) -> Option<Fit> {
    let tries = b.len() - a.len() + 1;
    let differences = |shift: usize| a.iter().zip(&b[shift..]).map(|(x, y)| y - x);
    // What no lag can explain is noise.
    let mut least = f64::INFINITY;
    let mut centers = Vec::with_capacity(tries);
    for shift in 0..tries {
        let mut known: Vec<f64> = differences(shift).filter(|d| d.is_finite()).collect();
        if known.len() * 2 < a.len() {
            return None;
        }
        let center = median(&mut known)?;
        known.iter_mut().for_each(|d| *d = (*d - center).abs());
        least = least.min(median(&mut known)?);
        centers.push(center);
    }
    let noise = (1.4826 * least).max(1e-7);
    let square = |d: f64, center: f64| ((d - center) / (SCALE * noise)).powi(2);
    let mut costs = [vec![0.0; tries], vec![0.0; tries]];
    let mut all = vec![0.0; tries];
    for (shift, center) in centers.iter().enumerate() {
        let (mut sums, mut counts) = ([0.0; 2], [0usize; 2]);
        for (i, d) in differences(shift).enumerate().filter(|(_, d)| d.is_finite()) {
            let square = square(d, *center);
            sums[i / STRETCH % 2] += square / (1.0 + square);
            counts[i / STRETCH % 2] += 1;
        }
        for ((costs, sum), count) in costs.iter_mut().zip(sums).zip(counts) {
            // Few samples fit anything.
            costs[shift] = if count < LEAST_STRETCH { f64::NAN } else { sum / count as f64 };
        }
        all[shift] = (sums[0] + sums[1]) / (counts[0] + counts[1]).max(1) as f64;
    }
    let best = (0..tries).min_by(|x, y| all[*x].total_cmp(&all[*y]))?;
    let contrast = 1.0 - all[best] / (all.iter().sum::<f64>() / tries as f64);
    if contrast.is_nan() || contrast < LEAST_CONTRAST || is_ambiguous(&all, best) {
        return None;
    }
    // Squared slopes of the samples that fit.
    let steep: Vec<f64> = differences(best)
        .skip(1)
        .zip(a.windows(3))
        .filter(|(d, around)| d.is_finite() && around.iter().all(|value| value.is_finite()))
        .map(|(d, around)| {
            let slope = (around[2] - around[0]) / (2 * STEP) as f64;
            slope * slope / (1.0 + square(d, centers[best])).powi(2)
        })
        .collect();
    let sum: f64 = steep.iter().sum();
    // Fisher information of a shift in white noise; masks lean while something moves, however long that is.
    let of_noise = noise * noise / (sum * STEP as f64 / trust.apart_nanos);
    let of_leaning = trust.leaning * trust.leaning * sum / steep.iter().map(|steep| steep * steep).sum::<f64>();
    let variance = of_noise + of_leaning;
    let lags = [lowest(&all), lowest(&costs[0]), lowest(&costs[1])];
    (variance > 0.0 && variance.is_finite() && lags[0].is_some()).then_some(Fit {
        lags,
        contrast,
        weight: 1.0 / variance,
    })
}

/// Returns whether another offset fits nearly as well, as with periodic motion: within `AMBIGUOUS` of the way from the
/// best to the mean.
fn is_ambiguous(costs: &[f64], best: usize) -> bool {
    let mean = costs.iter().sum::<f64>() / costs.len() as f64;
    let nearly = costs[best] + AMBIGUOUS * (mean - costs[best]);
    // Out of the valley of the best, and down again.
    let falls_again =
        |costs: &mut dyn Iterator<Item = &f64>| costs.skip_while(|cost| **cost <= nearly).any(|cost| *cost <= nearly);
    falls_again(&mut costs[best..].iter()) || falls_again(&mut costs[..=best].iter().rev())
}

/// Returns the offset of the lowest cost, nanoseconds; `None` at the edge of the range, where the cost may fall further
/// beyond, and next to an unknown cost.
fn lowest(costs: &[f64]) -> Option<f64> {
    if costs.iter().any(|cost| cost.is_nan()) {
        return None;
    }
    let best = (0..costs.len()).min_by(|x, y| costs[*x].total_cmp(&costs[*y]))?;
    let (before, after) = (costs.get(best.checked_sub(1)?)?, costs.get(best + 1)?);
    let curve = before - 2.0 * costs[best] + after;
    let fine = if curve > 0.0 { (0.5 * (before - after) / curve).clamp(-0.5, 0.5) } else { 0.0 };
    Some((best as f64 + fine - (costs.len() / 2) as f64) * STEP as f64)
}

/// Pencil of planes through the centres of two cameras, by angle.
struct Pencil {
    /// Unit axes of angle 0 and of the right angle, perpendicular to the baseline.
    axes: [DVec3; 2],
}

impl Pencil {
    /// Creates the pencil; `None` for cameras at the same place, and for cameras that face each other.
    fn new(a: &SilhouetteTrack, b: &SilhouetteTrack) -> Option<Self> {
        let line = (b.camera.position() - a.camera.position()).try_normalize()?;
        let mean = |track: &SilhouetteTrack| {
            track.samples.iter().flat_map(|(_, hull)| hull).map(|corner| corner.ray).sum::<DVec3>().try_normalize()
        };
        let ahead = ((mean(a)? + mean(b)?) / 2.0).reject_from_normalized(line);
        let front = ahead.try_normalize().filter(|_| ahead.length() >= LEAST_APART)?;
        Some(Self { axes: [front, line.cross(front)] })
    }

    /// Returns the angles of the two outermost tangent planes, with their times.
    fn tangents(&self, track: &SilhouetteTrack) -> [Vec<(i64, f64)>; 2] {
        let mut sides: [Vec<(i64, f64)>; 2] = Default::default();
        for (nanos, hull) in &track.samples {
            let angles = hull
                .iter()
                .map(|corner| (corner.ray.dot(self.axes[1]).atan2(corner.ray.dot(self.axes[0])), corner.is_cut));
            let lowest = angles.clone().min_by(|x, y| x.0.total_cmp(&y.0));
            let highest = angles.max_by(|x, y| x.0.total_cmp(&y.0));
            if let (Some(lowest), Some(highest)) = (lowest, highest)
                && highest.0 - lowest.0 < MOST_SPAN
            {
                for (side, (angle, is_cut)) in sides.iter_mut().zip([lowest, highest]) {
                    if !is_cut {
                        side.push((*nanos, angle));
                    }
                }
            }
        }
        sides
    }
}

/// Samples a curve every [`STEP`] from `start` on by local line fits, so that the noise between two samples is no lower
/// than at them (which would bias the offsets to the middle between two images). NaN where there are no samples on both
/// sides.
fn smoothed(samples: &[(i64, f64)], sigma: f64, start: i64, count: usize) -> Vec<f64> {
    let reach = 3.0 * sigma;
    let mut from = 0;
    (0..count as i64)
        .map(|i| {
            let time = start.saturating_add(i * STEP);
            let distance = |sample: &(i64, f64)| sample.0.saturating_sub(time) as f64;
            while samples.get(from).is_some_and(|sample| distance(sample) < -reach) {
                from += 1;
            }
            let near = samples[from..].iter().take_while(|sample| distance(sample) <= reach);
            // Sums of the weighted least squares of value over distance.
            let [mut w, mut d, mut dd, mut v, mut dv] = [0.0; 5];
            let (mut before, mut after) = (false, false);
            for sample in near {
                let x = distance(sample) / sigma;
                let weight = (-0.5 * x * x).exp();
                (before, after) = (before || x <= 0.0, after || x >= 0.0);
                w += weight;
                d += weight * x;
                dd += weight * x * x;
                v += weight * sample.1;
                dv += weight * x * sample.1;
            }
            let det = w * dd - d * d;
            if before && after && det > 1e-9 { (dd * v - d * dv) / det } else { f64::NAN }
        })
        .collect()
}

#[cfg(test)]
#[path = "silhouette_lags_tests.rs"]
mod tests;
