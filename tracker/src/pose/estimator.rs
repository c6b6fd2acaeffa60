//! The estimator: frame sets in, poses and masks out.

mod follow;
mod masks;
mod refine;
mod shape;

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
use crate::masks::silhouette::{coarse_mask, refine};
use crate::network::parallel::beside_each_other;
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
/// After a loss the whole image is searched in every set, and ever more rarely up to every so many sets.
const RAREST_SEARCH: u32 = 8;

/// Landmarks in the world, metres.
pub type Marks = [DVec3; LANDMARK_COUNT];

/// The person as last seen.
#[derive(Debug, Clone)]
struct Track {
    turns: JointTurns,
    nanos: i64,
    marks: [DVec3; LANDMARK_COUNT],
    /// Metres a second; `None` of a person who was seen at one instant only.
    velocity: Option<[DVec3; LANDMARK_COUNT]>,
    /// By slot.
    inferences: Vec<Option<Inference>>,
    texture: Texture,
}

impl Track {
    /// Landmarks at a time a little later.
    fn predicted(&self, nanos: i64) -> [DVec3; LANDMARK_COUNT] {
        let ahead = secs(nanos.saturating_sub(self.nanos)).clamp(0.0, MAX_DELAY_SECS);
        std::array::from_fn(|i| self.marks[i] + self.motion(i, ahead))
    }

    /// How far a landmark moves in a time, metres.
    fn motion(&self, landmark: usize, secs: f64) -> DVec3 {
        self.velocity.map_or(DVec3::ZERO, |velocity| velocity[landmark] * secs)
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
    /// The same in shoes, where they are known: what outlines and texture are compared with.
    surface: Arc<Template>,
    model: BodyModel,
    rig: Rig,
    config: PoseConfig,
    /// By slot.
    backgrounds: Vec<Option<Arc<Background>>>,
    track: Option<Track>,
    search: Search,
    /// Sets since the person was last seen.
    lost: u32,
    /// Whether the network inferences at every view of every set.
    infers_always: bool,
    /// Whether sightings are kept, and the last one.
    keeps_sightings: bool,
    clothes: Clothes,
    /// Whether nobody else was known in the last set.
    is_alone: bool,
    sighting: Option<ShapeSighting>,
}

/// Clothes of the person.
#[derive(Debug, Clone)]
enum Clothes {
    /// Nobody has inferred yet.
    Unknown,
    /// The body as it is dressed.
    Known(Arc<Template>),
}

/// A fitted pose before it is believed.
#[derive(Debug, Clone)]
struct Fitted {
    turns: JointTurns,
    inferences: Vec<Option<Inference>>,
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
    /// Views that the network inferred at in this set.
    fn inferred(&self) -> usize {
        self.inferences.iter().flatten().filter(|inference| inference.body.is_none()).count()
    }

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
            lines: &[],
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

    /// Lets the network inference at every view of every set, whether the body moves or not.
    pub(crate) fn infer_always(&mut self, always: bool) {
        self.infers_always = always;
    }

    /// Keeps each set's sighting for [`Self::measure_shape`]; the network inferences at every view of every set then.
    pub fn keep_sightings(&mut self, keep: bool) {
        (self.infers_always, self.keeps_sightings, self.sighting) = (keep, keep, None);
    }

    /// Returns the sighting of the last set that was estimated; `None` where there was nobody, or where none is kept.
    pub fn take_sighting(&mut self) -> Option<ShapeSighting> {
        self.sighting.take()
    }

    /// Returns the settings, to change them from the next set on.
    pub fn config_mut(&mut self) -> &mut PoseConfig {
        &mut self.config
    }

    /// The template, with the person's bone lengths once [`Self::fit_shape`] has run.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Gives a camera's empty image; masks of that camera then heed the difference to it as well.
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

    /// Sets the backgrounds by slot, one a camera; masks then use the difference to them. Fewer leave the last cameras without
    /// one.
    pub fn set_backgrounds(&mut self, mut backgrounds: Vec<Option<Arc<Background>>>) {
        backgrounds.resize(self.rig.cameras.len(), None);
        self.backgrounds = backgrounds;
    }

    /// Returns the backgrounds by slot, to update them; masks do without until they are set again.
    pub fn take_backgrounds(&mut self) -> Vec<Option<Arc<Background>>> {
        std::mem::replace(&mut self.backgrounds, vec![None; self.rig.cameras.len()])
    }

    /// A camera stands elsewhere from the next set on. What the network saw in its last image is forgotten; its background is not
    /// moved along. A slot that does not exist changes nothing.
    pub fn move_camera(&mut self, slot: usize, camera: &Camera) {
        if let Some(known) = self.rig.cameras.get_mut(slot) {
            known.clone_from(camera);
            let inference = self.track.as_mut().and_then(|track| track.inferences.get_mut(slot));
            inference.into_iter().for_each(|inference| *inference = None);
        }
    }

    /// Returns a camera's background, where it is known.
    #[must_use]
    pub fn background(&self, slot: usize) -> Option<&Background> {
        self.backgrounds.get(slot)?.as_deref()
    }

    /// Looks for the person where a pose puts him at a time; false for a pose that does not fit the template.
    pub fn start_from(&mut self, pose: &flyrig_types::Pose, nanos: i64) -> bool {
        let Some(turns) = self.model.to_turns(pose) else { return false };
        self.start_at(turns, nanos);
        true
    }

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
        (self.sighting, self.is_alone) = (None, others.is_empty());
        let mut seconds = StageSeconds::default();
        let found = if pictures.iter().all(Option::is_none) {
            // A prediction alone is nobody.
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
        let (mut fitted, mut masks) = self.finish(set, &pictures, fitted, &mut texture, &mut seconds);
        if let Some(before) = before
            && let Some(again) = self.infer_after_refinement(set, &pictures, &fitted.turns, others, &mut seconds)?
        {
            texture = before;
            (fitted, masks) = self.finish(set, &pictures, again, &mut texture, &mut seconds);
        }
        let inferred = fitted.inferred();
        self.sighting = self.keeps_sightings.then(|| ShapeSighting { set: set.clone(), fitted: fitted.clone() });
        self.remember(set, fitted.turns.clone(), fitted.inferences, texture);
        Ok(PoseEstimate {
            pose: self.model.to_pose(&fitted.turns),
            masks,
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

    /// Makes the masks, and fits the pose to their outlines and the texture.
    fn finish(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        mut fitted: Fitted,
        texture: &mut Texture,
        seconds: &mut StageSeconds,
    ) -> (Fitted, Vec<Option<Mask>>) {
        let start = Instant::now();
        let mut masks = self.masks(set, pictures, &mut fitted);
        seconds.masks += start.elapsed().as_secs_f64();
        if self.config.outline_rounds > 0 {
            let start = Instant::now();
            let given: Vec<Option<&Mask>> = if self.config.masks {
                masks.iter().map(Option::as_ref).collect()
            } else {
                set.frames.iter().map(|frame| frame.as_ref().and_then(|frame| frame.mask.as_ref())).collect()
            };
            fitted.turns = self.refine(set, pictures, &fitted, &given, texture);
            seconds.outline += start.elapsed().as_secs_f64();
        }
        if !self.config.masks {
            masks.fill(None);
        }
        (fitted, masks)
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

    /// Chooses the clothes that masks allow for, and the shoes whose outlines the pose is fitted to. Once they are known, masks reach less
    /// far from the body, and things and people nearby are no part of them.
    ///
    /// # Errors
    /// Kind `Template` for a body that cannot wear them.
    pub fn wear(&mut self, outfit: Outfit) -> Result<(), TrackError> {
        let dressed = |outfit: Outfit| -> Result<Arc<Template>, TrackError> {
            let dressed = outfit.on(&self.template);
            dressed.map(Arc::new).map_err(|error| TrackError::new(TrackErrorKind::Template, error.to_string()))
        };
        // A skirt swings: its outline says nothing of the legs.
        let surface = dressed(Outfit { skirt: None, ..outfit })?;
        self.clothes = Clothes::Known(if outfit.skirt.is_some() { dressed(outfit)? } else { surface.clone() });
        self.change_surface(surface);
        Ok(())
    }

    /// Takes another surface of the person; a texture belongs to one surface.
    fn change_surface(&mut self, surface: Arc<Template>) {
        if let Some(track) = self.track.as_mut().filter(|_| *surface != *self.surface) {
            track.texture = Texture::new(&surface, self.rig.cameras.len());
        }
        self.surface = surface;
    }

    /// Lets masks reach as far as wide clothes: somebody else may have come.
    pub fn forget_clothes(&mut self) {
        self.clothes = Clothes::Unknown;
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
    fn skinned(&self, turns: &JointTurns, set: &FrameSet, delay_secs: f64) -> (Vec<Vec3>, Vec<Vec3>) {
        self.skinned_in(&self.surface, turns, set, delay_secs)
    }

    /// The same of the body as it is dressed.
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
                .map(|frame| Rgb::of_camera(&frame.image, camera))
                .transpose()
                // A covered lens would pull the pose: the view counts as missing.
                .map(|picture| picture.filter(|picture| !picture.is_blank()))
        };
        set.frames.iter().zip(&self.rig.cameras).map(read).collect()
    }

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
                // The same set again.
                _ if dt < 1e-3 => last.velocity,
                // Too long ago to say anything of now.
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
