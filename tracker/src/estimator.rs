//! The estimator: frame sets in, poses and masks out.

use std::sync::Arc;
use std::time::Instant;

use flyrig_body::{Template, skin_mesh};
use flyrig_solve::median;
use flyrig_types::{Frame, FrameSet, Image, Mask, Rig};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::background::Background;
use crate::body_model::{BodyModel, Turns};
use crate::body_shape::ShapeSpace;
use crate::crop::Crop;
use crate::fit::{Before, FitProblem, FitView, align_trunk};
use crate::looks::{Look, LookBody, carried_mask, corners, due};
use crate::outline::{OutlinePoint, SeenBody};
use crate::pixels::Rgb;
use crate::plate::gated_mask;
use crate::search::{Search, SearchScene, Sighting, project_all};
use crate::shape::{fit_template_shape, seen_landmarks, template_of_height};
use crate::shape_solve::{ShapeAndPoses, ShapeProblem, ShapeSet};
use crate::silhouette::{BodyGate, coarse_mask, refine};
use crate::single_view::lift;
use crate::triangulate::{WorldPoint, triangulate};
use crate::view::{Observation, View, observe};
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
/// Cameras that expose nearer to the set's time see the body where it is then, seconds.
const MIN_DELAY_SECS: f64 = 5e-4;
/// Farthest that the outline of a body near its place lies from the mask's, metres.
const OUTLINE_REACH_M: f64 = 0.05;
/// Steps of the solver in each round of matching.
const OUTLINE_STEPS: usize = 4;
/// After a loss the whole picture is searched in every set, and ever more rarely up to every so many sets.
const RAREST_SEARCH: u32 = 8;

/// Landmarks in the world, metres.
pub type Marks = [DVec3; LANDMARK_COUNT];

/// The person as last seen.
#[derive(Debug, Clone)]
struct Track {
    turns: Turns,
    nanos: i64,
    marks: [DVec3; LANDMARK_COUNT],
    velocity: [DVec3; LANDMARK_COUNT],
    /// By slot.
    looks: Vec<Option<Look>>,
}

impl Track {
    /// Landmarks at a time a little later.
    fn predicted(&self, nanos: i64) -> [DVec3; LANDMARK_COUNT] {
        let ahead = secs(nanos.saturating_sub(self.nanos)).clamp(0.0, MAX_DELAY_SECS);
        std::array::from_fn(|i| self.marks[i] + self.velocity[i] * ahead)
    }
}

/// Tracks one person through the frame sets of a rig.
#[derive(Debug, Clone)]
pub struct PoseEstimator {
    net: PoseNet,
    /// As it was given.
    base: Template,
    /// In the person's shape.
    template: Template,
    model: BodyModel,
    rig: Rig,
    config: PoseConfig,
    backgrounds: Vec<Option<Background>>,
    track: Option<Track>,
    search: Search,
    /// Sets since the person was last seen.
    lost: u32,
    /// Whether the network looks at every view of every set.
    looks_at_all: bool,
}

/// A fitted pose before it is believed.
struct Fitted {
    turns: Turns,
    looks: Vec<Option<Look>>,
    keypoints: Vec<Option<ViewKeypoints>>,
    points: [Option<WorldPoint>; LANDMARK_COUNT],
    views: Vec<ViewQuality>,
    residual_px: f64,
    /// Residual in inlier distances.
    relative: f64,
    evidence: Evidence,
}

/// The measurements behind a fitted pose.
#[derive(Debug, Clone)]
struct Evidence {
    /// An element a frame.
    views: Vec<FitView>,
    points: [Option<(DVec3, f64)>; LANDMARK_COUNT],
    before: Option<Before>,
}

impl Fitted {
    /// Time of a slot's frame less the set's, seconds.
    fn delay_secs(&self, slot: usize) -> f64 {
        self.evidence.views.iter().find(|view| view.slot == slot).map_or(0.0, |view| view.delay_secs)
    }
}

impl Evidence {
    fn problem<'a>(&'a self, model: &'a BodyModel, config: &PoseConfig) -> FitProblem<'a> {
        FitProblem {
            model,
            views: &self.views,
            outline: &[],
            outline_sigma_m: config.outline_sigma_m,
            points: self.points,
            before: self.before.clone(),
            landmark_spread: config.landmark_spread,
            robust: 2.0,
        }
    }
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
        let backgrounds = vec![None; rig.cameras.len()];
        Ok(Self {
            net,
            base: template.clone(),
            template: template.clone(),
            model,
            rig: rig.clone(),
            config,
            backgrounds,
            track: None,
            search: Search::default(),
            lost: 0,
            looks_at_all: false,
        })
    }

    /// Lets the network look at every view of every set, whether the body moves or not: for [`Self::fit_shape_to_keypoints`].
    pub fn look_at_all(&mut self, always: bool) {
        self.looks_at_all = always;
    }

    /// The template, with the person's bone lengths once [`Self::fit_shape`] has run.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Fits bone lengths to the person in a few frame sets (5 to 10, buffered at the start; the more the person moves in them the
    /// better) and replaces the template by the fitted one. Estimate the buffered sets again then, in order, and go on. Nobody of
    /// `others`, landmarks by person and set, is taken for the person. Returns the person's own landmarks by set as well.
    ///
    /// # Errors
    /// Kind `Lost` when too few of the sets show a person; the template stays as it was.
    pub fn fit_shape(
        &mut self,
        sets: &[FrameSet],
        others: &[Vec<Option<Marks>>],
    ) -> Result<(ShapeFit, Vec<Option<Marks>>), TrackError> {
        let mut keypoints = Vec::new();
        let (mut first, mut last) = (None, None);
        let mut places = Vec::new();
        for (index, set) in sets.iter().enumerate() {
            let others: Vec<Marks> = others.iter().filter_map(|marks| *marks.get(index)?).collect();
            let found = self.find_at_once(set, &others);
            places.push(found.as_ref().ok().map(|fitted| self.model.marks(&fitted.turns)));
            match found {
                Ok(fitted) => {
                    keypoints.push(fitted.keypoints);
                    first.get_or_insert_with(|| (fitted.turns.clone(), set.master_nanos));
                    self.remember(set, fitted.turns, fitted.looks);
                }
                Err(error) => last = Some(error),
            }
        }
        self.reset();
        let mut fit = match (first.is_some(), last) {
            (false, Some(error)) => return Err(error),
            _ => self.fit_shape_to_keypoints(&keypoints)?,
        };
        if self.config.shape_rounds > 0 && self.rig.cameras.len() > 1 {
            self.fit_shape_to_outlines(sets, &mut fit)?;
        }
        self.reset();
        if let Some((turns, nanos)) = first {
            self.start_at(turns, nanos);
        }
        Ok((fit, places))
    }

    /// Fits bone lengths to the landmarks of a person in a few sets, by set and slot, and goes on tracking with them. Before a
    /// single camera, which cannot measure anything, the height is the configuration's or an average one.
    ///
    /// # Errors
    /// Kind `Lost` when too few of the sets show a person in two views; the template stays as it was.
    pub fn fit_shape_to_keypoints(&mut self, keypoints: &[Vec<Option<ViewKeypoints>>]) -> Result<ShapeFit, TrackError> {
        let (template, fit) = if self.rig.cameras.len() == 1 {
            template_of_height(&self.base, self.config.height_m)?
        } else {
            let seen = |views: &&Vec<_>| seen_landmarks(views, self.config.confidence_threshold) >= MIN_LANDMARKS;
            let keypoints: Vec<Vec<_>> = keypoints.iter().filter(seen).cloned().collect();
            fit_template_shape(&self.base, &self.rig, &keypoints, &self.config)?
        };
        self.model = BodyModel::new(&template)?;
        self.template = template;
        if let Some(track) = self.track.take() {
            self.start_at(track.turns, track.nanos);
        }
        Ok(fit)
    }

    /// Follows the person, or searches whole pictures: nobody waits for the set.
    fn find_at_once(&mut self, set: &FrameSet, others: &[Marks]) -> Result<Fitted, TrackError> {
        let pictures = self.check(set)?;
        let given = (self.config.search_crops, self.looks_at_all);
        (self.config.search_crops, self.looks_at_all) = (0, true);
        let found = self.follow_or_search(set, &pictures, others, true, &mut StageSeconds::default());
        (self.config.search_crops, self.looks_at_all) = given;
        found
    }

    /// Solves for shape and poses of all sets together, from landmarks and the outlines of masks.
    fn fit_shape_to_outlines(&mut self, sets: &[FrameSet], fit: &mut ShapeFit) -> Result<(), TrackError> {
        let mut found = Vec::new();
        for set in sets {
            let Ok(mut fitted) = self.find_at_once(set, &[]) else { continue };
            let pictures = self.check(set)?;
            let masks = self.masks(set, &pictures, &mut fitted);
            fitted.evidence.before = None;
            self.remember(set, fitted.turns.clone(), fitted.looks.clone());
            found.push((set, fitted, masks));
        }
        let space = ShapeSpace::new(&self.base);
        let mut shape: Vec<f64> =
            space.prior().iter().map(|(name, mean, _)| fit.factor(name).unwrap_or(*mean)).collect();
        for _ in 0..self.config.shape_rounds {
            let given = |set: &FrameSet, masks: &[Option<Mask>], slot: usize| -> Option<Mask> {
                let own = masks.get(slot).cloned().flatten();
                own.or_else(|| set.frames.get(slot)?.as_ref()?.mask.clone().filter(|_| !self.config.masks))
            };
            let problems: Vec<ShapeSet<'_>> = found
                .iter()
                .map(|(set, fitted, masks)| {
                    let masks: Vec<Option<Mask>> = (0..masks.len()).map(|slot| given(set, masks, slot)).collect();
                    let masks: Vec<Option<&Mask>> = masks.iter().map(Option::as_ref).collect();
                    let outline = self.outline_points(set, fitted, &fitted.turns, &masks, 2.0 * OUTLINE_REACH_M);
                    ShapeSet { problem: fitted.evidence.problem(&self.model, &self.config), outline }
                })
                .collect();
            let start =
                ShapeAndPoses { shape: shape.clone(), poses: found.iter().map(|(_, f, _)| f.turns.clone()).collect() };
            let Some((solved, sigma)) = (ShapeProblem { space: &space, sets: &problems }).solve(&start) else { break };
            drop(problems);
            for ((_, fitted, _), pose) in found.iter_mut().zip(solved.poses) {
                fitted.turns = pose;
            }
            shape = solved.shape;
            self.template = space.template(&shape)?;
            self.model = BodyModel::new(&self.template)?;
            fit.set(&space, &shape, &sigma, &self.template);
        }
        tracing::info!(?fit, "fitted the body to landmarks and outlines");
        Ok(())
    }

    /// Takes a template of the person's shape instead, and forgets the pose.
    ///
    /// # Errors
    /// Kind `Template` when it is not usable.
    pub fn set_template(&mut self, template: &Template) -> Result<(), TrackError> {
        self.model = BodyModel::new(template)?;
        (self.base, self.template) = (template.clone(), template.clone());
        self.reset();
        Ok(())
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
        self.backgrounds[slot] = Some(Background::from_plate(camera, plate)?);
        Ok(())
    }

    /// Sets the backgrounds by slot, one a camera; masks then use the difference to them. Fewer leave the last cameras as
    /// they are.
    pub fn set_backgrounds(&mut self, backgrounds: Vec<Option<Background>>) {
        self.backgrounds.iter_mut().zip(backgrounds).for_each(|(own, new)| *own = new);
    }

    /// Returns a camera's background to update it.
    pub fn background_mut(&mut self, slot: usize) -> Option<&mut Background> {
        self.backgrounds.get_mut(slot)?.as_mut()
    }

    /// Returns a camera's background, where it is known.
    #[must_use]
    pub fn background(&self, slot: usize) -> Option<&Background> {
        self.backgrounds.get(slot)?.as_ref()
    }

    /// Looks for the person where a pose puts him at a time; false for a pose that does not fit the template.
    pub fn start_from(&mut self, pose: &flyrig_types::Pose, nanos: i64) -> bool {
        let Some(turns) = self.model.to_turns(pose) else { return false };
        self.start_at(turns, nanos);
        true
    }

    fn start_at(&mut self, turns: Turns, nanos: i64) {
        let marks = self.model.marks(&turns);
        self.track = Some(Track {
            turns,
            nanos,
            marks,
            velocity: [DVec3::ZERO; LANDMARK_COUNT],
            looks: vec![None; self.rig.cameras.len()],
        });
        self.lost = 0;
    }

    /// Forgets the last pose: the next set is searched from nothing.
    pub fn reset(&mut self) {
        self.track = None;
        self.lost = 0;
    }

    /// Returns pose, masks and quality of one frame set; sets come in the order of time.
    ///
    /// # Errors
    /// Kind `Lost` when no person was found: call again with the next set, the search goes on by itself.
    /// Kinds `Frames`, `Image` and `Net` when the input is not usable. The state stays sound in any case.
    pub fn estimate(&mut self, set: &FrameSet) -> Result<PoseEstimate, TrackError> {
        self.estimate_among(set, &[], true)
    }

    /// As [`Self::estimate`], beside people whose landmarks are known in the world: a sighting of one of them is nobody else.
    /// Without `may_search` a person who cannot be followed is lost in this set.
    ///
    /// # Errors
    /// Those of [`Self::estimate`].
    pub fn estimate_among(
        &mut self,
        set: &FrameSet,
        others: &[Marks],
        may_search: bool,
    ) -> Result<PoseEstimate, TrackError> {
        let pictures = self.check(set)?;
        let mut seconds = StageSeconds::default();
        let fitted = match self.follow_or_search(set, &pictures, others, may_search, &mut seconds) {
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
        self.finish(set, &pictures, fitted, seconds)
    }

    /// Masks, the fit to their outlines, and the estimate.
    fn finish(
        &mut self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        mut fitted: Fitted,
        mut seconds: StageSeconds,
    ) -> Result<PoseEstimate, TrackError> {
        let start = Instant::now();
        let mut masks = self.masks(set, pictures, &mut fitted);
        seconds.masks = start.elapsed().as_secs_f64();
        if self.config.outline_rounds > 0 {
            let start = Instant::now();
            let given: Vec<Option<&Mask>> = if self.config.masks {
                masks.iter().map(Option::as_ref).collect()
            } else {
                set.frames.iter().map(|frame| frame.as_ref().and_then(|frame| frame.mask.as_ref())).collect()
            };
            fitted.turns = self.fit_outline(set, &fitted, &given);
            seconds.outline = start.elapsed().as_secs_f64();
        }
        if !self.config.masks {
            masks.fill(None);
        }
        let looked = fitted.looks.iter().flatten().filter(|look| look.body.is_none()).count();
        self.remember(set, fitted.turns.clone(), fitted.looks);
        let pose = self.model.to_pose(&fitted.turns);
        let views = fitted.views;
        let triangulated = fitted.points.iter().flatten().count();
        Ok(PoseEstimate {
            pose,
            masks,
            keypoints: fitted.keypoints,
            points: fitted.points.map(|point| point.map(|p| p.position)),
            quality: PoseQuality { views, residual_px: fitted.residual_px, triangulated, looked, seconds },
        })
    }

    /// Landmarks of the person at a time, as they have moved of late; `None` while nobody is tracked.
    #[must_use]
    pub fn predicted_landmarks(&self, nanos: i64) -> Option<Marks> {
        self.track.as_ref().map(|track| track.predicted(nanos))
    }

    /// Frame sets since the person was seen last; 0 for one who is tracked.
    #[must_use]
    pub fn sets_lost(&self) -> u32 {
        if self.track.is_some() { self.lost } else { self.lost.max(1) }
    }

    /// Gives up what is being tracked: it turned out to be somebody else. The search begins anew.
    pub fn drop_track(&mut self) {
        self.track = None;
        self.lost = self.lost.max(1);
    }

    /// Lets this estimator follow whom another one follows, from the next set on; the other one has lost the person then.
    pub fn take_track(&mut self, other: &mut Self) {
        self.track = other.track.take();
        self.lost = 0;
        other.lost = 1;
    }

    /// Vertices and normals of a pose at a time after it, as the body has moved since the last set.
    fn skinned(&self, turns: &Turns, set: &FrameSet, delay_secs: f64) -> (Vec<Vec3>, Vec<Vec3>) {
        let moved = self.track.as_ref().filter(|_| delay_secs.abs() > MIN_DELAY_SECS).and_then(|track| {
            let since = secs(set.master_nanos.saturating_sub(track.nanos));
            (since > 1e-3).then(|| turns.advanced(&track.turns, (delay_secs / since).clamp(-1.0, 1.0)))
        });
        skin_mesh(&self.template, &self.model.to_pose(moved.as_ref().unwrap_or(turns)))
    }

    /// Masks by slot; why there is none goes into the views' quality.
    fn masks(&self, set: &FrameSet, pictures: &[Option<Rgb<'_>>], fitted: &mut Fitted) -> Vec<Option<Mask>> {
        if !self.config.masks {
            return vec![None; pictures.len()];
        }
        let made: Vec<Result<(Mask, f64), NoMask>> = pictures
            .par_iter()
            .enumerate()
            .map(|(slot, picture)| {
                let picture = picture.as_ref().ok_or(NoMask::NoFrame)?;
                let camera = &self.rig.cameras[slot];
                let (vertices, _) = self.skinned(&fitted.turns, set, fitted.delay_secs(slot));
                let gate = BodyGate::new(camera, &vertices, &self.template.triangles).ok_or(NoMask::OutOfView)?;
                let look = fitted.looks[slot].as_ref();
                let look = look.filter(|l| l.sighting.output.presence >= self.config.presence_threshold);
                let evidence =
                    self.background(slot).and_then(|known| known.evidence(picture, &|at| !gate.reaches_pixel(at)));
                let mask = match (look, &evidence) {
                    (Some(look), evidence) => {
                        let coarse = match &look.body {
                            None => coarse_mask(&look.sighting, gate.bounds),
                            Some(body) => {
                                let (then, _) = self.skinned(&body.turns, set, fitted.delay_secs(slot));
                                let (then, now) = (corners(camera, &then), corners(camera, &vertices));
                                carried_mask(&look.sighting, &then, &now, gate.bounds)
                            }
                        };
                        refine(picture, &coarse, look.sighting.crop.scale(), &gate, evidence.as_ref())
                    }
                    // The network sees nobody here, but the other cameras place the body in this picture.
                    (None, Some(evidence)) => gated_mask(evidence, &gate),
                    (None, None) => return Err(NoMask::NoPerson),
                };
                let mask = mask.ok_or(NoMask::Empty)?;
                let overlap = gate.overlap(&mask);
                Ok((mask, overlap))
            })
            .collect();
        let mut masks = Vec::with_capacity(made.len());
        for (view, made) in fitted.views.iter_mut().zip(made) {
            masks.push(match made {
                Ok((made, overlap)) => {
                    (view.mask_overlap, view.no_mask) = (Some(overlap), None);
                    Some(made)
                }
                Err(reason) => {
                    view.no_mask = Some(reason);
                    None
                }
            });
        }
        masks
    }

    /// Moves a pose so that the body's outline lies on that of the masks.
    fn fit_outline(&self, set: &FrameSet, fitted: &Fitted, masks: &[Option<&Mask>]) -> Turns {
        let mut turns = fitted.turns.clone();
        for round in 0..self.config.outline_rounds {
            // Far first, then only what is near.
            let widen = if round + 1 < self.config.outline_rounds { 2.0 } else { 1.0 };
            let points = self.outline_points(set, fitted, &turns, masks, widen * OUTLINE_REACH_M);
            if points.is_empty() {
                break;
            }
            let mut problem = fitted.evidence.problem(&self.model, &self.config);
            problem.outline = &points;
            problem.outline_sigma_m *= widen;
            let Some((better, _)) = problem.solve(&turns, OUTLINE_STEPS).filter(|(turns, _)| finite(turns)) else {
                break;
            };
            turns = better;
        }
        turns
    }

    /// The outline of the body in a pose, matched with the masks of all views.
    fn outline_points(
        &self,
        set: &FrameSet,
        fitted: &Fitted,
        turns: &Turns,
        masks: &[Option<&Mask>],
        reach_m: f64,
    ) -> Vec<OutlinePoint> {
        let now = self.skinned(turns, set, 0.0);
        let of_view = |(index, view): (usize, &FitView)| {
            let Some(mask) = masks.get(view.slot).copied().flatten() else { return Vec::new() };
            let own = (view.delay_secs.abs() > MIN_DELAY_SECS).then(|| self.skinned(turns, set, view.delay_secs));
            let (vertices, normals) = own.as_ref().unwrap_or(&now);
            let seen = SeenBody {
                camera: &self.rig.cameras[view.slot],
                view: &view.view,
                template: &self.template,
                model: &self.model,
                vertices,
                normals,
            };
            let mut points = seen.match_mask(mask, index, reach_m);
            for point in &mut points {
                point.shift = (vertices[point.vertex] - now.0[point.vertex]).as_dvec3();
            }
            points
        };
        fitted.evidence.views.par_iter().enumerate().flat_map_iter(of_view).collect()
    }

    /// World positions of the landmarks on the template in a pose, metres; `None` for a pose that does not
    /// fit the template.
    #[must_use]
    pub fn landmarks(&self, pose: &flyrig_types::Pose) -> Option<Marks> {
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

    /// Follows the person from the last pose; searches the pictures where that fails.
    fn follow_or_search(
        &mut self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        others: &[Marks],
        may_search: bool,
        seconds: &mut StageSeconds,
    ) -> Result<Fitted, TrackError> {
        if let Some(track) = &self.track
            && let Some(fitted) = self.follow(set, pictures, track, others, seconds)?
        {
            self.search = Search::default();
            return Ok(fitted);
        }
        let rhythm = (self.lost / 4).clamp(1, RAREST_SEARCH);
        if !may_search || !self.lost.is_multiple_of(rhythm) {
            return Err(TrackError::lost(format!("frame set {}: nobody here; the next search is soon", set.index)));
        }
        let start = Instant::now();
        let scene = SearchScene {
            net: &self.net,
            cameras: &self.rig.cameras,
            pictures,
            backgrounds: &self.backgrounds,
            nanos: set.master_nanos,
            taken: others,
            config: &self.config,
        };
        let sightings = self.search.step(&scene)?;
        let looks: Vec<Option<Look>> = sightings.into_iter().map(|sighting| sighting.map(Look::fresh)).collect();
        seconds.search += start.elapsed().as_secs_f64();
        if looks.iter().all(Option::is_none) {
            return Err(TrackError::lost(format!("frame set {}: nobody found yet; the search goes on", set.index)));
        }
        let first = self.fit(set, looks, None, seconds)?;
        // Look again through crops around the fitted body: turned upright, and in the views that chose nobody.
        let marks = self.model.marks(&first.turns);
        let start = Track {
            turns: first.turns.clone(),
            nanos: set.master_nanos,
            marks,
            velocity: [DVec3::ZERO; LANDMARK_COUNT],
            looks: vec![None; self.rig.cameras.len()],
        };
        match self.follow(set, pictures, &start, others, seconds)? {
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
        others: &[Marks],
        seconds: &mut StageSeconds,
    ) -> Result<Option<Fitted>, TrackError> {
        let start = Instant::now();
        let predicted = track.predicted(set.master_nanos);
        let look_after_m = if self.looks_at_all { 0.0 } else { self.config.look_after_m };
        let has_picture = |slot: usize| pictures.get(slot).is_some_and(Option::is_some);
        let due = due(&track.looks, has_picture, &predicted, set.master_nanos, look_after_m);
        let looks: Vec<Option<Look>> = pictures
            .par_iter()
            .zip(&self.rig.cameras)
            .enumerate()
            .map(|(slot, (picture, camera))| {
                let Some(picture) = picture.as_ref().filter(|_| due[slot]) else {
                    return Ok(track.looks[slot].clone());
                };
                let expected = project_all(camera, &predicted);
                let Some(crop) = Crop::around(&expected) else { return Ok(None) };
                let sighting = Sighting::take(&self.net, picture, crop)?;
                // Two people in one crop: the network may have chosen the other one.
                let own = sighting.mean_distance(&expected).unwrap_or(f64::INFINITY);
                let is_other = |marks| sighting.mean_distance(&project_all(camera, marks)).is_some_and(|d| d < own);
                Ok((!others.iter().any(is_other)).then(|| Look::fresh(sighting)))
            })
            .collect::<Result<_, TrackError>>()?;
        seconds.net += start.elapsed().as_secs_f64();
        match self.fit(set, looks, Some((track, &predicted)), seconds) {
            Ok(fitted) if fitted.relative < OFF_TRACK => Ok(Some(fitted)),
            Ok(_) => Ok(None),
            Err(error) if error.kind == TrackErrorKind::Lost => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn fit(
        &self,
        set: &FrameSet,
        looks: Vec<Option<Look>>,
        track: Option<(&Track, &[DVec3; LANDMARK_COUNT])>,
        seconds: &mut StageSeconds,
    ) -> Result<Fitted, TrackError> {
        let config = &self.config;
        let lost = |what: &str| TrackError::lost(format!("frame set {}: {what}", set.index));
        let sees = |look: &&Look| look.sighting.output.presence >= config.presence_threshold;
        let keypoints: Vec<Option<ViewKeypoints>> = looks
            .iter()
            .map(|look| {
                let look = look.as_ref().filter(|look| look.body.is_none());
                look.filter(sees).map(|look| look.sighting.keypoints)
            })
            .collect();
        let start = Instant::now();
        let points = triangulate(&self.rig.cameras, &keypoints, config.confidence_threshold, config.inlier_m);
        seconds.triangulate += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let mut views = Vec::new();
        for (slot, frame) in set.present() {
            let camera = &self.rig.cameras[slot];
            let view = View::new(camera);
            let delay_secs = secs(frame.capture_nanos.saturating_sub(set.master_nanos));
            let delay_secs = delay_secs.clamp(-MAX_DELAY_SECS, MAX_DELAY_SECS);
            let mut seen = [None; LANDMARK_COUNT];
            let mut shift = [DVec3::ZERO; LANDMARK_COUNT];
            if let Some(look) = looks[slot].as_ref().filter(sees) {
                seen = observe(camera, &view, &look.sighting.keypoints, config.confidence_threshold);
                if let Some((track, predicted)) = track {
                    for (i, (carried, trust)) in look.carried(&track.marks, predicted).into_iter().enumerate() {
                        shift[i] = track.velocity[i] * delay_secs + carried;
                        seen[i] = seen[i].map(|seen| Observation { confidence: seen.confidence * trust, ..seen });
                    }
                }
            }
            views.push(FitView { slot, view, seen, shift, delay_secs });
        }
        let most = views.iter().map(|v| v.seen.iter().flatten().count()).max().unwrap_or(0);
        if most < MIN_LANDMARKS {
            return Err(lost("no view shows enough of a person"));
        }
        let mut evidence = Evidence { views, points: [None; LANDMARK_COUNT], before: None };
        // One view alone says nothing of depth: the network's own guess at the third dimension stands in.
        let triangulated = points.iter().flatten().count();
        let mut world = points.each_ref().map(|point| point.as_ref().map(|p| p.position));
        if triangulated < MIN_LANDMARKS {
            let sightings = looks.iter().map(|look| look.as_ref().map(|look| &*look.sighting));
            let seen = keypoints.iter().zip(sightings).zip(&self.rig.cameras);
            let surest = seen
                .filter_map(|((k, s), camera)| k.as_ref().and(s).map(|s| (s, camera)))
                .max_by(|a, b| a.0.output.presence.total_cmp(&b.0.output.presence));
            let scale = self.model.trunk_length() / 0.5;
            let lifted = surest.and_then(|(s, camera)| lift(camera, s, config.confidence_threshold, scale));
            if let Some(lifted) = lifted {
                world = lifted;
                evidence.points = lifted.map(|point| point.map(|p| (p, 0.1)));
            }
        }
        let turns = match track {
            Some((track, _)) => {
                let dt = secs(set.master_nanos.saturating_sub(track.nanos));
                let sigma_rad = config.smooth_rad * (dt * 30.0).clamp(0.1, 30.0).sqrt();
                evidence.before = Some(Before { turns: track.turns.clone(), sigma_rad });
                evidence.problem(&self.model, config).solve(&track.turns, config.max_steps)
            }
            None => {
                let aligned = align_trunk(&self.model, &world)
                    .ok_or_else(|| lost("the views do not agree on a person's trunk"))?;
                let problem = evidence.problem(&self.model, config);
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
        self.judge(turns, looks, keypoints, points, evidence).ok_or_else(|| lost("no landmark agrees with the fit"))
    }

    /// Distances of the landmarks from the fitted body.
    fn judge(
        &self,
        turns: Turns,
        looks: Vec<Option<Look>>,
        keypoints: Vec<Option<ViewKeypoints>>,
        points: [Option<WorldPoint>; LANDMARK_COUNT],
        evidence: Evidence,
    ) -> Option<Fitted> {
        let marks = self.model.marks(&turns);
        let mut all = Vec::new();
        let mut all_relative = Vec::new();
        let mut views = Vec::with_capacity(keypoints.len());
        for (slot, look) in looks.iter().enumerate() {
            let presence = look.as_ref().map_or(0.0, |look| look.sighting.output.presence);
            let mut distances = Vec::new();
            let mut inliers = 0;
            let fit_view = evidence.views.iter().find(|view| view.slot == slot);
            if let Some(fit_view) = fit_view {
                for (i, seen) in fit_view.seen.iter().enumerate() {
                    let Some(seen) = seen else { continue };
                    let moved = fit_view.view.project(marks[i] + fit_view.shift[i]);
                    let (Some(pixel), Some(px_per_m)) = (moved, fit_view.view.px_per_m(marks[i])) else { continue };
                    let distance = (pixel - seen.ideal_px).length();
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
            looks,
            keypoints,
            points,
            views,
            residual_px,
            relative,
            evidence,
        })
    }

    fn remember(&mut self, set: &FrameSet, turns: Turns, mut looks: Vec<Option<Look>>) {
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
        let body = LookBody { nanos: set.master_nanos, turns: Arc::new(turns.clone()), marks };
        for look in looks.iter_mut().flatten() {
            look.body.get_or_insert_with(|| body.clone());
        }
        self.track = Some(Track { turns, nanos: set.master_nanos, marks, velocity, looks });
        self.lost = 0;
    }
}

pub(crate) fn check_size(camera: &flyrig_types::Camera, image: &Image) -> Result<(), TrackError> {
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
