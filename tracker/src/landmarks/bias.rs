//! Where the landmark network points, relative to the joints and places on the skin that its landmarks are named after.

use flyrig_body::Template;
use flyrig_types::{Camera, Image, Pose};
use glam::{DMat3, DVec2, DVec3};

use crate::body_model::BodyModel;
use crate::crop::Crop;
use crate::landmarks::NOSE;
use crate::pixels::Rgb;
use crate::search::project_all;
use crate::sighting::Sighting;
use crate::surface_marks::Mark;
use crate::view::{View, observe};
use crate::{LANDMARK_COUNT, PoseNet, TrackError};

/// A landmark of the left side or the middle; the right side is its mirror image.
struct Measured {
    landmark: usize,
    /// From the anatomical place, canonical axes of the part that carries it, on a body of 1.7 m.
    bias_mm: [f64; 3],
    /// Standard deviation about it in an image, at the body's depth.
    spread_mm: f64,
}

/// Printed by `flyrig-bench landmarks` for eight simulated people (seeds 301 to 308, a motion each, 7 cameras, 30 frames).
/// The signs are anatomy: the network's hips lie at the outer hip bone, its shoulders on top of the joint.
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

/// Confidence of a landmark, and its spread as a multiple of a sure one's: nine of ten lie within it. Printed by the same command for twelve
/// further people (seeds 401 to 412): the network guesses where hidden joints are, and not badly.
const DOUBTS: [(f64, f64); 8] =
    [(0.025, 7.4), (0.075, 4.6), (0.15, 4.4), (0.25, 3.6), (0.4, 2.5), (0.6, 1.6), (0.8, 1.2), (0.95, 1.0)];

/// Returns the standard deviation of a landmark of a confidence (0..1) as a multiple of [`spread_m`].
pub(crate) fn doubt(confidence: f64) -> f64 {
    let after = DOUBTS.iter().position(|(at, _)| *at >= confidence).unwrap_or(DOUBTS.len() - 1).max(1);
    let [(from, low), (to, high)] = [DOUBTS[after - 1], DOUBTS[after]];
    low + (high - low) * ((confidence - from) / (to - from)).clamp(0.0, 1.0)
}

/// Moves the landmarks from their anatomical places to where the network points.
pub(crate) fn add_habits(template: &Template, marks: &mut [Mark; LANDMARK_COUNT]) {
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

fn measured(landmark: usize) -> Option<&'static Measured> {
    MEASURED.iter().find(|known| known.landmark == left_of(landmark))
}

/// Landmarks of lower confidence are guesses, and those farther from the body are another person's or on the wrong side, metres.
const SURE: f64 = 0.3;
const GROSS_M: f64 = 0.15;
/// Upper ends of the ranges of confidence whose spread is measured.
const RANGES: [f64; 8] = [0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0];
/// Rounds of reweighting, and the distance that loses half its weight, metres.
const ROUNDS: usize = 20;
const ROBUST_M: f64 = 0.03;

/// One landmark seen in one view: derivative of its place in the image plane by its bias, and that place relative to the
/// body's; metres at the body's depth.
#[derive(Debug, Clone, Copy)]
struct Sample {
    rows: [DVec3; 2],
    error: DVec2,
    confidence: f64,
}

impl Sample {
    /// Squared distance from where a bias puts the landmark, square metres.
    fn square(&self, bias: DVec3) -> f64 {
        (self.error - DVec2::new(self.rows[0].dot(bias), self.rows[1].dot(bias))).length_squared()
    }

    /// Whether the landmark is surely this one, and seen.
    fn is_sure(&self) -> bool {
        self.confidence >= SURE && self.error.length() <= GROSS_M
    }
}

/// Measures the network's bias and spread on people whose pose is known.
#[derive(Debug)]
pub struct LandmarkStudy {
    net: PoseNet,
    /// By landmark of the left side or the middle.
    samples: Vec<Vec<Sample>>,
}

/// Bias and spread of one landmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Habit {
    /// Number of the landmark; those of the right side count as their mirror images.
    pub landmark: usize,
    /// From the anatomical place, canonical axes of the part that carries it, metres on a body of 1.7 m.
    pub bias_m: DVec3,
    /// Standard deviation about it in an image, metres at the body's depth.
    pub spread_m: f64,
    /// How often it was seen.
    pub count: usize,
}

impl LandmarkStudy {
    /// Starts without measurements.
    #[must_use]
    pub fn new(net: PoseNet) -> Self {
        Self { net, samples: vec![Vec::new(); LANDMARK_COUNT] }
    }

    /// Measures one image of a person in a known pose of a known body.
    ///
    /// # Errors
    /// Kinds `Template` and `Image` when those cannot be used, `Net` when the network fails.
    pub fn add(&mut self, camera: &Camera, image: &Image, template: &Template, pose: &Pose) -> Result<(), TrackError> {
        let model = BodyModel::without_habits(template)?;
        let Some(turns) = model.to_turns(pose) else { return Ok(()) };
        let (posed, marks) = (model.pose(&turns), model.marks(&turns));
        let Some(crop) = Crop::around(&project_all(camera, &marks)) else { return Ok(()) };
        let sighting = Sighting::take(&self.net, &Rgb::new(image)?, crop)?;
        if sighting.output.presence < 0.5 {
            return Ok(());
        }
        let metres = template_scale(template);
        let view = View::new(camera);
        let seen = observe(camera, &view, &sighting.keypoints, 0.0);
        for (landmark, seen) in seen.iter().enumerate() {
            let (Some(seen), Some(px_per_m)) = (seen, view.px_per_m(marks[landmark])) else { continue };
            let Some(at) = view.project(marks[landmark]) else { continue };
            let error = (seen.ideal_px - at) / px_per_m;
            let to_camera = view.rotation * DMat3::from_quat(posed.rotation[model.marks[landmark].joint]) * metres;
            let mirror = |row: DVec3| if is_right(landmark) { DVec3::new(-row.x, row.y, row.z) } else { row };
            let rows = [to_camera.row(0), to_camera.row(1)].map(mirror);
            self.samples[left_of(landmark)].push(Sample { rows, error, confidence: seen.confidence });
        }
        Ok(())
    }

    /// Returns the habits of all landmarks that were seen from enough directions.
    #[must_use]
    pub fn habits(&self) -> Vec<Habit> {
        let fit = |(landmark, samples): (usize, &Vec<Sample>)| {
            let samples: Vec<&Sample> = samples.iter().filter(|sample| sample.is_sure()).collect();
            if samples.len() <= 20 {
                return None;
            }
            let mut bias = DVec3::ZERO;
            for _ in 0..ROUNDS {
                let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
                for Sample { rows, error, .. } in &samples {
                    let left = *error - DVec2::new(rows[0].dot(bias), rows[1].dot(bias));
                    let weight = 1.0 / (1.0 + left.length_squared() / (ROBUST_M * ROBUST_M));
                    for (row, e) in rows.iter().zip(error.to_array()) {
                        normal += DMat3::from_cols(*row * row.x, *row * row.y, *row * row.z) * weight;
                        right += *row * (e * weight);
                    }
                }
                if normal.determinant() < 1e-6 * samples.len() as f64 {
                    return None;
                }
                bias = normal.inverse() * right;
            }
            let mut squares: Vec<f64> = samples.iter().map(|sample| sample.square(bias)).collect();
            // Of a two-dimensional Gaussian: the median square is 2 ln 2 variances.
            let spread_m = (flyrig_solve::median(&mut squares)? / (2.0 * std::f64::consts::LN_2)).sqrt();
            (bias.is_finite() && spread_m.is_finite()).then_some(Habit {
                landmark,
                bias_m: bias,
                spread_m,
                count: samples.len(),
            })
        };
        self.samples.iter().enumerate().filter_map(fit).collect()
    }

    /// Returns how a landmark's spread grows as the network is less sure of it, by ranges of confidence from low to high.
    #[must_use]
    pub fn doubts(&self) -> Vec<Doubt> {
        let mut relative: [Vec<f64>; RANGES.len()] = Default::default();
        for habit in self.habits() {
            for sample in &self.samples[habit.landmark] {
                let range = RANGES.iter().position(|end| sample.confidence <= *end).unwrap_or(RANGES.len() - 1);
                relative[range].push(sample.square(habit.bias_m) / (habit.spread_m * habit.spread_m));
            }
        }
        let nine_tenths = |relative: &mut Vec<f64>| {
            relative.sort_by(f64::total_cmp);
            relative.get(relative.len() * 9 / 10).map(|square| square.sqrt())
        };
        let spreads = relative.each_mut().map(nine_tenths);
        let Some(sure) = spreads[RANGES.len() - 1] else { return Vec::new() };
        let counts = relative.iter().map(Vec::len);
        let ranges = RANGES.into_iter().zip(spreads).zip(counts);
        ranges.filter_map(|((up_to, spread), count)| Some(Doubt { up_to, times: spread? / sure, count })).collect()
    }
}

/// Spread of landmarks of a range of confidence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Doubt {
    /// Upper end of the range, 0..=1.
    pub up_to: f64,
    /// Distance that holds nine of ten, as a multiple of that of the surest range.
    pub times: f64,
    /// How many there were.
    pub count: usize,
}

/// Height of a template over that of the body that biases are stated for.
pub(crate) fn template_scale(template: &Template) -> f64 {
    let heights = template.positions.iter().map(|p| f64::from(p.y));
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), y| (low.min(y), high.max(y)));
    (high - low) / 1.7
}

/// Whether a landmark is on the person's right side.
pub(crate) fn is_right(landmark: usize) -> bool {
    left_of(landmark) != landmark
}

/// The landmark of the left side that a landmark mirrors, or itself.
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
    fn a_bias_is_found_from_several_directions_in_spite_of_outliers() {
        let net = PoseNet::embedded().unwrap();
        let mut study = LandmarkStudy::new(net);
        let bias = DVec3::new(0.01, -0.03, 0.02);
        for k in 0..300 {
            let turn = DMat3::from_rotation_y(f64::from(k) * 0.7) * DMat3::from_rotation_x(f64::from(k) * 0.3);
            let rows = [turn.row(0), turn.row(1)];
            let noise = DVec2::new(f64::from(k % 7) - 3.0, f64::from(k % 5) - 2.0) * 1e-3;
            let outlier = if k % 10 == 0 { DVec2::new(0.12, 0.0) } else { DVec2::ZERO };
            study.samples[11].push(Sample {
                rows,
                error: DVec2::new(rows[0].dot(bias), rows[1].dot(bias)) + noise + outlier,
                confidence: 0.9,
            });
        }
        let habits = study.habits();
        let [habit] = habits.as_slice() else { panic!("{habits:?}") };
        let near = study.samples[11].iter().filter(|sample| sample.error.length() <= GROSS_M).count();
        assert_eq!((habit.landmark, habit.count), (11, near));
        assert!((295..300).contains(&near), "gross outliers are left out: {near}");
        assert!((habit.bias_m - bias).length() < 0.003, "{}", habit.bias_m);
        assert!((0.001..0.004).contains(&habit.spread_m), "{}", habit.spread_m);
    }

    #[test]
    fn doubt_is_measured_by_confidence_and_grows_as_that_falls() {
        let mut study = LandmarkStudy::new(PoseNet::embedded().unwrap());
        for k in 0..400 {
            let turn = DMat3::from_rotation_y(f64::from(k) * 0.7) * DMat3::from_rotation_x(f64::from(k) * 0.3);
            let noise = DVec2::new(f64::from(k % 7) - 3.0, f64::from(k % 5) - 2.0) * 1e-3;
            let (confidence, times) = if k % 2 == 0 { (0.95, 1.0) } else { (0.15, 5.0) };
            study.samples[13].push(Sample { rows: [turn.row(0), turn.row(1)], error: noise * times, confidence });
        }
        let doubts = study.doubts();
        let [low, high] = doubts.as_slice() else { panic!("{doubts:?}") };
        assert_eq!((low.up_to, low.count, high.up_to, high.count), (0.2, 200, 1.0, 200));
        assert!((low.times - 5.0).abs() < 0.3 && (high.times - 1.0).abs() < 1e-12, "{doubts:?}");
        assert!(LandmarkStudy::new(PoseNet::embedded().unwrap()).doubts().is_empty());
        for (a, b) in [(0.0, 0.1), (0.1, 0.3), (0.3, 0.5), (0.5, 0.9)] {
            assert!(doubt(a) > doubt(b), "{a} {b}");
        }
        for (confidence, least) in [(1.0, 1.0), (5.0, 1.0), (0.0, doubt(0.025)), (-1.0, doubt(0.025))] {
            assert!((doubt(confidence) - least).abs() < 1e-12, "{confidence}");
        }
        assert!(doubt(f64::NAN).is_nan());
    }

    #[test]
    fn one_direction_alone_says_nothing_of_depth() {
        let mut study = LandmarkStudy::new(PoseNet::embedded().unwrap());
        study.samples[11] = vec![Sample { rows: [DVec3::X, DVec3::Y], error: DVec2::ZERO, confidence: 0.9 }; 100];
        assert!(study.habits().is_empty());
    }
}
