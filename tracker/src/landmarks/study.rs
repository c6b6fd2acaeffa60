//! Measures the pose network's bias and spread on people whose pose is known; its tables are those of
//! [`bias`](crate::landmarks::bias).

use std::collections::BTreeMap;

use flyrig_body::Template;
use flyrig_types::{Camera, Image, Pose};
use glam::{DMat3, DVec2, DVec3};

use crate::error::TrackError;
use crate::image::crop::Crop;
use crate::image::pixels::Rgb;
use crate::image::view::{Observation, View, observe};
use crate::landmarks::bias::{by_peak, is_right, left_of, template_scale};
use crate::landmarks::keypoints::{LANDMARK_COUNT, Sharpness};
use crate::landmarks::search::project_all;
use crate::landmarks::sighting::Sighting;
use crate::network::pose_net::PoseNet;
use crate::pose::body_model::BodyModel;

/// Least confidence of a sure landmark, and largest distance from the body, metres: beyond, it is another person's or on
/// the wrong side.
const SURE: f64 = 0.3;
const GROSS_M: f64 = 0.15;
/// Upper ends of the ranges of confidence, and of the relative width of a peak, whose spread is measured.
const CONFIDENCES: [f64; 6] = [0.1, 0.3, 0.5, 0.7, 0.9, 1.0];
const PEAKS: [f64; 8] = [0.9, 0.97, 1.03, 1.12, 1.21, 1.33, 1.5, 9.0];
/// Rounds of reweighting, and the distance that loses half its weight, metres.
const ROUNDS: usize = 20;
const ROBUST_M: f64 = 0.03;

/// Observation of a landmark in one view: derivative of its place in the image plane by its bias, and that place relative
/// to the body's, metres at the body's depth.
#[derive(Debug, Clone, Copy)]
struct Sample {
    rows: [DVec3; 2],
    error: DVec2,
    confidence: f64,
    sharpness: Sharpness,
}

impl Sample {
    /// Returns the squared distance from the place that a bias predicts, square metres.
    fn square(&self, bias: DVec3) -> f64 {
        (self.error - DVec2::new(self.rows[0].dot(bias), self.rows[1].dot(bias))).length_squared()
    }

    /// Returns the spread of the heatmap's peak, cells.
    fn peak_cells(&self) -> Option<f64> {
        match self.sharpness {
            Sharpness::Peak { spread_cells, .. } => Some(spread_cells),
            Sharpness::NoPeak | Sharpness::Unknown => None,
        }
    }

    /// Whether the landmark is surely this one, and visible.
    fn is_sure(&self) -> bool {
        self.confidence >= SURE && self.error.length() <= GROSS_M
    }
}

/// Measurement of the network's bias and spread, on people whose pose is known.
#[derive(Debug)]
pub struct LandmarkStudy {
    net: PoseNet,
    /// Samples of each landmark of the left side or the middle.
    samples: Vec<Vec<Sample>>,
}

/// Bias and spread of one landmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkBias {
    /// Index of the landmark; those of the right side count as their mirror images.
    pub landmark: usize,
    /// Offset from the anatomical place, canonical axes of the part that carries it, metres on a body of 1.7 m.
    pub bias_m: DVec3,
    /// Standard deviation about it in an image, metres at the body's depth.
    pub spread_m: f64,
    /// Median spread of its heatmap's peak, cells; `None` for a network without heatmaps.
    pub peak_cells: Option<f64>,
    /// Number of observations.
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
        let model = BodyModel::with_anatomical_marks(template)?;
        let Some(turns) = model.to_turns(pose) else { return Ok(()) };
        let (posed, marks) = (model.pose(&turns), model.marks(&turns));
        let Some(crop) = Crop::around(&project_all(camera, &marks)) else { return Ok(()) };
        let sighting = Sighting::infer(&self.net, &Rgb::new(image)?, crop)?;
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
            let Observation { confidence, sharpness, .. } = *seen;
            self.samples[left_of(landmark)].push(Sample { rows, error, confidence, sharpness });
        }
        Ok(())
    }

    /// Returns the biases of all landmarks that were seen from enough directions.
    #[must_use]
    pub fn biases(&self) -> Vec<LandmarkBias> {
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
            // The median square of a two-dimensional Gaussian is 2 ln 2 variances.
            let spread_m = (flyrig_solve::median(&mut squares)? / (2.0 * std::f64::consts::LN_2)).sqrt();
            let mut peaks: Vec<f64> = samples.iter().filter_map(|sample| sample.peak_cells()).collect();
            (bias.is_finite() && spread_m.is_finite()).then_some(LandmarkBias {
                landmark,
                bias_m: bias,
                spread_m,
                peak_cells: flyrig_solve::median(&mut peaks),
                count: samples.len(),
            })
        };
        self.samples.iter().enumerate().filter_map(fit).collect()
    }

    /// Returns the spread by the width of the heatmap's peak, by the confidence beyond that, and by the confidence without a
    /// peak.
    #[must_use]
    pub fn spreads(&self) -> Vec<RelativeSpread> {
        let mut found: BTreeMap<(SpreadBy, usize), Vec<f64>> = BTreeMap::new();
        for habit in self.biases() {
            for sample in &self.samples[habit.landmark] {
                let relative = sample.square(habit.bias_m).sqrt() / habit.spread_m;
                let range = |ends: &[f64], at: f64| ends.iter().position(|end| at <= *end).unwrap_or(ends.len() - 1);
                let by_confidence = range(&CONFIDENCES, sample.confidence);
                match sample.peak_cells().zip(habit.peak_cells) {
                    Some((own, usual)) => {
                        found.entry((SpreadBy::Peak, range(&PEAKS, own / usual))).or_default().push(relative);
                        let explained = by_peak(own / usual);
                        found.entry((SpreadBy::Confidence, by_confidence)).or_default().push(relative / explained);
                    }
                    None => found.entry((SpreadBy::ConfidenceAlone, by_confidence)).or_default().push(relative),
                }
            }
        }
        let row = |((by, range), mut values): ((SpreadBy, usize), Vec<f64>)| {
            let up_to = if by == SpreadBy::Peak { PEAKS[range] } else { CONFIDENCES[range] };
            // The median distance of a two-dimensional Gaussian is the square root of 2 ln 2 standard deviations.
            let times = flyrig_solve::median(&mut values)? / (2.0 * std::f64::consts::LN_2).sqrt();
            Some(RelativeSpread { by, up_to, times, count: values.len() })
        };
        found.into_iter().filter_map(row).collect()
    }
}

/// Grouping of landmarks whose spreads are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum SpreadBy {
    /// Groups by the width of the heatmap's peak, relative to the landmark's median.
    Peak,
    /// Groups landmarks with a peak by confidence; spreads are relative to the spread that the peak predicts.
    Confidence,
    /// Groups landmarks without a peak by confidence.
    ConfidenceAlone,
}

/// Spread of a group of landmarks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelativeSpread {
    /// Grouping.
    pub by: SpreadBy,
    /// Upper end of the group's range.
    pub up_to: f64,
    /// Standard deviation as a multiple of the landmark's own ([`LandmarkBias::spread_m`]).
    pub times: f64,
    /// Number of observations.
    pub count: usize,
}

#[cfg(test)]
mod tests {
    use super::*;

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
                sharpness: Sharpness::Unknown,
            });
        }
        let habits = study.biases();
        let [habit] = habits.as_slice() else { panic!("{habits:?}") };
        let near = study.samples[11].iter().filter(|sample| sample.error.length() <= GROSS_M).count();
        assert_eq!((habit.landmark, habit.count), (11, near));
        assert!((295..300).contains(&near), "gross outliers are left out: {near}");
        assert!((habit.bias_m - bias).length() < 0.003, "{}", habit.bias_m);
        assert!((0.001..0.004).contains(&habit.spread_m), "{}", habit.spread_m);
    }

    #[test]
    fn spreads_are_told_apart_by_peak_and_confidence() {
        let mut study = LandmarkStudy::new(PoseNet::embedded().unwrap());
        let wide = |times: f64| Sharpness::Peak { spread_cells: times, along: DVec2::X, aspect: 1.0 };
        for k in 0..1000 {
            let turn = DMat3::from_rotation_y(f64::from(k) * 0.7) * DMat3::from_rotation_x(f64::from(k) * 0.3);
            let noise = DVec2::new(f64::from(k % 7) - 3.0, f64::from(k % 5) - 2.0) * 1e-3;
            let (confidence, sharpness, times) = match k % 20 {
                0 => (0.95, Sharpness::NoPeak, 6.0),
                1..=2 => (0.95, wide(1.42), by_peak(1.42)),
                3..=4 => (0.2, wide(1.0), 1.7),
                _ => (0.95, wide(1.0), 1.0),
            };
            let (rows, error) = ([turn.row(0), turn.row(1)], noise * times);
            study.samples[13].push(Sample { rows, error, confidence, sharpness });
        }
        assert_eq!(study.biases()[0].peak_cells, Some(1.0));
        let spreads = study.spreads();
        let of = |by, up_to: f64| spreads.iter().find(|row| row.by == by && (row.up_to - up_to).abs() < 1e-9).unwrap();
        let usual = of(SpreadBy::Peak, 1.03).times;
        for (row, expected, count) in [
            (of(SpreadBy::Peak, 1.5), by_peak(1.42), 100),
            (of(SpreadBy::Confidence, 0.3), 1.7, 100),
            (of(SpreadBy::ConfidenceAlone, 1.0), 6.0, 50),
        ] {
            assert_eq!(row.count, count, "{row:?}");
            assert!((row.times / usual - expected).abs() < 0.25 * expected, "{row:?} {usual}");
        }
        assert!(LandmarkStudy::new(PoseNet::embedded().unwrap()).spreads().is_empty());
    }

    #[test]
    fn one_direction_alone_says_nothing_of_depth() {
        let mut study = LandmarkStudy::new(PoseNet::embedded().unwrap());
        study.samples[11] = vec![
            Sample {
                rows: [DVec3::X, DVec3::Y],
                error: DVec2::ZERO,
                confidence: 0.9,
                sharpness: Sharpness::Unknown
            };
            100
        ];
        assert!(study.biases().is_empty());
    }
}
