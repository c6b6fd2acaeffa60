//! The pose estimator of one person: frame sets in, poses and masks out.
//!
//! One frame set in steps: landmarks of the due views ([`follow`]), a pose fitted to them, masks gated by that body
//! ([`masks`]), then the pose whose outline lies on that of the masks and whose surface shows the brightness that each
//! camera remembers of it ([`refine`]). A person who is lost is searched for over several frame sets. [`shape`] measures
//! the person's shape.

mod follow;
mod masks;
mod refine;
mod shape;

use masks::Masks;
pub use shape::ShapeSighting;

use std::sync::Arc;
use std::time::Instant;

use flyrig_body::{Outfit, Template, skin_mesh};
use flyrig_solve::median;
use flyrig_types::{Camera, Frame, FrameSet, Image, Mask, Rig};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::error::{TrackError, TrackErrorKind};
use crate::image::crop::Crop;
use crate::image::pixels::Rgb;
use crate::image::view::{Observation, View, observe};
use crate::landmarks::inference_schedule::{Inference, InferredBody, due};
use crate::landmarks::keypoints::{LANDMARK_COUNT, ViewKeypoints};
use crate::landmarks::search::{Search, SearchScene, project_all};
use crate::landmarks::sighting::Sighting;
use crate::landmarks::single_view::{growth_to_floor, lift};
use crate::landmarks::triangulate::{WorldPoint, triangulate};
use crate::masks::background::Background;
use crate::masks::carried_mask::{carried_mask, corners};
use crate::masks::gate::BodyGate;
use crate::masks::gated_mask::gated_mask;
use crate::masks::seen_background::SeenBackground;
use crate::masks::silhouette::{body_mask, coarse_mask, refine};
use crate::network::parallel::map_parallel;
use crate::network::pose_net::PoseNet;
use crate::pose::body_model::{BodyModel, JointTurns};
use crate::pose::config::PoseConfig;
use crate::pose::estimate::{NoMask, PoseEstimate, PoseQuality, StageSeconds, ViewQuality};
use crate::pose::fit::{Before, FitProblem, FitView, align_trunk};
use crate::pose::line_point::LinePoint;
use crate::pose::outline::SeenBody;
use crate::pose::texture::{Brightness, LEVELS, Texture, TexturedBody};
use crate::shape::body_shape::ShapeSpace;
use crate::shape::bone_lengths::{ShapeFit, fit_template_shape, height_m, seen_landmarks, template_of_height};
use crate::shape::shape_solve::{ShapeAndPoses, ShapeProblem, ShapeSet};

/// Least number of usable landmarks in one view for a fit.
const MIN_LANDMARKS: usize = 8;
/// Residual above which a tracked pose has come off the person, multiples of the inlier distance.
const OFF_TRACK: f64 = 1.5;
/// Limit of the difference between a camera's time and the frame set's, seconds.
const MAX_DELAY_SECS: f64 = 0.1;
/// Limit of a landmark's speed, metres per second.
const MAX_SPEED: f64 = 12.0;
/// Time difference below which a camera shows the body as at the frame set's time, seconds.
const MIN_DELAY_SECS: f64 = 5e-4;
/// Longest period between two searches after a loss, frame sets; it grows with the time since the loss.
const RAREST_SEARCH: u32 = 8;

/// Places of the body landmarks in the world, metres.
pub type Marks = [DVec3; LANDMARK_COUNT];

/// State of a tracked person after the last frame set.
#[derive(Debug, Clone)]
struct Track {
    turns: JointTurns,
    nanos: i64,
    marks: [DVec3; LANDMARK_COUNT],
    /// Landmark velocities, metres per second; `None` for a person who was seen at one instant only.
    velocity: Option<[DVec3; LANDMARK_COUNT]>,
    /// Last inference of each view, in rig order.
    inferences: Vec<Option<Inference>>,
    texture: Texture,
}

impl Track {
    /// Extrapolates the landmarks to a later time.
    fn predicted(&self, nanos: i64) -> [DVec3; LANDMARK_COUNT] {
        let ahead = secs(nanos.saturating_sub(self.nanos)).clamp(0.0, MAX_DELAY_SECS);
        std::array::from_fn(|i| self.marks[i] + self.motion(i, ahead))
    }

    /// Returns the displacement of a landmark in a time, metres.
    fn motion(&self, landmark: usize, secs: f64) -> DVec3 {
        self.velocity.map_or(DVec3::ZERO, |velocity| velocity[landmark] * secs)
    }
}

/// Tracker of one person through the frame sets of a rig.
///
/// ```no_run
/// use flyrig_body::{ShapeParams, default_template};
/// use flyrig_tracker::{PoseConfig, PoseEstimator, PoseNet, TrackErrorKind};
/// use flyrig_types::{FrameSet, Rig};
///
/// fn track(rig: &Rig, first: &[FrameSet], rest: &[FrameSet]) -> Result<(), Box<dyn std::error::Error>> {
///     let template = default_template(&ShapeParams::default())?;
///     let mut estimator = PoseEstimator::new(PoseNet::embedded()?, &template, rig, PoseConfig::default())?;
///     let (shape, _) = estimator.fit_shape(first, &[])?;
///     println!("the person is {shape}");
///     for set in first.iter().chain(rest) {
///         match estimator.estimate(set) {
///             Ok(estimate) => println!("root at {} m", estimate.pose.root_translation),
///             Err(error) if error.kind == TrackErrorKind::Lost => println!("{error}"),
///             Err(error) => return Err(error.into()),
///         }
///     }
///     Ok(())
/// }
/// ```
#[derive(Debug, Clone)]
pub struct PoseEstimator {
    net: PoseNet,
    /// Template as it was given.
    base: Template,
    /// Template in the person's shape.
    template: Template,
    /// Template in shoes, where they are known: outlines and texture are compared with it.
    surface: Arc<Template>,
    model: BodyModel,
    rig: Rig,
    config: PoseConfig,
    /// Backgrounds in rig order.
    backgrounds: Vec<Option<Arc<Background>>>,
    track: Option<Track>,
    search: Search,
    /// Frame sets since the person was last seen.
    lost: u32,
    /// Whether the network runs on every view of every frame set.
    infers_always: bool,
    /// Whether shape sightings are kept; the last one is `sighting`.
    keeps_sightings: bool,
    clothes: Clothes,
    /// Whether no other person was known in the last frame set.
    is_alone: bool,
    sighting: Option<ShapeSighting>,
}

/// Clothes of the person.
#[derive(Debug, Clone)]
enum Clothes {
    /// Not measured yet.
    Unknown,
    /// Measured: the body as it is dressed.
    Known(Arc<Template>),
}

/// Fitted pose before it is accepted.
#[derive(Debug, Clone)]
struct Fitted {
    turns: JointTurns,
    inferences: Vec<Option<Inference>>,
    keypoints: Vec<Option<ViewKeypoints>>,
    points: [Option<WorldPoint>; LANDMARK_COUNT],
    views: Vec<ViewQuality>,
    residual_px: f64,
    /// Residual, multiples of the inlier distance.
    relative: f64,
    evidence: Evidence,
}

/// Measurements behind a fitted pose.
#[derive(Debug, Clone)]
struct Evidence {
    /// One element per frame.
    views: Vec<FitView>,
    points: [Option<(DVec3, f64)>; LANDMARK_COUNT],
    before: Option<Before>,
}

impl Fitted {
    /// Returns the number of views that the network ran on in this frame set.
    fn inferred(&self) -> usize {
        self.inferences.iter().flatten().filter(|inference| inference.body.is_none()).count()
    }

    /// Returns the time of a slot's frame relative to the frame set's, seconds.
    fn delay_secs(&self, slot: usize) -> f64 {
        self.evidence.views.iter().find(|view| view.slot == slot).map_or(0.0, |view| view.delay_secs)
    }
}

impl Evidence {
    /// Returns the fit of a pose to these measurements.
    fn problem<'a>(&'a self, model: &'a BodyModel, config: &PoseConfig) -> FitProblem<'a> {
        FitProblem {
            model,
            views: &self.views,
            lines: &[],
            points: self.points,
            before: self.before.clone(),
            landmark_spread: config.landmark_spread,
            robust: 2.0,
        }
    }
}

impl PoseEstimator {
    /// Creates an estimator for one template (see [`Self::fit_shape`] for its size) and one rig.
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
            surface: Arc::new(template.clone()),
            model,
            rig: rig.clone(),
            config,
            backgrounds,
            track: None,
            search: Search::default(),
            lost: 0,
            infers_always: false,
            keeps_sightings: false,
            clothes: Clothes::Unknown,
            is_alone: true,
            sighting: None,
        })
    }

    /// Sets whether the network runs on every view of every frame set even if the body is still.
    pub(crate) fn infer_always(&mut self, always: bool) {
        self.infers_always = always;
    }

    /// Sets whether each frame set's sighting is kept for [`Self::measure_shape`]; the network then runs on every view.
    pub fn keep_sightings(&mut self, keep: bool) {
        (self.infers_always, self.keeps_sightings, self.sighting) = (keep, keep, None);
    }

    /// Returns the sighting of the last frame set; `None` without a person, or where none is kept.
    pub fn take_sighting(&mut self) -> Option<ShapeSighting> {
        self.sighting.take()
    }

    /// Returns the settings, to change them from the next frame set on.
    pub fn config_mut(&mut self) -> &mut PoseConfig {
        &mut self.config
    }

    /// Returns the template, in the person's shape once [`Self::fit_shape`] has run.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Sets the image of the empty scene of a camera; masks then use the difference from it.
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
        self.backgrounds[slot] = Some(Arc::new(Background::from_plate(camera, plate)?));
        Ok(())
    }

    /// Sets the backgrounds in rig order; masks then use the difference from them. Missing ones at the end count as `None`.
    pub fn set_backgrounds(&mut self, mut backgrounds: Vec<Option<Arc<Background>>>) {
        backgrounds.resize(self.rig.cameras.len(), None);
        self.backgrounds = backgrounds;
    }

    /// Takes the backgrounds out, in rig order, to update them; masks do without until they are set again.
    pub fn take_backgrounds(&mut self) -> Vec<Option<Arc<Background>>> {
        std::mem::replace(&mut self.backgrounds, vec![None; self.rig.cameras.len()])
    }

    /// Replaces a camera that has moved, from the next frame set on. Its last inference is forgotten; its background stays.
    /// Slots that do not exist are ignored.
    pub fn move_camera(&mut self, slot: usize, camera: &Camera) {
        if let Some(known) = self.rig.cameras.get_mut(slot) {
            known.clone_from(camera);
            let inference = self.track.as_mut().and_then(|track| track.inferences.get_mut(slot));
            inference.into_iter().for_each(|inference| *inference = None);
        }
    }

    /// Returns the background of a camera, where it is known.
    #[must_use]
    pub fn background(&self, slot: usize) -> Option<&Background> {
        self.backgrounds.get(slot)?.as_deref()
    }

    /// Tracks the person from a pose at a time in nanoseconds on; returns false for a pose that does not fit the template.
    pub fn start_from(&mut self, pose: &flyrig_types::Pose, nanos: i64) -> bool {
        let Some(turns) = self.model.to_turns(pose) else { return false };
        self.start_at(turns, nanos);
        true
    }

    /// Tracks the person from a pose at a time on.
    fn start_at(&mut self, turns: JointTurns, nanos: i64) {
        let marks = self.model.marks(&turns);
        self.track = Some(Track {
            turns,
            nanos,
            marks,
            velocity: None,
            inferences: vec![None; self.rig.cameras.len()],
            texture: Texture::new(&self.surface, self.rig.cameras.len()),
        });
        self.lost = 0;
    }

    /// Forgets the last pose, so that the next frame set is searched.
    pub fn reset(&mut self) {
        self.track = None;
        self.lost = 0;
    }

    /// Estimates pose, masks and quality of one frame set; frame sets come in order of time.
    ///
    /// # Errors
    /// Kind `Lost` when no person was found: call again with the next frame set, the search continues. Kinds `Frames`,
    /// `Image` and `Net` when the input is not usable. The state stays valid in any case.
    pub fn estimate(&mut self, set: &FrameSet) -> Result<PoseEstimate, TrackError> {
        self.estimate_among(set, &[], true)
    }

    /// Estimates as [`Self::estimate`] does, beside other people whose landmarks are known: sightings of them are rejected.
    /// Without `may_search` a person who cannot be tracked is lost in this frame set.
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
        (self.sighting, self.is_alone) = (None, others.is_empty());
        let mut seconds = StageSeconds::default();
        let found = if pictures.iter().all(Option::is_none) {
            // A prediction alone is no person.
            Err(TrackError::new(TrackErrorKind::Lost, "every image is uniform; uncover the lenses, or check the light"))
        } else {
            self.follow_or_search(set, &pictures, others, may_search, &mut seconds)
        };
        let fitted = match found {
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
        let known = self.track.as_mut().map(|track| std::mem::take(&mut track.texture));
        let mut texture = known.unwrap_or_else(|| Texture::new(&self.surface, self.rig.cameras.len()));
        let before = (fitted.inferred() == 0).then(|| texture.clone());
        let (mut fitted, mut masks, mut backgrounds) = self.finish(set, &pictures, fitted, &mut texture, &mut seconds);
        if let Some(before) = before
            && let Some(again) = self.infer_after_refinement(set, &pictures, &fitted.turns, others, &mut seconds)?
        {
            texture = before;
            (fitted, masks, backgrounds) = self.finish(set, &pictures, again, &mut texture, &mut seconds);
        }
        let inferred = fitted.inferred();
        self.sighting = self.keeps_sightings.then(|| ShapeSighting { set: set.clone(), fitted: fitted.clone() });
        self.remember(set, fitted.turns.clone(), fitted.inferences, texture);
        Ok(PoseEstimate {
            pose: self.model.to_pose(&fitted.turns),
            masks,
            backgrounds,
            keypoints: fitted.keypoints,
            quality: PoseQuality {
                views: fitted.views,
                residual_px: fitted.residual_px,
                triangulated: fitted.points.iter().flatten().count(),
                inferred,
                seconds,
            },
            points: fitted.points.map(|point| point.map(|p| p.position)),
        })
    }

    /// Estimates the masks, and fits the pose to their outlines and the texture.
    fn finish(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        mut fitted: Fitted,
        texture: &mut Texture,
        seconds: &mut StageSeconds,
    ) -> (Fitted, Vec<Option<Mask>>, Vec<Option<SeenBackground>>) {
        if !self.config.masks && self.config.outline_rounds == 0 {
            let views = pictures.len();
            return (fitted, vec![None; views], vec![None; views]);
        }
        let start = Instant::now();
        let body = self.posed(set, &fitted, &fitted.turns);
        let Masks { mut masks, gates, backgrounds } = self.masks(set, pictures, &mut fitted, &body);
        seconds.masks += start.elapsed().as_secs_f64();
        if self.config.outline_rounds > 0 {
            let start = Instant::now();
            let given: Vec<Option<&Mask>> = if self.config.masks {
                masks.iter().map(Option::as_ref).collect()
            } else {
                set.frames.iter().map(|frame| frame.as_ref().and_then(|frame| frame.mask.as_ref())).collect()
            };
            let gates = if self.gates_show_surface() { gates.as_slice() } else { &[] };
            fitted.turns = self.refine(set, pictures, &fitted, &given, (body, gates), texture);
            seconds.outline += start.elapsed().as_secs_f64();
        }
        if !self.config.masks {
            masks.fill(None);
        }
        (fitted, masks, backgrounds)
    }

    /// Extrapolates the person's landmarks to a time in nanoseconds; `None` while no person is tracked.
    #[must_use]
    pub fn predicted_landmarks(&self, nanos: i64) -> Option<Marks> {
        self.track.as_ref().map(|track| track.predicted(nanos))
    }

    /// Returns the number of frame sets since the person was last seen; 0 for one who is tracked.
    #[must_use]
    pub fn sets_lost(&self) -> u32 {
        if self.track.is_some() { self.lost } else { self.lost.max(1) }
    }

    /// Sets the person's clothes: masks reach less far from the body once they are known, so that things and people nearby
    /// are no part of them, and the pose is fitted to the outlines of the shoes.
    ///
    /// # Errors
    /// Kind `Template` for a body that cannot wear them.
    pub fn wear(&mut self, outfit: Outfit) -> Result<(), TrackError> {
        let dressed = |outfit: Outfit| -> Result<Arc<Template>, TrackError> {
            let dressed = outfit.on(&self.template);
            dressed.map(Arc::new).map_err(|error| TrackError::new(TrackErrorKind::Template, error.to_string()))
        };
        // A skirt swings: its outline does not constrain the legs.
        let surface = dressed(Outfit { skirt: None, ..outfit })?;
        self.clothes = Clothes::Known(if outfit.skirt.is_some() { dressed(outfit)? } else { surface.clone() });
        self.change_surface(surface);
        Ok(())
    }

    /// Replaces the person's surface; the texture of another surface is forgotten.
    fn change_surface(&mut self, surface: Arc<Template>) {
        if let Some(track) = self.track.as_mut().filter(|_| *surface != *self.surface) {
            track.texture = Texture::new(&surface, self.rig.cameras.len());
        }
        self.surface = surface;
    }

    /// Forgets the clothes, so that masks reach as far as wide ones: another person may have come.
    pub fn forget_clothes(&mut self) {
        self.clothes = Clothes::Unknown;
    }

    /// Drops the tracked person, who turned out to be another one. The search begins anew.
    pub fn drop_track(&mut self) {
        self.track = None;
        self.lost = self.lost.max(1);
    }

    /// Takes over the person tracked by another estimator, from the next frame set on; the other one has then lost the
    /// person.
    pub fn take_track(&mut self, other: &mut Self) {
        self.track = other.track.take();
        self.lost = 0;
        other.lost = 1;
    }

    /// Skins a pose at a delay after its time, extrapolated by the motion since the last frame set. Returns world vertices
    /// and normals.
    fn skinned(&self, turns: &JointTurns, set: &FrameSet, delay_secs: f64) -> (Vec<Vec3>, Vec<Vec3>) {
        self.skinned_in(&self.surface, turns, set, delay_secs)
    }

    /// Skins a template as [`Self::skinned`] does.
    fn skinned_in(
        &self,
        template: &Template,
        turns: &JointTurns,
        set: &FrameSet,
        delay_secs: f64,
    ) -> (Vec<Vec3>, Vec<Vec3>) {
        let moved = self.track.as_ref().filter(|_| delay_secs.abs() > MIN_DELAY_SECS).and_then(|track| {
            let since = secs(set.master_nanos.saturating_sub(track.nanos));
            (since > 1e-3).then(|| turns.advanced(&track.turns, (delay_secs / since).clamp(-1.0, 1.0)))
        });
        skin_mesh(template, &self.model.to_pose(moved.as_ref().unwrap_or(turns)))
    }

    /// Returns the world positions of the landmarks on the template in a pose, metres; `None` for a pose that does not fit
    /// the template.
    #[must_use]
    pub fn landmarks(&self, pose: &flyrig_types::Pose) -> Option<Marks> {
        self.model.to_turns(pose).map(|turns| self.model.marks(&turns))
    }

    /// Reads the images of a frame set; blank ones count as missing.
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
                .map(|frame| Rgb::of_camera(&frame.image, camera))
                .transpose()
                // A covered lens would pull the pose: the view counts as missing.
                .map(|picture| picture.filter(|picture| !picture.is_blank()))
        };
        set.frames.iter().zip(&self.rig.cameras).map(read).collect()
    }

    /// Stores the pose of a frame set as the state to track from.
    fn remember(
        &mut self,
        set: &FrameSet,
        turns: JointTurns,
        mut inferences: Vec<Option<Inference>>,
        texture: Texture,
    ) {
        let marks = self.model.marks(&turns);
        let velocity = self.track.as_ref().and_then(|last| {
            let dt = secs(set.master_nanos.saturating_sub(last.nanos));
            match dt {
                // Repeated frame set.
                _ if dt < 1e-3 => last.velocity,
                // Too long ago to predict from.
                _ if dt >= 0.2 => Some([DVec3::ZERO; LANDMARK_COUNT]),
                _ => Some(std::array::from_fn(|i| {
                    let now = ((marks[i] - last.marks[i]) / dt).clamp_length_max(MAX_SPEED);
                    last.velocity.map_or(now, |before| 0.5 * (before[i] + now))
                })),
            }
        });
        let body = InferredBody { nanos: set.master_nanos, turns: Arc::new(turns.clone()), marks };
        for inference in inferences.iter_mut().flatten() {
            inference.body.get_or_insert_with(|| body.clone());
        }
        self.track = Some(Track { turns, nanos: set.master_nanos, marks, velocity, inferences, texture });
        self.lost = 0;
    }
}

fn finite(turns: &JointTurns) -> bool {
    turns.root.is_finite() && turns.turns.iter().all(|q| q.is_finite())
}

fn secs(nanos: i64) -> f64 {
    nanos as f64 * 1e-9
}
