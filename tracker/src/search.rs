//! Finding the person: crops over the whole picture, and agreement between the views.

use flyrig_types::Camera;
use glam::DVec2;
use rayon::prelude::*;

use crate::crop::{Crop, search_crops};
use crate::net::NetOutput;
use crate::pixels::Rgb;
use crate::triangulate::{WorldPoint, triangulate};
use crate::{LANDMARK_COUNT, PoseConfig, PoseNet, TrackError, ViewKeypoints};

/// Hypotheses kept a picture.
const KEEP: usize = 4;
/// Crops of the first look that are looked at again.
const REFINE: usize = 6;

/// What the network saw in one crop of a picture.
#[derive(Debug, Clone)]
pub(crate) struct Sighting {
    pub crop: Crop,
    pub output: NetOutput,
    pub keypoints: ViewKeypoints,
}

impl Sighting {
    pub fn take(net: &PoseNet, picture: &Rgb, crop: Crop) -> Result<Self, TrackError> {
        let output = net.run(&crop.sample(picture))?;
        let keypoints = crop.keypoints(&output);
        Ok(Self { crop, output, keypoints })
    }

    /// The crop that the landmarks ask for.
    pub fn next_crop(&self) -> Option<Crop> {
        Crop::around(&std::array::from_fn(|i| Some(self.keypoints[i].pixel)))
    }

    fn mean_confidence(&self) -> f64 {
        self.keypoints.iter().map(|k| k.confidence).sum::<f64>() / LANDMARK_COUNT as f64
    }

    /// Larger and surer is better.
    fn score(&self) -> f64 {
        self.output.presence * self.mean_confidence() * self.crop.side.max(1.0).sqrt()
    }

    fn overlaps(&self, other: &Self) -> bool {
        let mut distance = 0.0;
        for (a, b) in self.keypoints.iter().zip(&other.keypoints) {
            distance += (a.pixel - b.pixel).length();
        }
        distance / (LANDMARK_COUNT as f64) < 0.1 * self.crop.side.max(other.crop.side)
    }
}

/// Everybody the network finds in a picture, best first.
pub(crate) fn sightings(net: &PoseNet, picture: &Rgb, config: &PoseConfig) -> Result<Vec<Sighting>, TrackError> {
    let mut first = Vec::new();
    for crop in search_crops(picture.width as u32, picture.height as u32) {
        let sighting = Sighting::take(net, picture, crop)?;
        if sighting.output.presence >= 0.5 * config.presence_threshold {
            first.push(sighting);
        }
    }
    first.sort_by(|a, b| b.score().total_cmp(&a.score()));
    first.truncate(REFINE);
    let mut found: Vec<Sighting> = Vec::new();
    for mut sighting in first {
        for _ in 0..2 {
            let Some(crop) = sighting.next_crop() else { break };
            sighting = Sighting::take(net, picture, crop)?;
        }
        if sighting.output.presence < config.presence_threshold {
            continue;
        }
        match found.iter_mut().find(|other| other.overlaps(&sighting)) {
            Some(other) if other.score() >= sighting.score() => {}
            Some(other) => *other = sighting,
            None => found.push(sighting),
        }
    }
    found.sort_by(|a, b| b.score().total_cmp(&a.score()));
    found.truncate(KEEP);
    Ok(found)
}

/// Finds the person whom most views agree on; a slot a camera. With one view, the surest and largest one.
pub(crate) fn search(
    net: &PoseNet,
    cameras: &[Camera],
    pictures: &[Option<Rgb<'_>>],
    config: &PoseConfig,
) -> Result<Vec<Option<Sighting>>, TrackError> {
    let found: Vec<Vec<Sighting>> = pictures
        .par_iter()
        .map(|picture| picture.as_ref().map_or_else(|| Ok(Vec::new()), |p| sightings(net, p, config)))
        .collect::<Result<_, _>>()?;
    let choice = choose(cameras, &found, config);
    Ok(found.into_iter().zip(choice).map(|(mut found, index)| index.map(|i| found.swap_remove(i))).collect())
}

/// Index of the chosen hypothesis of each view.
fn choose(cameras: &[Camera], found: &[Vec<Sighting>], config: &PoseConfig) -> Vec<Option<usize>> {
    let keypoints = |choice: &[Option<usize>]| -> Vec<Option<ViewKeypoints>> {
        choice.iter().zip(found).map(|(index, found)| index.map(|i| found[i].keypoints)).collect()
    };
    let rate = |choice: &[Option<usize>]| -> f64 {
        let points = triangulate(cameras, &keypoints(choice), config.confidence_threshold, 2.0 * config.inlier_m);
        if !human_size(&points) {
            return 0.0;
        }
        let agreeing = points.iter().flatten().map(|p| p.inliers.len() as f64).sum::<f64>();
        let seen: f64 = choice.iter().zip(found).filter_map(|(index, found)| index.map(|i| found[i].score())).sum();
        // Scores only break ties between people whom the same number of views agree on.
        agreeing + 0.5 * seen
    };
    let mut best = (0.0, vec![None; found.len()]);
    for a in 0..found.len() {
        for b in a + 1..found.len() {
            for i in 0..found[a].len() {
                for j in 0..found[b].len() {
                    let mut choice = vec![None; found.len()];
                    (choice[a], choice[b]) = (Some(i), Some(j));
                    let mut score = rate(&choice);
                    if score <= 0.0 {
                        continue;
                    }
                    for other in (0..found.len()).filter(|o| *o != a && *o != b) {
                        let mut gain = (score + 4.0, None);
                        for k in 0..found[other].len() {
                            choice[other] = Some(k);
                            let with = rate(&choice);
                            if with > gain.0 {
                                gain = (with, Some(k));
                            }
                        }
                        choice[other] = gain.1;
                        if gain.1.is_some() {
                            score = gain.0;
                        }
                    }
                    if score > best.0 {
                        best = (score, choice);
                    }
                }
            }
        }
    }
    if best.0 > 0.0 {
        return best.1;
    }
    // Nobody in two views: the best single sighting, if any.
    let single = (0..found.len()).filter(|&slot| !found[slot].is_empty());
    let single = single.max_by(|&a, &b| found[a][0].score().total_cmp(&found[b][0].score()));
    let mut choice = vec![None; found.len()];
    if let Some(slot) = single {
        choice[slot] = Some(0);
    }
    choice
}

/// Whether the trunk is there and as large as a person's.
fn human_size(points: &[Option<WorldPoint>; LANDMARK_COUNT]) -> bool {
    let count = points.iter().flatten().count();
    let lengths: Vec<f64> = [(11, 23), (12, 24)]
        .iter()
        .filter_map(|&(a, b)| Some((points[a].as_ref()?.position - points[b].as_ref()?.position).length()))
        .collect();
    count >= 8 && !lengths.is_empty() && lengths.iter().all(|l| (0.2..0.9).contains(l))
}

/// Where a camera sees world points; `None` where it does not.
pub(crate) fn project_all(camera: &Camera, points: &[glam::DVec3; LANDMARK_COUNT]) -> [Option<DVec2>; LANDMARK_COUNT] {
    points.map(|point| camera.project(point))
}
