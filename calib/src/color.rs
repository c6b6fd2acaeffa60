//! Colour matching of cameras from surface points that several of them see.
//!
//! The light of a point is the same for every camera, so that for camera `c` and channel `k` (see [`ColorMatch`]) `ln
//! linear(s^exponent_c) + ln gain_ck + falloff_c · (r², r⁴)` is the same number for all samples of the point. That is
//! linear in all unknowns but the exponent, which each round linearises; the number itself is eliminated as the
//! samples' mean. Two degrees of freedom stay open and are fixed: the mean gain of a channel is 1 (geometric), and so
//! is the mean exponent.
//!
//! In a session the points are Gaussians that several cameras see. The result is a field of `flyrig_types::Camera`, which
//! the renderer applies where images enter a session.

use flyrig_types::{CameraId, ColorMatch};
use nalgebra::{DMatrix, DVector};

use crate::error::CalibError;

/// Usable sRGB values: shadows are coarse, highlights clipped.
const USABLE: std::ops::RangeInclusive<f64> = 0.06..=0.95;
/// Fewest points that a camera must share with others.
const LEAST_POINTS: usize = 200;
/// Fraction of the held-out error of the simpler model below which a richer one is chosen.
const PAYS: f64 = 0.97;
/// Number of reweighted solves.
const ROUNDS: usize = 8;
/// Huber threshold, standard deviations.
const HUBER: f64 = 1.345;
/// Regularisation of undetermined unknowns towards 0, relative to the mean diagonal.
const RIDGE: f64 = 1e-6;
/// Weight of the fixed degrees of freedom, relative to the mean diagonal.
const FIXED: f64 = 1e3;
/// Fraction of each camera's samples that must lie beyond this squared radius for its falloff to be estimated: outside
/// the samples it would be a guess.
const OUTSIDE: (f64, f64) = (0.05, 0.4);
/// Plausible exponents, and plausible gains in the corners; others come from effects such as shine.
const PLAUSIBLE: (std::ops::RangeInclusive<f64>, std::ops::RangeInclusive<f64>) = (0.7..=1.4, 0.8..=3.0);
/// Middle grey, sRGB.
const GREY: f64 = 0.5;
/// Largest sRGB value of the linear segment (IEC 61966-2-1).
const LINEAR_TO: f64 = 0.040_45;
/// Unknowns per camera: three gains, the exponent minus 1, two of the falloff.
const OF_CAMERA: usize = 6;

/// Surface point in the image of one camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorSample {
    /// Slot of the camera.
    pub camera: usize,
    /// sRGB values of red, green and blue, in 0..=1.
    pub srgb: [f64; 3],
    /// Squared distance from the principal point, relative to half the image's diagonal.
    pub r2: f64,
    /// Weight in the fit, above 0.
    pub weight: f64,
}

/// Surface point at one instant, as several cameras see it.
#[derive(Debug, Clone, PartialEq)]
pub struct ColorPoint {
    /// Number of the instant.
    pub instant: u64,
    /// Samples, at most one per camera.
    pub samples: Vec<ColorSample>,
}

/// Parts of [`ColorMatch`] that are estimated besides the gains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ColorModel {
    /// Whether exponents are estimated.
    pub response: bool,
    /// Whether falloffs are estimated.
    pub falloff: bool,
}

impl ColorModel {
    /// All models, from poor to rich.
    const ALL: [Self; 4] = [
        Self { response: false, falloff: false },
        Self { response: true, falloff: false },
        Self { response: false, falloff: true },
        Self { response: true, falloff: true },
    ];
}

/// Colour match of one camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraColors {
    /// Correction of its colours.
    pub color: ColorMatch,
    /// Points that it shares with other cameras.
    pub points: usize,
    /// Largest difference of a channel's corrected light of a middle grey between the solves from alternating instants,
    /// as a fraction.
    pub halves: f64,
    /// Typical difference of its light from the mean of the cameras that see the same point, as a fraction: before and
    /// after correction.
    pub difference: (f64, f64),
}

/// Colour match of a rig.
#[derive(Debug, Clone, PartialEq)]
pub struct ColorFit {
    /// Cameras in rig order.
    pub cameras: Vec<CameraColors>,
    /// Unknowns that were estimated besides the gains.
    pub model: ColorModel,
    /// Typical difference of a camera's light from the points' means in every second instant, as a fraction, with the colours that the
    /// other instants give.
    pub kept_back: f64,
}

/// Returns the typical difference of a camera's light from the mean of the cameras that see the same point, as a fraction: of every
/// second instant, those that [`ColorFit::kept_back`] is measured on. One colour match per camera.
#[must_use]
pub fn color_difference(colors: &[ColorMatch], points: &[ColorPoint]) -> f64 {
    let odd = points.iter().filter(|point| point.instant % 2 == 1);
    let usable: Vec<ColorPoint> = odd.filter_map(|point| usable(point, colors.len())).collect();
    typical(differences(&usable, colors).into_iter().map(|(_, off)| off))
}

/// Matches the colours of cameras.
///
/// # Errors
/// [`CalibError::ColorsOpen`] names a camera that shares too few points with the others.
pub fn match_colors(ids: &[CameraId], points: &[ColorPoint]) -> Result<ColorFit, CalibError> {
    let usable: Vec<ColorPoint> = points.iter().filter_map(|point| usable(point, ids.len())).collect();
    let shared = |slot: usize| usable.iter().filter(|p| p.samples.iter().any(|s| s.camera == slot)).count();
    let counts: Vec<usize> = (0..ids.len()).map(shared).collect();
    if let Some(slot) = counts.iter().position(|count| *count < LEAST_POINTS) {
        return Err(CalibError::ColorsOpen { camera: ids[slot].clone(), found: counts[slot], needed: LEAST_POINTS });
    }
    let halves = [0, 1].map(|half| {
        let of_half = |point: &&ColorPoint| point.instant % 2 == half;
        usable.iter().filter(of_half).cloned().collect::<Vec<_>>()
    });
    // The richest model that pays on what it was not fitted to.
    let kept_out = |model| {
        let fitted = solve(ids.len(), &halves[0], model);
        let error = typical(differences(&halves[1], &fitted).into_iter().map(|(_, off)| off));
        if fitted.iter().all(is_plausible) { error } else { f64::INFINITY }
    };
    let gains = ColorModel::ALL[0];
    let mut best = (gains, kept_out(gains));
    let reaches_out = (0..ids.len()).all(|slot| {
        let of = || usable.iter().flat_map(|point| &point.samples).filter(|sample| sample.camera == slot);
        of().filter(|sample| sample.r2 > OUTSIDE.1).count() as f64 >= OUTSIDE.0 * of().count() as f64
    });
    for model in ColorModel::ALL[1..].iter().filter(|model| reaches_out || !model.falloff) {
        let error = kept_out(*model);
        if error < PAYS * best.1 {
            best = (*model, error);
        }
    }
    let (mut model, mut solved) = (best.0, solve(ids.len(), &usable, best.0));
    if !solved.iter().all(is_plausible) {
        (model, solved) = (gains, solve(ids.len(), &usable, gains));
    }
    let kept_back = color_difference(&solve(ids.len(), &halves[0], model), &halves[1]);
    let by_half = halves.each_ref().map(|half| solve(ids.len(), half, model));
    let (before, after) = (differences(&usable, &vec![ColorMatch::NONE; ids.len()]), differences(&usable, &solved));
    let of = |slot: usize, all: &[(usize, f64)]| typical(all.iter().filter(|(of, _)| *of == slot).map(|(_, off)| *off));
    let apart = |slot: usize| {
        let [a, b] = [&by_half[0], &by_half[1]].map(|colors| colors[slot].apply([GREY; 3], 0.0));
        (0..3).map(|k| (a[k] / b[k]).ln().abs()).fold(0.0, f64::max)
    };
    let camera = |slot: usize| CameraColors {
        color: solved[slot],
        points: counts[slot],
        halves: apart(slot),
        difference: (of(slot, &before), of(slot, &after)),
    };
    Ok(ColorFit { cameras: (0..ids.len()).map(camera).collect(), model, kept_back })
}

fn is_plausible(color: &ColorMatch) -> bool {
    PLAUSIBLE.0.contains(&color.exponent) && PLAUSIBLE.1.contains(&(color.falloff[0] + color.falloff[1]).exp())
}

/// Keeps the samples that are neither clipped nor too dark; `None` for a point that fewer than two cameras see.
fn usable(point: &ColorPoint, cameras: usize) -> Option<ColorPoint> {
    let is_good = |s: &&ColorSample| {
        s.camera < cameras
            && s.srgb.iter().all(|value| USABLE.contains(value))
            && (0.0..=4.0).contains(&s.r2)
            && s.weight > 0.0
            && s.weight.is_finite()
    };
    let samples: Vec<ColorSample> = point.samples.iter().filter(is_good).copied().collect();
    (samples.len() > 1).then_some(ColorPoint { instant: point.instant, samples })
}

/// Returns the derivatives of a corrected sample's logarithm by the unknowns of its camera, and its value where all
/// unknowns are 0, both linearised around `exponent`.
fn row(sample: &ColorSample, channel: usize, exponent: f64) -> ([f64; OF_CAMERA], f64) {
    let code = sample.srgb[channel].ln();
    let bent = (exponent * code).exp();
    let slope = code * if bent <= LINEAR_TO { 1.0 } else { 2.4 * bent / (bent + 0.055) };
    let value = log_light(exponent * code) - slope * (exponent - 1.0);
    let mut row = [0.0; OF_CAMERA];
    row[channel] = 1.0;
    row[3] = slope;
    row[4] = sample.r2;
    row[5] = sample.r2 * sample.r2;
    (row, value)
}

/// Solves the least squares problem with Huber weights.
fn solve(cameras: usize, points: &[ColorPoint], model: ColorModel) -> Vec<ColorMatch> {
    let count = OF_CAMERA * cameras;
    let mut colors = vec![ColorMatch::NONE; cameras];
    for _ in 0..ROUNDS {
        let spread = typical(differences(points, &colors).into_iter().map(|(_, off)| off)).max(1e-4);
        let mut matrix = DMatrix::<f64>::zeros(count, count);
        let mut right = DVector::<f64>::zeros(count);
        for point in points {
            for channel in 0..3 {
                let means = mean(point, channel, &colors);
                let weight = |sample: &ColorSample| {
                    let off = (corrected(sample, channel, &colors) - means).abs() / spread;
                    sample.weight * if off > HUBER { HUBER / off } else { 1.0 }
                };
                let weights: Vec<f64> = point.samples.iter().map(weight).collect();
                let all: f64 = weights.iter().sum();
                let of = |sample: &ColorSample| row(sample, channel, colors[sample.camera].exponent);
                let rows: Vec<([f64; OF_CAMERA], f64)> = point.samples.iter().map(of).collect();
                let middle = weights.iter().zip(&rows).map(|(w, (_, value))| w * value).sum::<f64>() / all;
                // Σ w x xᵀ - (Σ w x) (Σ w x)ᵀ / Σ w, in blocks of the samples' cameras.
                for (i, (a, value)) in rows.iter().enumerate() {
                    let at = OF_CAMERA * point.samples[i].camera;
                    for (j, (b, _)) in rows.iter().enumerate() {
                        let to = OF_CAMERA * point.samples[j].camera;
                        let share = if i == j { weights[i] } else { 0.0 } - weights[i] * weights[j] / all;
                        for (p, x) in a.iter().enumerate() {
                            for (q, y) in b.iter().enumerate() {
                                matrix[(at + p, to + q)] += share * x * y;
                            }
                        }
                    }
                    for (p, x) in a.iter().enumerate() {
                        right[at + p] -= weights[i] * x * (value - middle);
                    }
                }
            }
        }
        fix(&mut matrix, &mut right, cameras, model);
        let Some(unknowns) = matrix.cholesky().map(|factor| factor.solve(&right)) else { break };
        if !unknowns.iter().all(|value| value.is_finite()) {
            break;
        }
        for (slot, color) in colors.iter_mut().enumerate() {
            let of = |k: usize| unknowns[OF_CAMERA * slot + k];
            *color = ColorMatch {
                gain: [of(0).exp(), of(1).exp(), of(2).exp()],
                exponent: 1.0 + of(3),
                falloff: [of(4), of(5)],
            };
        }
    }
    colors
}

/// Constrains unknowns that the samples leave undetermined, and those outside the model.
fn fix(matrix: &mut DMatrix<f64>, right: &mut DVector<f64>, cameras: usize, model: ColorModel) {
    let scale = matrix.diagonal().mean().max(f64::MIN_POSITIVE);
    for k in 0..4 {
        for a in 0..cameras {
            for b in 0..cameras {
                matrix[(OF_CAMERA * a + k, OF_CAMERA * b + k)] += scale * FIXED / cameras as f64;
            }
        }
    }
    for at in 0..right.len() {
        matrix[(at, at)] += scale * RIDGE;
        let is_sought = [true, true, true, model.response, model.falloff, model.falloff][at % OF_CAMERA];
        if !is_sought {
            matrix.row_mut(at).fill(0.0);
            matrix.column_mut(at).fill(0.0);
            (matrix[(at, at)], right[at]) = (scale, 0.0);
        }
    }
}

/// Returns the logarithm of the light of an sRGB value, given the value's logarithm.
fn log_light(code: f64) -> f64 {
    let value = code.exp();
    if value <= LINEAR_TO { code - 12.92f64.ln() } else { 2.4 * ((value + 0.055) / 1.055).ln() }
}

fn corrected(sample: &ColorSample, channel: usize, colors: &[ColorMatch]) -> f64 {
    let ColorMatch { gain, exponent, falloff } = colors[sample.camera];
    let corner = sample.r2 * (falloff[0] + falloff[1] * sample.r2);
    log_light(exponent * sample.srgb[channel].ln()) + gain[channel].ln() + corner
}

fn mean(point: &ColorPoint, channel: usize, colors: &[ColorMatch]) -> f64 {
    let all: f64 = point.samples.iter().map(|sample| sample.weight).sum();
    point.samples.iter().map(|sample| sample.weight * corrected(sample, channel, colors)).sum::<f64>() / all
}

/// Returns per sample and channel: the camera, and the deviation of the corrected sample from its point's mean, in
/// logarithms.
fn differences(points: &[ColorPoint], colors: &[ColorMatch]) -> Vec<(usize, f64)> {
    let of = |point: &ColorPoint| -> Vec<(usize, f64)> {
        (0..3)
            .flat_map(|channel| {
                let mean = mean(point, channel, colors);
                point.samples.iter().map(move |s| (s.camera, (corrected(s, channel, colors) - mean).abs()))
            })
            .collect()
    };
    points.iter().flat_map(of).collect()
}

/// Returns the standard deviation of values around 0, robustly from their median.
fn typical(values: impl Iterator<Item = f64>) -> f64 {
    1.4826 * flyrig_solve::median(&mut values.collect::<Vec<f64>>()).unwrap_or(0.0)
}

#[cfg(test)]
#[path = "color_tests.rs"]
mod tests;
