//! Bone lengths of a person from triangulated landmarks, and the template with them.

use std::collections::BTreeMap;

use flyrig_body::{Outfit, Template};
use flyrig_solve::median;
use flyrig_types::Rig;

use crate::error::TrackError;
use crate::landmarks::keypoints::{LANDMARK_COUNT, ViewKeypoints};
use crate::landmarks::triangulate::triangulate;
use crate::pose::body_model::BodyModel;
use crate::pose::config::PoseConfig;
use crate::shape::body_shape::{ShapeSpace, scale_template};

/// Weight of the template's proportions, in measurements of a length.
const PRIOR_COUNT: f64 = 2.0;
/// Range of the proportions of adults relative to the template's.
const GROUP_RANGE: (f64, f64) = (0.8, 1.25);
/// Plausible range of the whole-body scale.
const SCALE_RANGE: (f64, f64) = (0.4, 1.6);

/// Length groups: name and the pairs of landmarks whose distance measures it.
const GROUPS: [(&str, &[(usize, usize)]); 8] = [
    ("trunk", &[(11, 23), (12, 24)]),
    ("shoulders", &[(11, 12)]),
    ("hips", &[(23, 24)]),
    ("upper-arms", &[(11, 13), (12, 14)]),
    ("forearms", &[(13, 15), (14, 16)]),
    ("thighs", &[(23, 25), (24, 26)]),
    ("shanks", &[(25, 27), (26, 28)]),
    ("feet", &[(29, 31), (30, 32)]),
];

/// Result of a shape fit.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeFit {
    /// Scale of the whole body.
    pub scale: f64,
    /// Length factor of each group of bones in addition to `scale`, by name.
    pub groups: BTreeMap<String, f64>,
    /// Standard deviation of `scale` and of each factor, by name; empty where only distances between landmarks were used.
    pub sigma: BTreeMap<String, f64>,
    /// Stature of the fitted template in its bind pose, metres.
    pub height_m: f64,
    /// Number of frame sets that measured at least one length.
    pub sets: usize,
    /// Source of the height.
    pub height_from: HeightFrom,
    /// Clothes of the person.
    pub outfit: Outfit,
}

/// Source of a person's height.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HeightFrom {
    /// Two or more views.
    Measurement,
    /// [`PoseSettings::height_m`](crate::PoseSettings::height_m).
    Configuration,
    /// Place of the feet before a single camera, for a floor at this height in metres ([`PoseSettings::floor_m`](crate::PoseSettings::floor_m)).
    Floor(f64),
    /// Template: a single camera cannot distinguish a tall person from a near one.
    Average,
}

impl std::fmt::Display for ShapeFit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.2} m tall", self.height_m)?;
        match self.height_from {
            HeightFrom::Measurement => {}
            HeightFrom::Configuration => f.write_str(" (as configured)")?,
            HeightFrom::Floor(floor_m) => write!(
                f,
                " (one camera: by where the feet stand on a floor at height {floor_m}; if it is elsewhere give perception.floor_m or --floor)"
            )?,
            HeightFrom::Average => f.write_str(
                " (an average height, for one camera sees no feet on the floor: give perception.height_m or --height, or \
                 perception.floor_m or --floor)",
            )?,
        }
        if self.outfit.is_bare() { Ok(()) } else { write!(f, ", in {}", self.outfit) }
    }
}

impl ShapeFit {
    /// Returns a factor by name, `scale` included.
    pub(crate) fn factor(&self, name: &str) -> Option<f64> {
        if name == "scale" { Some(self.scale) } else { self.groups.get(name).copied() }
    }

    /// Stores a solution of the shape space.
    pub(crate) fn set(&mut self, space: &ShapeSpace, values: &[f64], sigma: &[f64], template: &Template) {
        for (((name, ..), value), sigma) in space.prior().iter().zip(values).zip(sigma) {
            if *name == "scale" {
                self.scale = *value;
            } else {
                self.groups.insert((*name).to_owned(), *value);
            }
            self.sigma.insert((*name).to_owned(), *sigma);
        }
        self.height_m = height_m(template);
    }
}

/// Scales a template to a person: the whole body, and each group of bones along its own direction, by the median distances
/// between triangulated landmarks over a few frame sets.
///
/// `keypoints[set][slot]` are the landmarks of one person, slots in rig order. Needs two views in at least one frame set.
/// Vertices move with the bones that carry them, so that flesh keeps its thickness apart from `scale`.
///
/// # Errors
/// Kind `Lost` when too few lengths were measured or they are implausible; kind `Template` when the template lacks joints.
pub(crate) fn fit_template_shape(
    template: &Template,
    rig: &Rig,
    keypoints: &[Vec<Option<ViewKeypoints>>],
    config: &PoseConfig,
) -> Result<(Template, ShapeFit), TrackError> {
    let model = BodyModel::new(template)?;
    let mut lengths: [Vec<f64>; GROUPS.len()] = std::array::from_fn(|_| Vec::new());
    let mut sets = 0;
    for views in keypoints {
        let points = triangulate(&rig.cameras, views, config.confidence_threshold, config.inlier_m);
        let mut any = false;
        for ((_, pairs), lengths) in GROUPS.iter().zip(&mut lengths) {
            for &(a, b) in *pairs {
                if let (Some(a), Some(b)) = (&points[a], &points[b]) {
                    lengths.push((a.position - b.position).length());
                    any = true;
                }
            }
        }
        sets += usize::from(any);
    }
    let rest = usual_lengths(&model);
    // Ratio of measured to template length, and the number of measurements.
    let ratios: Vec<Option<(f64, f64)>> = GROUPS
        .iter()
        .zip(&mut lengths)
        .map(|((_, pairs), lengths)| {
            let count = lengths.len() as f64;
            let template_m = pairs.iter().map(|&(a, b)| rest(a, b)).sum::<f64>() / pairs.len() as f64;
            median(lengths).map(|measured_m| (measured_m / template_m, count))
        })
        .collect();
    // Long bones determine the stature; widths and feet do not.
    const STATURE: [(usize, f64); 5] = [(0, 2.0), (3, 1.0), (4, 1.0), (5, 2.0), (6, 2.0)];
    let (sum, weight) = STATURE
        .iter()
        .filter_map(|&(group, weight)| ratios[group].map(|(ratio, _)| (ratio * weight, weight)))
        .fold((0.0, 0.0), |(s, t), (r, w)| (s + r, t + w));
    if weight < 4.0 {
        return Err(TrackError::lost(
            "the shape fit needs the trunk and the limbs in two views; let the person stand free for a moment",
        ));
    }
    let scale = sum / weight;
    if !(SCALE_RANGE.0..=SCALE_RANGE.1).contains(&scale) {
        return Err(TrackError::lost(format!(
            "the person measures {scale:.2} times the template; check that the calibration is in metres"
        )));
    }
    let groups: BTreeMap<String, f64> = GROUPS
        .iter()
        .zip(&ratios)
        .map(|((name, _), ratio)| {
            let factor =
                ratio.map_or(1.0, |(ratio, count)| (ratio / scale * count + PRIOR_COUNT) / (count + PRIOR_COUNT));
            ((*name).to_owned(), factor.clamp(GROUP_RANGE.0, GROUP_RANGE.1))
        })
        .collect();
    let mut factors = groups.clone();
    factors.insert("scale".to_owned(), scale);
    let mut shaped = scale_template(template, &model, &factors)?;
    let mut height_from = HeightFrom::Measurement;
    if let Some(height) = config.settings.height_m {
        factors.insert("scale".to_owned(), scale * height / height_m(&shaped));
        shaped = scale_template(template, &model, &factors)?;
        height_from = HeightFrom::Configuration;
    }
    let scale = factors.get("scale").copied().unwrap_or(scale);
    let fit = ShapeFit {
        scale,
        groups,
        sigma: BTreeMap::new(),
        height_m: height_m(&shaped),
        sets,
        height_from,
        outfit: Outfit::default(),
    };
    tracing::debug!(scale, height_m = fit.height_m, sets, "fitted the template's bone lengths");
    Ok((shaped, fit))
}

/// Returns the median distance of two landmarks over poses that fill the joints' ranges evenly: a landmark that lies beside its
/// joint moves with one of the bones that meet there, so that its distance from the next one depends on the pose.
fn usual_lengths(model: &BodyModel) -> impl Fn(usize, usize) -> f64 {
    /// Number of poses, and the inverse of the golden ratio, whose multiples fill 0..1 evenly.
    const POSES: usize = 48;
    const STEP: f64 = 0.618_033_988_749_894_9;
    let pose = |pose: usize| {
        let mut turns = model.bind_turns(glam::DVec3::ZERO);
        for (joint, range) in model.ranges.iter().enumerate() {
            let Some(range) = range else { continue };
            let component = |axis: usize| {
                let share = ((1 + pose) as f64 * STEP * (1 + 3 * joint + axis) as f64).fract();
                ((2.0 * share - 1.0) * range.sigma[axis]).clamp(range.low[axis], range.high[axis])
            };
            let turn = glam::DVec3::new(component(0), component(1), component(2));
            turns.turns[joint] = flyrig_solve::exp_rotation(range.axes * turn);
        }
        model.marks(&turns)
    };
    let marks: Vec<_> = (0..POSES).map(pose).collect();
    move |a, b| {
        let mut lengths: Vec<f64> = marks.iter().map(|marks| (marks[a] - marks[b]).length()).collect();
        median(&mut lengths).unwrap_or(f64::NAN)
    }
}

/// Returns a template of a height in metres, unscaled where none is known.
pub(crate) fn template_of_height(
    template: &Template,
    height: Option<f64>,
    height_from: HeightFrom,
) -> Result<(Template, ShapeFit), TrackError> {
    let scale = height.map_or(1.0, |height| height / height_m(template));
    let factors = [("scale".to_owned(), scale)].into_iter().collect();
    let shaped = scale_template(template, &BodyModel::new(template)?, &factors)?;
    let (groups, sigma, height_m) = (BTreeMap::new(), BTreeMap::new(), height_m(&shaped));
    Ok((shaped, ShapeFit { scale, groups, sigma, height_m, sets: 0, height_from, outfit: Outfit::default() }))
}

/// Returns the height of a template in its bind pose, metres.
pub(crate) fn height_m(template: &Template) -> f64 {
    let heights = template.positions.iter().map(|p| f64::from(p.y));
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), y| (low.min(y), high.max(y)));
    high - low
}

/// Returns the number of landmarks that at least two views see.
pub(crate) fn seen_landmarks(views: &[Option<ViewKeypoints>], threshold: f64) -> usize {
    let seen = |i: usize| {
        views.iter().flatten().filter(|view| view[i].usable() && view[i].confidence >= threshold).count() >= 2
    };
    (0..LANDMARK_COUNT).filter(|&i| seen(i)).count()
}

#[cfg(test)]
mod tests {
    use flyrig_solve::exp_rotation;
    use glam::{DMat4, DVec3};
    use rand::rngs::StdRng;
    use rand::{RngExt as _, SeedableRng as _};

    use super::*;
    use crate::error::TrackErrorKind;
    use crate::testing::{body, keypoints_of, random_turns, ring};

    #[test]
    fn a_stretched_person_is_measured_back() {
        let template = body();
        let model = BodyModel::new(&template).unwrap();
        let truth: BTreeMap<String, f64> = [("thighs", 1.08), ("forearms", 0.93), ("shoulders", 1.05), ("trunk", 0.96)]
            .into_iter()
            .map(|(name, factor)| (name.to_owned(), factor))
            .collect();
        let stretched = scale_template(&template, &model, &truth).unwrap();
        let person = BodyModel::new(&stretched).unwrap();
        let rig = ring(3);
        let keypoints: Vec<Vec<_>> = (0..8)
            .map(|seed| {
                let marks = person.marks(&random_turns(&person, seed));
                rig.cameras.iter().map(|camera| Some(keypoints_of(camera, &marks))).collect()
            })
            .collect();
        let (fitted, fit) = fit_template_shape(&template, &rig, &keypoints, &PoseConfig::default()).unwrap();
        assert_eq!(fit.sets, 8);
        // Lengths of bones: the network's biases would count as parts of them.
        let fitted = BodyModel::with_anatomical_marks(&fitted).unwrap();
        let person = BodyModel::with_anatomical_marks(&stretched).unwrap();
        for (a, b) in [(23, 25), (25, 27), (11, 13), (13, 15), (11, 12), (23, 24)] {
            let length = |m: &BodyModel| (m.marks[a].point - m.marks[b].point).length();
            let (found, expected) = (length(&fitted), length(&person));
            assert!((found / expected - 1.0).abs() < 0.02, "{a}-{b}: {found} {expected}");
        }
    }

    #[test]
    fn usual_lengths_are_those_of_bones_and_of_marks_beside_them() {
        let template = body();
        // Joints at both ends of one bone: the pose does not matter.
        let bones = BodyModel::with_anatomical_marks(&template).unwrap();
        let rest = usual_lengths(&bones);
        for (a, b) in [(13, 15), (23, 25), (25, 27)] {
            let bone = (bones.marks[a].point - bones.marks[b].point).length();
            assert!((rest(a, b) / bone - 1.0).abs() < 1e-9, "{a}-{b}: {} {bone}", rest(a, b));
        }
        // Landmarks beside the joints: the median of many random poses within a standard deviation.
        let model = BodyModel::new(&template).unwrap();
        let rest = usual_lengths(&model);
        let mut random = StdRng::seed_from_u64(1);
        let marks: Vec<_> = (0..1000)
            .map(|_| {
                let mut turns = model.bind_turns(DVec3::ZERO);
                for (turn, range) in turns.turns.iter_mut().zip(&model.ranges) {
                    let Some(range) = range else { continue };
                    let v = DVec3::from_array(std::array::from_fn(|_| random.random_range(-1.0..1.0))) * range.sigma;
                    *turn = exp_rotation(range.axes * v.clamp(range.low, range.high));
                }
                model.marks(&turns)
            })
            .collect();
        for (a, b) in [(11, 13), (12, 14), (11, 12), (11, 23), (23, 25)] {
            let mut lengths: Vec<f64> = marks.iter().map(|marks| (marks[a] - marks[b]).length()).collect();
            let usual = median(&mut lengths).unwrap();
            assert!((rest(a, b) / usual - 1.0).abs() < 0.02, "{a}-{b}: {} {usual}", rest(a, b));
        }
    }

    #[test]
    fn the_shaped_skeleton_still_carries_its_skin() {
        let template = body();
        let model = BodyModel::new(&template).unwrap();
        let groups =
            [("scale".to_owned(), 0.9), ("thighs".to_owned(), 1.2), ("hips".to_owned(), 0.9)].into_iter().collect();
        let shaped = scale_template(&template, &model, &groups).unwrap();
        let matrices = shaped.skeleton.world_from_canonical(&shaped.skeleton.rest_pose());
        // The built-in body rests in its bind pose: the skinning matrices move nothing.
        for matrix in matrices {
            assert!((matrix - DMat4::IDENTITY).to_cols_array().iter().all(|v| v.abs() < 1e-6), "{matrix}");
        }
        assert!(shaped.positions.iter().chain(&shaped.normals).all(|p| p.is_finite()));
        assert!(shaped.normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-3));
    }

    #[test]
    fn no_views_one_view_and_poison_are_lost_not_nan() {
        let template = body();
        let rig = ring(2);
        let nan =
            [crate::landmarks::keypoints::Keypoint { pixel: glam::DVec2::NAN, confidence: 1.0, ..Default::default() };
                LANDMARK_COUNT];
        let points = [DVec3::new(0.0, 0.0, 1.0); LANDMARK_COUNT];
        let one_point = [0, 1].map(|i| Some(keypoints_of(&rig.cameras[i], &points))).to_vec();
        for keypoints in [vec![], vec![vec![None, None]], vec![vec![Some(nan), Some(nan)]], vec![one_point]] {
            let error = fit_template_shape(&template, &rig, &keypoints, &PoseConfig::default()).unwrap_err();
            assert_eq!(error.kind, TrackErrorKind::Lost);
        }
    }
}
