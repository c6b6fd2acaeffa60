//! Search for a person who may be anywhere, spread over frame sets so that none takes long.
//!
//! Each step runs the network around foreground that differs from the background, where other views have found a person,
//! and on the next few of the crops that cover the whole image. Hypotheses of the views are joined by triangulation: the
//! person whom most views agree on wins, with preference for the centre of the cameras' attention.

use std::sync::Arc;

use flyrig_types::Camera;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::error::TrackError;
use crate::image::crop::{Crop, quarter_turn, search_crops};
use crate::image::grid::{Grid, components};
use crate::image::pixels::Rgb;
use crate::landmarks::keypoints::{LANDMARK_COUNT, ViewKeypoints};
use crate::landmarks::sighting::Sighting;
use crate::landmarks::single_view::lift;
use crate::landmarks::triangulate::{WorldPoint, triangulate};
use crate::masks::background::Background;
use crate::network::pose_net::PoseNet;
use crate::pose::config::PoseConfig;

/// Hypotheses kept per image.
const KEEP: usize = 4;

/// Age at which a hypothesis is forgotten, nanoseconds: a person walks on.
const FORGET_NANOS: i64 = 1_000_000_000;
/// Distance from the cameras' common centre that halves a person's score, metres.
const NEAR_CENTER_M: f64 = 2.0;
/// Side of a crop around a piece of foreground, as a multiple of its size.
const BLOB_MARGIN: f64 = 1.25;
/// Pieces of foreground that are tried per image.
const BLOBS: usize = 2;

/// Images, background and known people of a search.
pub(crate) struct SearchScene<'a> {
    pub net: &'a PoseNet,
    pub cameras: &'a [Camera],
    /// Up direction of the world, in which people are expected to stand.
    pub up: DVec3,
    pub pictures: &'a [Option<Rgb<'a>>],
    /// Backgrounds in rig order.
    pub backgrounds: &'a [Option<Arc<Background>>],
    pub nanos: i64,
    /// Point nearest to the cameras' optical axes, world metres; people near it are preferred.
    pub center: DVec3,
    /// Landmarks of people who are tracked already.
    pub taken: &'a [[DVec3; LANDMARK_COUNT]],
    pub config: &'a PoseConfig,
}

/// State of a search between frame sets.
#[derive(Debug, Clone, Default)]
pub(crate) struct Search {
    views: Vec<ViewSearch>,
}

/// Search in one view.
#[derive(Debug, Clone, Default)]
struct ViewSearch {
    /// Next crop of those that cover the image.
    next: usize,
    /// Whether all of them were tried since the search began.
    swept: bool,
    /// Whether there was a hypothesis in the last step.
    has_hope: bool,
    /// Hypotheses, best first, with the time of their image in nanoseconds.
    found: Vec<(Sighting, i64)>,
}

impl Search {
    /// Continues the search and returns the sightings of the person whom most views agree on, in rig order. Without
    /// agreement, once every image was searched as a whole, this is the surest and largest sighting of one view. Without
    /// any sighting the search goes on in the next frame set.
    pub fn step(&mut self, scene: &SearchScene<'_>) -> Result<Vec<Option<Sighting>>, TrackError> {
        self.views.resize_with(scene.cameras.len(), ViewSearch::default);
        self.views
            .par_iter_mut()
            .enumerate()
            .map(|(slot, view)| view.search(scene, slot))
            .collect::<Result<Vec<()>, _>>()?;
        self.ask_other_views(scene)?;
        let found: Vec<Vec<Sighting>> =
            self.views.iter().map(|view| view.found.iter().map(|(sighting, _)| sighting.clone()).collect()).collect();
        let choice = choose(scene, &found);
        let agreed = choice.iter().flatten().count() > 1;
        // A single camera has no other to agree with.
        let is_alone = scene.pictures.iter().flatten().count() == 1;
        let searched = |view: &ViewSearch| view.swept || (is_alone && !view.found.is_empty());
        let searched_everywhere =
            self.views.iter().zip(scene.pictures).all(|(view, picture)| searched(view) || picture.is_none());
        if !agreed && !searched_everywhere {
            return Ok(vec![None; found.len()]);
        }
        if agreed || choice.iter().any(Option::is_some) {
            self.views.clear();
        } else {
            self.views.iter_mut().for_each(|view| view.swept = false);
        }
        Ok(found.into_iter().zip(choice).map(|(mut found, index)| index.map(|i| found.swap_remove(i))).collect())
    }

    /// Runs the network in the views without a hypothesis, where the best one of the others would appear.
    fn ask_other_views(&mut self, scene: &SearchScene<'_>) -> Result<(), TrackError> {
        let best = self.views.iter().enumerate().filter_map(|(slot, view)| Some((slot, &view.found.first()?.0)));
        let Some((slot, sighting)) = best.max_by(|a, b| a.1.score().total_cmp(&b.1.score())) else { return Ok(()) };
        let Some(points) = lift(&scene.cameras[slot], sighting, scene.config.confidence_threshold, 1.0) else {
            return Ok(());
        };
        let ask = |(other, view): (usize, &mut ViewSearch)| -> Result<(), TrackError> {
            let Some(picture) = scene.pictures[other].as_ref().filter(|_| view.found.is_empty()) else { return Ok(()) };
            let pixels = points.map(|point| point.and_then(|point| scene.cameras[other].project(point)));
            match Crop::around(&pixels) {
                Some(crop) => {
                    let taken: Vec<_> = scene.taken.iter().map(|m| project_all(&scene.cameras[other], m)).collect();
                    view.try_crop(scene.net, scene.config, picture, crop, &taken, scene.nanos)
                }
                None => Ok(()),
            }
        };
        self.views.par_iter_mut().enumerate().map(ask).collect::<Result<Vec<()>, _>>()?;
        Ok(())
    }
}

impl ViewSearch {
    /// Runs the network on this view's foreground and its next crops.
    fn search(&mut self, scene: &SearchScene<'_>, slot: usize) -> Result<(), TrackError> {
        self.found.retain(|(_, nanos)| scene.nanos.saturating_sub(*nanos).abs() <= FORGET_NANOS);
        let Some(picture) = &scene.pictures[slot] else { return Ok(()) };
        let taken: Vec<_> = scene.taken.iter().map(|marks| project_all(&scene.cameras[slot], marks)).collect();
        let background = scene.backgrounds.get(slot).and_then(Option::as_ref);
        let light = background.and_then(|background| background.light(picture, &|_| true));
        let evidence = light.and_then(|light| light.evidence(picture, [0, 0, picture.width, picture.height]));
        let turn = quarter_turn(&scene.cameras[slot], scene.up);
        for crop in evidence.map(|evidence| foreground_crops(&evidence, &taken, turn)).unwrap_or_default() {
            self.try_crop(scene.net, scene.config, picture, crop, &taken, scene.nanos)?;
        }
        // Other views may see the same person at once; if they do not, the hypothesis may be wrong.
        let had_hope = std::mem::replace(&mut self.has_hope, !self.found.is_empty());
        if self.has_hope && !had_hope {
            return Ok(());
        }
        let crops = search_crops(picture.width as u32, picture.height as u32, turn);
        let most = if scene.config.search_crops == 0 { crops.len() } else { scene.config.search_crops };
        for _ in 0..most.min(crops.len()) {
            self.try_crop(scene.net, scene.config, picture, crops[self.next % crops.len()], &taken, scene.nanos)?;
            self.next += 1;
            if self.next >= crops.len() {
                (self.next, self.swept) = (0, true);
            }
        }
        Ok(())
    }

    /// Keeps the person whom the network finds in a crop, after two more runs on crops around the found landmarks.
    fn try_crop(
        &mut self,
        net: &PoseNet,
        config: &PoseConfig,
        picture: &Rgb,
        crop: Crop,
        taken: &[[Option<DVec2>; LANDMARK_COUNT]],
        nanos: i64,
    ) -> Result<(), TrackError> {
        let mut sighting = Sighting::infer(net, picture, crop)?;
        if sighting.output.presence < 0.5 * config.presence_threshold {
            return Ok(());
        }
        for _ in 0..2 {
            let Some(crop) = sighting.next_crop() else { break };
            sighting = Sighting::infer(net, picture, crop)?;
        }
        if sighting.output.presence < config.presence_threshold || taken.iter().any(|marks| sighting.shows(marks)) {
            return Ok(());
        }
        match self.found.iter_mut().find(|(other, _)| other.overlaps(&sighting)) {
            Some((other, _)) if other.score() >= sighting.score() => {}
            Some(other) => *other = (sighting, nanos),
            None => self.found.push((sighting, nanos)),
        }
        self.found.sort_by(|a, b| b.0.score().total_cmp(&a.0.score()));
        self.found.truncate(KEEP);
        Ok(())
    }
}

/// Returns all people whom the network finds in an image, best first.
pub(crate) fn sightings(net: &PoseNet, picture: &Rgb, config: &PoseConfig) -> Result<Vec<Sighting>, TrackError> {
    let mut view = ViewSearch::default();
    for crop in search_crops(picture.width as u32, picture.height as u32, DVec2::X) {
        view.try_crop(net, config, picture, crop, &[], 0)?;
    }
    Ok(view.found.into_iter().map(|(sighting, _)| sighting).collect())
}

/// Returns squares around the largest pieces of foreground, except those of people who are tracked already.
fn foreground_crops(evidence: &Grid, taken: &[[Option<DVec2>; LANDMARK_COUNT]], turn: DVec2) -> Vec<Crop> {
    let (width, height) = (evidence.width, evidence.height);
    // A vote among neighbours removes specks.
    let mut grid = evidence.box_mean(1);
    for pixels in taken {
        let (low, high) = pixels
            .iter()
            .flatten()
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), pixel| (low.min(*pixel), high.max(*pixel)));
        let margin = (BLOB_MARGIN - 1.0) * (high - low).max_element().max(0.0);
        let side = |value: f64, limit: usize| value.clamp(0.0, limit as f64) as usize;
        for y in side(low.y - margin, height)..side(high.y + margin, height) {
            let (from, to) = (side(low.x - margin, width), side(high.x + margin, width));
            if from < to {
                grid.values[y * width + from..y * width + to].fill(0.0);
            }
        }
    }
    let mut boxes: Vec<(usize, DVec2, DVec2)> = Vec::new();
    components(
        &grid,
        |value| value > 0.5,
        |pixels| {
            let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
            for &at in pixels {
                let pixel = DVec2::new((at % width) as f64, (at / width) as f64);
                (low, high) = (low.min(pixel), high.max(pixel));
            }
            if pixels.len() * 500 >= width * height {
                boxes.push((pixels.len(), low, high));
            }
        },
    );
    boxes.sort_by_key(|(area, ..)| std::cmp::Reverse(*area));
    boxes.truncate(BLOBS);
    boxes
        .into_iter()
        .map(|(_, low, high)| Crop {
            center: 0.5 * (low + high),
            side: BLOB_MARGIN * (high - low + 1.0).max_element(),
            turn,
        })
        .collect()
}

/// Returns the index of the chosen hypothesis of each view.
fn choose(scene: &SearchScene<'_>, found: &[Vec<Sighting>]) -> Vec<Option<usize>> {
    let (cameras, config) = (scene.cameras, scene.config);
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
        (agreeing + 0.5 * seen) / (1.0 + (distance_from(scene.center, &points) / NEAR_CENTER_M).powi(2))
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
    // No person in two views: the best single sighting, if any.
    let single = (0..found.len()).filter(|&slot| !found[slot].is_empty());
    let single = single.max_by(|&a, &b| found[a][0].score().total_cmp(&found[b][0].score()));
    let mut choice = vec![None; found.len()];
    if let Some(slot) = single {
        choice[slot] = Some(0);
    }
    choice
}

/// Returns the mean distance of a person's landmarks from a place, metres.
fn distance_from(center: DVec3, points: &[Option<WorldPoint>; LANDMARK_COUNT]) -> f64 {
    let (sum, count) =
        points.iter().flatten().fold((DVec3::ZERO, 0.0), |(sum, count), point| (sum + point.position, count + 1.0));
    (sum / f64::max(count, 1.0)).distance(center)
}

/// Whether the trunk is known and as long as a person's.
fn human_size(points: &[Option<WorldPoint>; LANDMARK_COUNT]) -> bool {
    let count = points.iter().flatten().count();
    let lengths: Vec<f64> = [(11, 23), (12, 24)]
        .iter()
        .filter_map(|&(a, b)| Some((points[a].as_ref()?.position - points[b].as_ref()?.position).length()))
        .collect();
    count >= 8 && !lengths.is_empty() && lengths.iter().all(|l| (0.2..0.9).contains(l))
}

/// Projects world points to pixels of a camera; `None` where they are out of its view.
pub(crate) fn project_all(camera: &Camera, points: &[DVec3; LANDMARK_COUNT]) -> [Option<DVec2>; LANDMARK_COUNT] {
    points.map(|point| camera.project(point))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::output::NetOutput;
    use crate::pose::body_model::BodyModel;
    use crate::testing::{body, keypoints_of, random_turns, ring};

    const SIDE: usize = 120;

    /// Two boxes of foreground.
    fn scene() -> Grid {
        let mut evidence = Grid::new(SIDE, SIDE, 0.1);
        for (x0, x1) in [(10, 30), (70, 100)] {
            for y in 20..100 {
                evidence.values[y * SIDE + x0..y * SIDE + x1].fill(0.9);
            }
        }
        evidence
    }

    #[test]
    fn foreground_is_tried_largest_first_and_without_people_who_are_known() {
        let crops = foreground_crops(&scene(), &[], DVec2::X);
        assert_eq!(crops.len(), 2);
        assert!(crops[0].center.distance(DVec2::new(84.5, 59.5)) < 1.5, "{:?}", crops[0]);
        assert!((80.0..115.0).contains(&crops[0].side), "{:?}", crops[0]);
        let mut known = [None; LANDMARK_COUNT];
        (known[0], known[31]) = (Some(DVec2::new(85.0, 22.0)), Some(DVec2::new(85.0, 98.0)));
        let crops = foreground_crops(&scene(), &[known], DVec2::X);
        assert_eq!(crops.len(), 1);
        assert!(crops[0].center.distance(DVec2::new(19.5, 59.5)) < 1.5, "{:?}", crops[0]);
    }

    /// Sightings of people at several places on the floor by a ring of cameras.
    fn seen_by(cameras: &[Camera], people: &[DVec3]) -> Vec<Vec<Sighting>> {
        let model = BodyModel::new(&body()).unwrap();
        let marks = model.marks(&random_turns(&model, 3));
        let sighting = |camera: &Camera, place: &DVec3| {
            let keypoints = keypoints_of(camera, &marks.map(|mark| mark + *place));
            let output = NetOutput { landmarks: [Default::default(); LANDMARK_COUNT], presence: 0.9, mask: None };
            let crop = Crop::around(&std::array::from_fn(|i| Some(keypoints[i].pixel)))?;
            Some(Sighting { crop, output, keypoints })
        };
        cameras.iter().map(|camera| people.iter().filter_map(|place| sighting(camera, place)).collect()).collect()
    }

    #[test]
    fn the_person_nearest_to_the_cameras_common_centre_is_chosen_even_if_smaller() {
        let rig = ring(3);
        let config = PoseConfig::default();
        let net = PoseNet::embedded().unwrap();
        let scene = SearchScene {
            net: &net,
            cameras: &rig.cameras,
            up: rig.world_up,
            pictures: &[],
            backgrounds: &[],
            nanos: 0,
            center: rig.center_of_attention(),
            taken: &[],
            config: &config,
        };
        // The second person is nearer to the first camera, so larger in its image.
        for (people, nearest) in
            [([DVec3::ZERO, DVec3::new(0.9, 0.9, 0.0)], 0), ([DVec3::new(0.9, 0.9, 0.0), DVec3::new(0.1, 0.0, 0.0)], 1)]
        {
            let choice = choose(&scene, &seen_by(&rig.cameras, &people));
            assert_eq!(choice, vec![Some(nearest); 3], "{people:?}");
        }
        let poisoned = SearchScene { center: DVec3::NAN, ..scene };
        assert_eq!(
            choose(&poisoned, &seen_by(&rig.cameras, &[DVec3::ZERO])).len(),
            3,
            "poison chooses any person or none"
        );
        assert!(choose(&poisoned, &[]).is_empty());
    }

    #[test]
    fn no_foreground_and_poisoned_people_give_no_crop_too_many() {
        assert!(foreground_crops(&Grid::new(SIDE, SIDE, 0.1), &[], DVec2::X).is_empty());
        assert!(foreground_crops(&Grid::new(SIDE, SIDE, f32::NAN), &[], DVec2::X).is_empty());
        assert!(foreground_crops(&Grid::new(0, 0, 0.0), &[], DVec2::X).is_empty());
        assert_eq!(foreground_crops(&scene(), &[[None; LANDMARK_COUNT]], DVec2::X).len(), 2);
        assert_eq!(foreground_crops(&scene(), &[[Some(DVec2::NAN); LANDMARK_COUNT]], DVec2::X).len(), 2);
    }
}
