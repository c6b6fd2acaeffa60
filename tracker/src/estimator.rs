//! The estimator: frame sets in, poses and masks out.

use std::sync::Arc;
use std::time::Instant;

use flyrig_body::{Template, skin_mesh};
use flyrig_solve::median;
use flyrig_types::{Frame, FrameSet, Image, Mask, Rig};
use glam::DVec3;
use rayon::prelude::*;

use crate::body_model::{BodyModel, Turns};
use crate::crop::Crop;
use crate::fit::{Before, FitProblem, FitView, align_trunk};
use crate::pixels::Rgb;
use crate::plate::plate_evidence;
use crate::search::{Sighting, project_all, search};
use crate::shape::{fit_template_shape, seen_landmarks};
use crate::silhouette::{BodyGate, refine};
use crate::single_view::lift;
use crate::triangulate::{WorldPoint, triangulate};
use crate::view::{View, observe};
use crate::{
    LANDMARK_COUNT, NoMask, PoseConfig, PoseEstimate, PoseNet, PoseQuality, ShapeFit, StageSeconds, TrackError,
    TrackErrorKind, ViewKeypoints, ViewQuality,
};

/// Usable landmarks in one view below which there is nobody to fit.
const MIN_LANDMARKS: usize = 8;
/// Residual in inlier distances above which a followed pose has come off the person.
const OFF_TRACK: f64 = 1.5;
/// Camera times farther from the set's than this are not believed, seconds.
const MAX_DELAY_SECS: f64 = 0.1;
/// Nobody's landmarks move faster, metres a second.
const MAX_SPEED: f64 = 12.0;
/// After a loss the whole picture is searched in every set, and ever more rarely up to every so many sets.
const RAREST_SEARCH: u32 = 8;

/// The person as last seen.
#[derive(Debug, Clone)]
struct Track {
    turns: Turns,
    nanos: i64,
    marks: [DVec3; LANDMARK_COUNT],
    velocity: [DVec3; LANDMARK_COUNT],
}

/// Tracks one person through the frame sets of a rig.
#[derive(Debug)]
pub struct PoseEstimator {
    net: PoseNet,
    template: Template,
    model: BodyModel,
    rig: Rig,
    config: PoseConfig,
    plates: Vec<Option<Vec<u8>>>,
    track: Option<Track>,
    /// Sets since the person was last seen.
    lost: u32,
}

/// A fitted pose before it is believed.
struct Fitted {
    turns: Turns,
    sightings: Vec<Option<Sighting>>,
    keypoints: Vec<Option<ViewKeypoints>>,
    points: [Option<WorldPoint>; LANDMARK_COUNT],
    views: Vec<ViewQuality>,
    residual_px: f64,
    /// Residual in inlier distances.
    relative: f64,
}

impl PoseEstimator {
    /// For one template (see [`Self::fit_shape`] for its size) and one rig.
    ///
    /// # Errors
    /// Kinds `Rig` and `Template` when either is not usable.
    pub fn new(net: PoseNet, template: &Template, rig: &Rig, config: PoseConfig) -> Result<Self, TrackError> {
        rig.validate().map_err(|error| TrackError::new(TrackErrorKind::Rig, error.to_string()))?;
        if rig.cameras.is_empty() {
            return Err(TrackError::new(TrackErrorKind::Rig, "the rig has no camera; tracking needs at least one"));
        }
        let model = BodyModel::new(template)?;
        let plates = vec![None; rig.cameras.len()];
        Ok(Self { net, template: template.clone(), model, rig: rig.clone(), config, plates, track: None, lost: 0 })
    }

    /// The template, with the person's bone lengths once [`Self::fit_shape`] has run.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Fits bone lengths to the person in a few frame sets (5 to 10, buffered at the start; the more the
    /// person moves in them the better), replaces the template by the fitted one and forgets the pose. The
    /// shape is final from then on: estimate the buffered sets again, in order, and go on.
    ///
    /// # Errors
    /// Kind `Lost` when too few of the sets show a person; the template stays as it was.
    pub fn fit_shape(&mut self, sets: &[FrameSet]) -> Result<ShapeFit, TrackError> {
        let mut keypoints = Vec::new();
        let mut last = None;
        for set in sets {
            let result = self.check(set).and_then(|pictures| self.follow_or_search(set, &pictures));
            match result {
                Ok(fitted) => {
                    if seen_landmarks(&fitted.keypoints, self.config.confidence_threshold) >= MIN_LANDMARKS {
                        keypoints.push(fitted.keypoints);
                    }
                    self.remember(set, fitted.turns);
                }
                Err(error) => last = Some(error),
            }
        }
        self.reset();
        let (template, fit) =
            fit_template_shape(&self.template, &self.rig, &keypoints, &self.config).map_err(|e| last.unwrap_or(e))?;
        self.model = BodyModel::new(&template)?;
        self.template = template;
        Ok(fit)
    }

    /// Gives a camera's empty picture; masks of that camera then heed the difference to it as well.
    ///
    /// # Errors
    /// Kind `Frames` when there is no such camera, `Image` when the size differs or the format cannot be read.
    pub fn set_plate(&mut self, slot: usize, plate: &Image) -> Result<(), TrackError> {
        let camera = self.rig.cameras.get(slot).ok_or_else(|| {
            TrackError::new(
                TrackErrorKind::Frames,
                format!("a plate for slot {slot} of a rig of {} cameras", self.rig.cameras.len()),
            )
        })?;
        check_size(camera, plate)?;
        self.plates[slot] = Some(Rgb::new(plate)?.bytes.into_owned());
        Ok(())
    }

    /// Looks for the person where a pose puts him at a time; false for a pose that does not fit the template.
    pub fn start_from(&mut self, pose: &flyrig_types::Pose, nanos: i64) -> bool {
        let Some(turns) = self.model.to_turns(pose) else { return false };
        let marks = self.model.marks(&turns);
        self.track = Some(Track { turns, nanos, marks, velocity: [DVec3::ZERO; LANDMARK_COUNT] });
        self.lost = 0;
        true
    }

    /// Forgets the last pose: the next set is searched from nothing.
    pub fn reset(&mut self) {
        self.track = None;
        self.lost = 0;
    }

    /// Pose, masks and quality of one frame set; sets come in the order of time.
    ///
    /// # Errors
    /// Kind `Lost` when no person was found: call again with the next set, the search goes on by itself.
    /// Kinds `Frames`, `Image` and `Net` when the input is not usable. The state stays sound in any case.
    pub fn estimate(&mut self, set: &FrameSet) -> Result<PoseEstimate, TrackError> {
        let pictures = self.check(set)?;
        let mut seconds = StageSeconds::default();
        let fitted = match self.follow_or_search_timed(set, &pictures, &mut seconds) {
            Ok(fitted) => fitted,
            Err(error) => {
                if error.kind == TrackErrorKind::Lost {
                    self.lost = self.lost.saturating_add(1);
                    if self.lost > self.config.forget_after {
                        self.track = None;
                    }
                }
                return Err(error);
            }
        };
        self.remember(set, fitted.turns.clone());
        let pose = self.model.to_pose(&fitted.turns);
        let start = Instant::now();
        let mut views = fitted.views;
        let mut masks: Vec<Option<Mask>> = vec![None; pictures.len()];
        if self.config.masks {
            let (vertices, _) = skin_mesh(&self.template, &pose);
            let made: Vec<Result<(Mask, f64), NoMask>> = pictures
                .par_iter()
                .enumerate()
                .map(|(slot, picture)| {
                    let picture = picture.as_ref().ok_or(NoMask::NoFrame)?;
                    let camera = &self.rig.cameras[slot];
                    let gate = BodyGate::new(camera, &vertices, &self.template.triangles).ok_or(NoMask::OutOfView)?;
                    let sighting = fitted.sightings[slot].as_ref();
                    let sighting = sighting.filter(|s| s.output.presence >= self.config.presence_threshold);
                    let sighting = sighting.ok_or(NoMask::NoPerson)?;
                    let evidence = self.plates[slot].as_ref().and_then(|plate| plate_evidence(picture, plate));
                    let mask = refine(picture, sighting, &gate, evidence.as_ref()).ok_or(NoMask::Empty)?;
                    let overlap = gate.overlap(&mask);
                    Ok((mask, overlap))
                })
                .collect();
            for ((mask, view), made) in masks.iter_mut().zip(&mut views).zip(made) {
                match made {
                    Ok((made, overlap)) => {
                        (*mask, view.mask_overlap, view.no_mask) = (Some(made), Some(overlap), None);
                    }
                    Err(reason) => view.no_mask = Some(reason),
                }
            }
        }
        seconds.masks = start.elapsed().as_secs_f64();
        let triangulated = fitted.points.iter().flatten().count();
        Ok(PoseEstimate {
            pose,
            masks,
            keypoints: fitted.keypoints,
            points: fitted.points.map(|point| point.map(|p| p.position)),
            quality: PoseQuality { views, residual_px: fitted.residual_px, triangulated, seconds },
        })
    }

    /// World positions of the landmarks on the template in a pose, metres; `None` for a pose that does not
    /// fit the template.
    #[must_use]
    pub fn landmarks(&self, pose: &flyrig_types::Pose) -> Option<[DVec3; LANDMARK_COUNT]> {
        self.model.to_turns(pose).map(|turns| self.model.marks(&turns))
    }

    fn check<'a>(&self, set: &'a FrameSet) -> Result<Vec<Option<Rgb<'a>>>, TrackError> {
        let frames_error = |message: String| TrackError::new(TrackErrorKind::Frames, message);
        if set.frames.len() != self.rig.cameras.len() {
            return Err(frames_error(format!(
                "a frame set of {} slots for a rig of {} cameras",
                set.frames.len(),
                self.rig.cameras.len()
            )));
        }
        if set.present().next().is_none() {
            return Err(frames_error(format!("frame set {} holds no frame at all", set.index)));
        }
        let read = |(frame, camera): (&'a Option<Arc<Frame>>, _)| {
            frame
                .as_ref()
                .map(|frame| {
                    check_size(camera, &frame.image)?;
                    Rgb::new(&frame.image)
                })
                .transpose()
        };
        set.frames.iter().zip(&self.rig.cameras).map(read).collect()
    }

    fn follow_or_search(&self, set: &FrameSet, pictures: &[Option<Rgb<'_>>]) -> Result<Fitted, TrackError> {
        self.follow_or_search_timed(set, pictures, &mut StageSeconds::default())
    }

    /// Follows the person from the last pose; searches the whole pictures where that fails.
    fn follow_or_search_timed(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        seconds: &mut StageSeconds,
    ) -> Result<Fitted, TrackError> {
        if let Some(track) = &self.track
            && let Some(fitted) = self.follow(set, pictures, track, seconds)?
        {
            return Ok(fitted);
        }
        let rhythm = (self.lost / 4).clamp(1, RAREST_SEARCH);
        if !self.lost.is_multiple_of(rhythm) {
            return Err(TrackError::lost(format!("frame set {}: nobody here; the next search is soon", set.index)));
        }
        let start = Instant::now();
        let sightings = search(&self.net, &self.rig.cameras, pictures, &self.config)?;
        seconds.net += start.elapsed().as_secs_f64();
        let first = self.fit(set, sightings, None, seconds)?;
        // Look again through crops around the fitted body: turned upright, and in the views that chose nobody.
        let marks = self.model.marks(&first.turns);
        let start = Track {
            turns: first.turns.clone(),
            nanos: set.master_nanos,
            marks,
            velocity: [DVec3::ZERO; LANDMARK_COUNT],
        };
        match self.follow(set, pictures, &start, seconds)? {
            Some(second) if second.relative <= first.relative * 1.5 => Ok(second),
            _ => Ok(first),
        }
    }

    /// One look through crops around the predicted body; `None` when the person is not there any more.
    fn follow(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        track: &Track,
        seconds: &mut StageSeconds,
    ) -> Result<Option<Fitted>, TrackError> {
        let start = Instant::now();
        let ahead = secs(set.master_nanos.saturating_sub(track.nanos)).clamp(0.0, MAX_DELAY_SECS);
        let predicted: [DVec3; LANDMARK_COUNT] = std::array::from_fn(|i| track.marks[i] + track.velocity[i] * ahead);
        let sightings: Vec<Option<Sighting>> = pictures
            .par_iter()
            .zip(&self.rig.cameras)
            .map(|(picture, camera)| {
                let Some(picture) = picture else { return Ok(None) };
                let Some(crop) = Crop::around(&project_all(camera, &predicted)) else { return Ok(None) };
                Sighting::take(&self.net, picture, crop).map(Some)
            })
            .collect::<Result<_, TrackError>>()?;
        seconds.net += start.elapsed().as_secs_f64();
        match self.fit(set, sightings, Some(track), seconds) {
            Ok(fitted) if fitted.relative < OFF_TRACK => Ok(Some(fitted)),
            Ok(_) => Ok(None),
            Err(error) if error.kind == TrackErrorKind::Lost => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn fit(
        &self,
        set: &FrameSet,
        sightings: Vec<Option<Sighting>>,
        track: Option<&Track>,
        seconds: &mut StageSeconds,
    ) -> Result<Fitted, TrackError> {
        let config = &self.config;
        let lost = |what: &str| TrackError::lost(format!("frame set {}: {what}", set.index));
        let keypoints: Vec<Option<ViewKeypoints>> = sightings
            .iter()
            .map(|s| s.as_ref().filter(|s| s.output.presence >= config.presence_threshold).map(|s| s.keypoints))
            .collect();
        let start = Instant::now();
        let points = triangulate(&self.rig.cameras, &keypoints, config.confidence_threshold, config.inlier_m);
        seconds.triangulate += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let mut views = Vec::new();
        for (slot, keypoints) in keypoints.iter().enumerate() {
            let (Some(keypoints), camera) = (keypoints, &self.rig.cameras[slot]) else { continue };
            let view = View::new(camera);
            let seen = observe(camera, &view, keypoints, config.confidence_threshold);
            let nanos = set.frames[slot].as_ref().map_or(set.master_nanos, |frame| frame.capture_nanos);
            let delay_secs = secs(nanos.saturating_sub(set.master_nanos)).clamp(-MAX_DELAY_SECS, MAX_DELAY_SECS);
            views.push(FitView { view, seen, delay_secs });
        }
        let most = views.iter().map(|v| v.seen.iter().flatten().count()).max().unwrap_or(0);
        if most < MIN_LANDMARKS {
            return Err(lost("no view shows enough of a person"));
        }
        let mut problem = FitProblem {
            model: &self.model,
            views: &views,
            points: [None; LANDMARK_COUNT],
            velocity: [DVec3::ZERO; LANDMARK_COUNT],
            before: None,
            sigma_m: config.sigma_m,
            robust: 2.0,
        };
        // One view alone says nothing of depth: the network's own guess at the third dimension stands in.
        let triangulated = points.iter().flatten().count();
        let mut world = points.each_ref().map(|point| point.as_ref().map(|p| p.position));
        if triangulated < MIN_LANDMARKS {
            let seen = keypoints.iter().zip(&sightings).zip(&self.rig.cameras);
            let surest = seen
                .filter_map(|((k, s), camera)| k.as_ref().and(s.as_ref()).map(|s| (s, camera)))
                .max_by(|a, b| a.0.output.presence.total_cmp(&b.0.output.presence));
            let scale = self.model.trunk_length() / 0.5;
            let lifted = surest.and_then(|(s, camera)| lift(camera, s, config.confidence_threshold, scale));
            if let Some(lifted) = lifted {
                world = lifted;
                problem.points = lifted.map(|point| point.map(|p| (p, 0.1)));
            }
        }
        let turns = match track {
            Some(track) => {
                problem.velocity = track.velocity;
                let dt = secs(set.master_nanos.saturating_sub(track.nanos));
                let sigma_rad = config.smooth_rad * (dt * 30.0).clamp(0.1, 30.0).sqrt();
                problem.before = Some(Before { turns: track.turns.clone(), sigma_rad });
                problem.solve(&track.turns, config.max_steps)
            }
            None => {
                let aligned = align_trunk(&self.model, &world)
                    .ok_or_else(|| lost("the views do not agree on a person's trunk"))?;
                // World points first: their cost has no far minima behind the cameras.
                let near = FitProblem {
                    points: world.map(|point| point.map(|p| (p, 0.03))),
                    views: &[],
                    robust: 6.0,
                    ..problem.clone()
                };
                let near = near.solve(&aligned, 40).map_or(aligned, |(turns, _)| turns);
                problem.solve(&near, 40)
            }
        };
        seconds.fit += start.elapsed().as_secs_f64();
        let (turns, _) = turns.filter(|(turns, _)| finite(turns)).ok_or_else(|| lost("the fit has no finite cost"))?;
        self.judge(turns, sightings, keypoints, points, &problem).ok_or_else(|| lost("no landmark agrees with the fit"))
    }

    /// Distances of the landmarks from the fitted body.
    fn judge(
        &self,
        turns: Turns,
        sightings: Vec<Option<Sighting>>,
        keypoints: Vec<Option<ViewKeypoints>>,
        points: [Option<WorldPoint>; LANDMARK_COUNT],
        problem: &FitProblem<'_>,
    ) -> Option<Fitted> {
        let marks = self.model.marks(&turns);
        let mut all = Vec::new();
        let mut all_relative = Vec::new();
        let mut used = problem.views.iter();
        let mut views = Vec::with_capacity(keypoints.len());
        for (slot, camera) in self.rig.cameras.iter().enumerate() {
            let presence = sightings[slot].as_ref().map_or(0.0, |s| s.output.presence);
            let mut distances = Vec::new();
            let mut inliers = 0;
            let fit_view = keypoints[slot].and_then(|_| used.next());
            if let (Some(keypoints), Some(fit_view)) = (&keypoints[slot], fit_view) {
                for (i, keypoint) in keypoints.iter().enumerate() {
                    let moved = marks[i] + problem.velocity[i] * fit_view.delay_secs;
                    let (Some(pixel), Some(px_per_m)) = (camera.project(moved), fit_view.view.px_per_m(marks[i]))
                    else {
                        continue;
                    };
                    if fit_view.seen[i].is_none() {
                        continue;
                    }
                    let distance = (pixel - keypoint.pixel).length();
                    let relative = distance / (px_per_m * self.config.inlier_m);
                    distances.push(distance);
                    all.push(distance);
                    all_relative.push(relative);
                    inliers += usize::from(relative < 1.0);
                }
            }
            let no_mask = Some(if self.config.masks { NoMask::NoFrame } else { NoMask::Off });
            views.push(ViewQuality {
                presence,
                inliers,
                residual_px: median(&mut distances),
                mask_overlap: None,
                no_mask,
            });
        }
        let residual_px = median(&mut all)?;
        let relative = median(&mut all_relative)?;
        (residual_px.is_finite() && relative.is_finite()).then_some(Fitted {
            turns,
            sightings,
            keypoints,
            points,
            views,
            residual_px,
            relative,
        })
    }

    fn remember(&mut self, set: &FrameSet, turns: Turns) {
        let marks = self.model.marks(&turns);
        let mut velocity = [DVec3::ZERO; LANDMARK_COUNT];
        if let Some(last) = &self.track {
            let dt = secs(set.master_nanos.saturating_sub(last.nanos));
            if (1e-3..0.2).contains(&dt) {
                for (i, v) in velocity.iter_mut().enumerate() {
                    let now = ((marks[i] - last.marks[i]) / dt).clamp_length_max(MAX_SPEED);
                    *v = 0.5 * (last.velocity[i] + now);
                }
            }
        }
        self.track = Some(Track { turns, nanos: set.master_nanos, marks, velocity });
        self.lost = 0;
    }
}

fn check_size(camera: &flyrig_types::Camera, image: &Image) -> Result<(), TrackError> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    if (image.width(), image.height()) == (width, height) {
        return Ok(());
    }
    Err(TrackError::new(
        TrackErrorKind::Image,
        format!(
            "camera {}: the picture is {}x{} but its calibration is for {width}x{height}",
            camera.id,
            image.width(),
            image.height()
        ),
    ))
}

fn finite(turns: &Turns) -> bool {
    turns.root.is_finite() && turns.turns.iter().all(|q| q.is_finite())
}

fn secs(nanos: i64) -> f64 {
    nanos as f64 * 1e-9
}
