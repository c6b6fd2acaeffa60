//! Systematic bias and spread of the pose network's landmarks, relative to the joints and places on the skin that they are
//! named after.
//!
//! Both are measured on simulated people whose pose is known ([`LandmarkStudy`](crate::LandmarkStudy)). The fit places
//! landmarks with their bias and divides residuals by their spread, which grows with the width of the heatmap's peak and as the
//! confidence falls.

use flyrig_body::Template;
use glam::{DVec2, DVec3};

use crate::landmarks::keypoints::{LANDMARK_COUNT, NOSE, Sharpness};
use crate::landmarks::surface_marks::BodyMark;

/// Measurement of a landmark of the left side or the middle; the right side is its mirror image.
struct Measured {
    landmark: usize,
    /// Offset from the anatomical place, canonical axes of the part that carries it, millimetres on a body of 1.7 m.
    bias_mm: [f64; 3],
    /// Standard deviation about it in an image, millimetres at the body's depth.
    spread_mm: f64,
    /// Median spread of its heatmap's peak, cells.
    peak_cells: f64,
}

/// Biases and spreads as printed by `flyrig-bench landmarks` for eight simulated people (seeds 321 to 328, a motion each, 7
/// cameras, 12 frames). The signs are anatomy: the network's hips lie at the outer hip bone, its shoulders on top of the
/// joint.
const MEASURED: [Measured; 17] = [
    Measured { landmark: 0, bias_mm: [-4.9, 8.4, -12.7], spread_mm: 12.6, peak_cells: 1.03 },
    Measured { landmark: 1, bias_mm: [-3.1, 4.1, -8.8], spread_mm: 11.8, peak_cells: 0.97 },
    Measured { landmark: 2, bias_mm: [-6.9, 4.0, -13.6], spread_mm: 12.5, peak_cells: 0.97 },
    Measured { landmark: 3, bias_mm: [-10.7, 4.2, -15.0], spread_mm: 13.0, peak_cells: 0.99 },
    Measured { landmark: 7, bias_mm: [-27.9, -6.8, 29.6], spread_mm: 10.6, peak_cells: 1.05 },
    Measured { landmark: 9, bias_mm: [-7.4, 10.6, -9.8], spread_mm: 12.8, peak_cells: 0.99 },
    Measured { landmark: 11, bias_mm: [-5.6, 34.0, -3.7], spread_mm: 13.9, peak_cells: 1.11 },
    Measured { landmark: 13, bias_mm: [-3.5, 6.9, 5.1], spread_mm: 13.6, peak_cells: 1.20 },
    Measured { landmark: 15, bias_mm: [-2.3, -3.2, 3.5], spread_mm: 10.0, peak_cells: 1.12 },
    Measured { landmark: 17, bias_mm: [-16.9, 30.1, 1.7], spread_mm: 11.9, peak_cells: 1.16 },
    Measured { landmark: 19, bias_mm: [-2.3, -1.3, -28.9], spread_mm: 11.5, peak_cells: 1.12 },
    Measured { landmark: 21, bias_mm: [12.0, -15.3, -15.0], spread_mm: 12.2, peak_cells: 1.15 },
    Measured { landmark: 23, bias_mm: [-6.8, -4.4, 26.5], spread_mm: 16.7, peak_cells: 1.17 },
    Measured { landmark: 25, bias_mm: [-1.1, -16.1, -14.8], spread_mm: 17.8, peak_cells: 1.24 },
    Measured { landmark: 27, bias_mm: [0.1, 21.0, 14.0], spread_mm: 13.3, peak_cells: 1.24 },
    Measured { landmark: 29, bias_mm: [-10.8, -1.4, 8.8], spread_mm: 17.8, peak_cells: 1.35 },
    Measured { landmark: 31, bias_mm: [2.5, 5.3, 4.8], spread_mm: 17.4, peak_cells: 1.36 },
];

/// Spread of a heatmap's peak as a multiple of the landmark's median, and the spread of the landmark as a multiple of
/// [`spread_m`], between those that the same command prints for these people and for two recorded bodies. Those of these people
/// alone are narrower and give joints that are 0.4 mm worse, on these people too (docs/benchmarks/perception.md).
const BY_PEAK: Table =
    &[(0.86, 0.7), (0.94, 0.85), (1.0, 1.0), (1.08, 1.3), (1.17, 1.7), (1.26, 2.2), (1.42, 3.3), (1.6, 4.5)];
/// Confidence of a landmark with a peak, and the factor of its spread that the peak does not explain.
const BY_CONFIDENCE: Table = &[(0.05, 1.8), (0.2, 1.7), (0.5, 1.2), (0.8, 1.15), (0.95, 1.0)];
/// Confidence of a landmark without a peak, and its spread as a multiple of [`spread_m`].
const WITHOUT_PEAK: Table = &[(0.05, 6.3), (0.2, 6.3), (0.5, 4.5), (0.85, 3.5)];
/// Confidence of a landmark of a network without heatmaps, and its spread as a multiple of [`spread_m`] (seeds 401 to 412).
const WITHOUT_HEATMAP: Table =
    &[(0.025, 7.4), (0.075, 4.6), (0.15, 4.4), (0.25, 3.6), (0.4, 2.5), (0.6, 1.6), (0.8, 1.2), (0.95, 1.0)];
/// Ratio of a landmark's spreads along and across the wide direction of its peak, as a power of the peak's aspect, and the
/// largest aspect that counts.
const ASPECT_POWER: f64 = 2.4;
const MOST_ASPECT: f64 = 1.5;

/// Ascending arguments with their values.
type Table = &'static [(f64, f64)];

/// Interpolates a table; constant beyond its ends.
fn interpolated(table: Table, at: f64) -> f64 {
    let after = table.iter().position(|(end, _)| *end >= at).unwrap_or(table.len() - 1).max(1);
    let [(from, low), (to, high)] = [table[after - 1], table[after]];
    low + (high - low) * ((at - from) / (to - from)).clamp(0.0, 1.0)
}

/// Returns the spread of a landmark as a multiple of [`spread_m`], by that of its heatmap's peak as a multiple of the median.
pub(crate) fn by_peak(relative: f64) -> f64 {
    interpolated(BY_PEAK, relative)
}

/// Spread of an observed landmark, metres at the body's depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Spread {
    /// Principal directions in the image, unit vectors.
    pub axes: [DVec2; 2],
    /// Standard deviation along each.
    pub sigma_m: [f64; 2],
}

/// Returns the spread of a landmark that was observed with a confidence (0..=1) and a sharpness.
pub(crate) fn observed_spread(landmark: usize, confidence: f64, sharpness: Sharpness) -> Spread {
    let (axes, spread) = ([DVec2::X, DVec2::Y], spread_m(landmark));
    let round = |table| {
        let sigma = spread * interpolated(table, confidence);
        Spread { axes, sigma_m: [sigma; 2] }
    };
    match sharpness {
        Sharpness::Unknown => round(WITHOUT_HEATMAP),
        Sharpness::NoPeak => round(WITHOUT_PEAK),
        Sharpness::Peak { spread_cells, along, aspect } => {
            let usual = measured(landmark).map_or(1.1, |measured| measured.peak_cells);
            let sigma = spread * by_peak(spread_cells / usual) * interpolated(BY_CONFIDENCE, confidence);
            let stretch = aspect.clamp(1.0, MOST_ASPECT).powf(0.5 * ASPECT_POWER);
            Spread { axes: [along, along.perp()], sigma_m: [sigma * stretch, sigma / stretch] }
        }
    }
}

/// Moves the landmarks from their anatomical places to where the network points.
pub(crate) fn add_biases(template: &Template, marks: &mut [BodyMark; LANDMARK_COUNT]) {
    let metres = 1e-3 * template_scale(template);
    for (landmark, mark) in marks.iter_mut().enumerate() {
        let Some(Measured { bias_mm: [x, y, z], .. }) = measured(landmark) else { continue };
        let x = if is_right(landmark) { -x } else { *x };
        mark.point += DVec3::new(x, *y, *z) * metres;
    }
}

/// Returns the standard deviation of a landmark about its biased place, metres at the body's depth.
pub(crate) fn spread_m(landmark: usize) -> f64 {
    1e-3 * measured(landmark).map_or(20.0, |measured| measured.spread_mm)
}

/// Returns the measurement of a landmark.
fn measured(landmark: usize) -> Option<&'static Measured> {
    MEASURED.iter().find(|known| known.landmark == left_of(landmark))
}

/// Returns the height of a template over that of the body that biases are stated for, 1.7 m.
pub(crate) fn template_scale(template: &Template) -> f64 {
    let heights = template.positions.iter().map(|p| f64::from(p.y));
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), y| (low.min(y), high.max(y)));
    (high - low) / 1.7
}

/// Whether a landmark is on the person's right side.
pub(crate) fn is_right(landmark: usize) -> bool {
    left_of(landmark) != landmark
}

/// Returns the landmark of the left side that a landmark mirrors, or itself.
pub(crate) fn left_of(landmark: usize) -> usize {
    match landmark {
        NOSE => NOSE,
        4..=6 => landmark - 3,
        1..=3 => landmark,
        _ if landmark.is_multiple_of(2) => landmark - 1,
        _ => landmark,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_right_side_mirrors_the_left() {
        for (landmark, left) in [(0, 0), (1, 1), (3, 3), (4, 1), (6, 3), (7, 7), (8, 7), (12, 11), (31, 31), (32, 31)] {
            assert_eq!(left_of(landmark), left, "{landmark}");
            assert_eq!(is_right(landmark), landmark != left);
        }
        assert!((0..LANDMARK_COUNT).all(|landmark| measured(landmark).is_some() && spread_m(landmark) > 0.005));
    }

    #[test]
    fn tables_are_interpolated_and_constant_beyond_their_ends() {
        const TABLE: Table = &[(0.0, 4.0), (0.5, 2.0), (1.0, 1.0)];
        for (at, expected) in [(-1.0, 4.0), (0.25, 3.0), (0.5, 2.0), (0.9, 1.2), (1.0, 1.0), (7.0, 1.0)] {
            assert!((interpolated(TABLE, at) - expected).abs() < 1e-12, "{at}");
        }
        assert!(interpolated(TABLE, f64::NAN).is_nan());
        for table in [BY_CONFIDENCE, WITHOUT_PEAK, WITHOUT_HEATMAP] {
            assert!(table.is_sorted_by(|a, b| a.0 < b.0 && a.1 >= b.1), "sure landmarks spread least");
        }
        assert!(BY_PEAK.is_sorted_by(|a, b| a.0 < b.0 && a.1 < b.1), "sharp peaks spread least");
    }

    #[test]
    fn a_sharp_peak_is_trusted_more_and_most_across_it() {
        let of = |spread_cells, aspect| {
            let sharpness = Sharpness::Peak { spread_cells, along: DVec2::Y, aspect };
            observed_spread(15, 0.95, sharpness).sigma_m
        };
        let [usual, across] = of(1.12, 1.0);
        assert!((usual - across).abs() < 1e-12 && (usual - spread_m(15)).abs() < 1e-12, "{usual}");
        assert!(of(0.9, 1.0)[0] < 0.8 * usual && of(1.8, 1.0)[0] > 4.0 * usual);
        let [along, across] = of(1.12, 1.2);
        assert!(
            (along / across - 1.2f64.powf(ASPECT_POWER)).abs() < 1e-9 && (along * across - usual * usual).abs() < 1e-9
        );
        assert_eq!(of(1.12, 9.0).map(f64::to_bits), of(1.12, MOST_ASPECT).map(f64::to_bits));
        let at = |sharpness| observed_spread(15, 0.5, sharpness).sigma_m[0];
        let peak = Sharpness::Peak { spread_cells: 1.12, along: DVec2::X, aspect: 1.0 };
        assert!(at(peak) < at(Sharpness::Unknown) && at(Sharpness::Unknown) < at(Sharpness::NoPeak));
    }
}
