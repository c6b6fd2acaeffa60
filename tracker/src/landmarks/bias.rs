//! Systematic bias and spread of the pose network's landmarks, relative to the joints and places on the skin that they are
//! named after.
//!
//! Both are measured on simulated people whose pose is known ([`LandmarkStudy`](crate::LandmarkStudy)). The fit places
//! landmarks with their bias and divides residuals by their spread, which grows as the confidence falls.

use flyrig_body::Template;
use glam::DVec3;

use crate::landmarks::keypoints::{LANDMARK_COUNT, NOSE};
use crate::landmarks::surface_marks::BodyMark;

/// Measurement of a landmark of the left side or the middle; the right side is its mirror image.
struct Measured {
    landmark: usize,
    /// Offset from the anatomical place, canonical axes of the part that carries it, millimetres on a body of 1.7 m.
    bias_mm: [f64; 3],
    /// Standard deviation about it in an image, millimetres at the body's depth.
    spread_mm: f64,
}

/// Biases and spreads as printed by `flyrig-bench landmarks` for eight simulated people (seeds 301 to 308, a motion each, 7
/// cameras, 30 frames). The signs are anatomy: the network's hips lie at the outer hip bone, its shoulders on top of the
/// joint.
const MEASURED: [Measured; 17] = [
    Measured { landmark: 0, bias_mm: [-4.0, 4.0, -10.0], spread_mm: 14.0 },
    Measured { landmark: 1, bias_mm: [0.0, 0.0, -11.0], spread_mm: 13.0 },
    Measured { landmark: 2, bias_mm: [-1.0, 0.0, -15.0], spread_mm: 13.0 },
    Measured { landmark: 3, bias_mm: [-2.0, 0.0, -17.0], spread_mm: 13.0 },
    Measured { landmark: 7, bias_mm: [-22.0, -11.0, 29.0], spread_mm: 14.0 },
    Measured { landmark: 9, bias_mm: [-4.0, 3.0, -15.0], spread_mm: 13.0 },
    Measured { landmark: 11, bias_mm: [-14.0, 34.0, -3.0], spread_mm: 18.0 },
    Measured { landmark: 13, bias_mm: [2.0, -2.0, 2.0], spread_mm: 21.0 },
    Measured { landmark: 15, bias_mm: [-8.0, -9.0, 9.0], spread_mm: 15.0 },
    Measured { landmark: 17, bias_mm: [-12.0, 31.0, 0.0], spread_mm: 19.0 },
    Measured { landmark: 19, bias_mm: [-1.0, 2.0, -28.0], spread_mm: 18.0 },
    Measured { landmark: 21, bias_mm: [5.0, -16.0, -15.0], spread_mm: 18.0 },
    Measured { landmark: 23, bias_mm: [-2.0, -27.0, 27.0], spread_mm: 24.0 },
    Measured { landmark: 25, bias_mm: [2.0, -34.0, -30.0], spread_mm: 27.0 },
    Measured { landmark: 27, bias_mm: [1.0, 20.0, 13.0], spread_mm: 18.0 },
    Measured { landmark: 29, bias_mm: [-12.0, -6.0, 7.0], spread_mm: 25.0 },
    Measured { landmark: 31, bias_mm: [-1.0, -7.0, -5.0], spread_mm: 28.0 },
];

/// Confidence of a landmark, and its spread as a multiple of a sure one's (90 % lie within it), as printed by the same
/// command for twelve further people (seeds 401 to 412): the network guesses hidden joints fairly well.
const DOUBTS: [(f64, f64); 8] =
    [(0.025, 7.4), (0.075, 4.6), (0.15, 4.4), (0.25, 3.6), (0.4, 2.5), (0.6, 1.6), (0.8, 1.2), (0.95, 1.0)];

/// Returns the standard deviation of a landmark of a confidence (0..=1) as a multiple of [`spread_m`].
pub(crate) fn doubt(confidence: f64) -> f64 {
    let after = DOUBTS.iter().position(|(at, _)| *at >= confidence).unwrap_or(DOUBTS.len() - 1).max(1);
    let [(from, low), (to, high)] = [DOUBTS[after - 1], DOUBTS[after]];
    low + (high - low) * ((confidence - from) / (to - from)).clamp(0.0, 1.0)
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
}
