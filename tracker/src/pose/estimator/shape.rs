//! The person's shape, fitted to about eight frame sets, while the person is tracked or beforehand.
//!
//! Bone lengths come from landmarks; lengths, girths and build then from landmarks and outlines, together with the poses
//! ([`shape_solve`](crate::shape::shape_solve)). A single camera measures only the height, by where the feet stand
//! ([`single_view`](crate::landmarks::single_view)). Shoes and a skirt are found last
//! ([`outfit_fit`](crate::shape::outfit_fit)): joints stay those of the body, outlines are those of the feet in shoes.

use super::*;
use crate::pose::line_point::BareBody;
use crate::shape::bone_lengths::HeightFrom;
use crate::shape::outfit_fit::{MaskedPoses, MaskedView, find_outfit};
use flyrig_body::Shoes;
use flyrig_types::Camera;

/// Returns the body in shoes; barefoot where it cannot wear any.
fn shod(body: &Template, shoes: Option<Shoes>) -> Arc<Template> {
    Arc::new(Outfit { skirt: None, shoes }.on(body).unwrap_or_else(|_| body.clone()))
}

/// Range of plausible heights measured by a single camera, metres.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = 1.2..=2.2;

/// Solver steps to a pose in a new shape.
const POSE_STEPS: usize = 40;

/// Person in one frame set, as a measurement of the shape.
#[derive(Debug, Clone)]
pub struct ShapeSighting {
    pub(super) set: FrameSet,
    pub(super) fitted: Fitted,
}

impl PoseEstimator {
    /// Fits the shape to the person in a few frame sets (5 to 10, buffered at the start; motion improves it) and replaces
    /// the template by the fitted one. The buffered frame sets are then estimated again, in order. `others` holds the
    /// landmarks of other people, by person and frame set; they are rejected. Also returns the person's own landmarks in
    /// each frame set.
    ///
    /// # Errors
    /// Kind `Lost` when too few of the frame sets show a person; the template stays as it was.
    pub fn fit_shape(
        &mut self,
        sets: &[FrameSet],
        others: &[Vec<Option<Marks>>],
    ) -> Result<(ShapeFit, Vec<Option<Marks>>), TrackError> {
        let mut sightings = Vec::new();
        let mut last = None;
        let mut places = Vec::new();
        for (index, set) in sets.iter().enumerate() {
            let others: Vec<Marks> = others.iter().filter_map(|marks| *marks.get(index)?).collect();
            let found = self.find_at_once(set, &others);
            places.push(found.as_ref().ok().map(|fitted| self.model.marks(&fitted.turns)));
            match found {
                Ok(fitted) => {
                    self.remember(set, fitted.turns.clone(), fitted.inferences.clone(), Texture::default());
                    sightings.push(ShapeSighting { set: set.clone(), fitted });
                }
                Err(error) => last = Some(error),
            }
        }
        self.reset();
        let before = height_m(&self.template);
        let measured = match (sightings.is_empty(), last) {
            (true, Some(error)) => Err(error),
            _ => self.measure_shape(&sightings),
        };
        let (template, fit) = measured?;
        self.take_shape(template)?;
        if let Some(first) = sightings.into_iter().next() {
            self.start_at(self.resized(first.fitted.turns, before), first.set.master_nanos);
        }
        Ok((fit, places))
    }

    /// Fits the shape to a person seen in a few frame sets: bone lengths to the landmarks, then lengths, girths and build
    /// to landmarks and outlines, together with the poses ([`crate::PoseConfig::shape_rounds`]). A single camera measures
    /// only the height: the configured one, that of a person who stands on the floor ([`crate::PoseSettings::floor_m`]), or
    /// an average one. Does not change the estimator; returns the template of the fitted shape for [`Self::take_shape`].
    ///
    /// # Errors
    /// Kind `Lost` when too few of the frame sets show a person in two views.
    pub fn measure_shape(&self, sightings: &[ShapeSighting]) -> Result<(Template, ShapeFit), TrackError> {
        if let [camera] = self.rig.cameras.as_slice() {
            let standing =
                || Some((self.height_on_floor(camera, sightings)?, HeightFrom::Floor(self.config.settings.floor_m)));
            let configured = self.config.settings.height_m.map(|height| (height, HeightFrom::Configuration));
            let (height, from) =
                configured.or_else(standing).map_or((None, HeightFrom::Average), |(height, from)| (Some(height), from));
            return template_of_height(&self.base, height, from);
        }
        let seen = |views: &&Vec<_>| seen_landmarks(views, self.config.confidence_threshold) >= MIN_LANDMARKS;
        let keypoints = sightings.iter().map(|sighting| &sighting.fitted.keypoints);
        let keypoints: Vec<Vec<_>> = keypoints.filter(seen).cloned().collect();
        let (template, mut fit) = fit_template_shape(&self.base, &self.rig, &keypoints, &self.config)?;
        if self.config.shape_rounds == 0 {
            return Ok((template, fit));
        }
        // Masks and outlines are those of the body in the new shape.
        let mut shaped = Self { track: None, clothes: Clothes::Unknown, ..self.clone() };
        shaped.take_shape(template)?;
        shaped.fit_shape_to_outlines(sightings, &mut fit)?;
        Ok((shaped.template, fit))
    }

    /// Continues tracking with a template of [`Self::measure_shape`].
    ///
    /// # Errors
    /// Kind `Template` when it is not usable.
    pub fn take_shape(&mut self, template: Template) -> Result<(), TrackError> {
        self.model = BodyModel::new(&template)?;
        self.surface = Arc::new(template.clone());
        let before = height_m(&std::mem::replace(&mut self.template, template));
        if let Some(track) = self.track.take() {
            self.start_at(self.resized(track.turns, before), track.nanos);
        }
        Ok(())
    }

    /// Moves a body that was `before` metres tall to where the template fills the same part of a single camera's image.
    fn resized(&self, mut turns: JointTurns, before: f64) -> JointTurns {
        if let [camera] = self.rig.cameras.as_slice() {
            turns.root = camera.position().lerp(turns.root, height_m(&self.template) / before);
        }
        turns
    }

    /// Measures the height of a person whose feet stand on the floor, from one camera, metres; `None` for an implausible
    /// height, or when the camera does not look down on the feet.
    fn height_on_floor(&self, camera: &Camera, sightings: &[ShapeSighting]) -> Option<f64> {
        let body = |sighting: &ShapeSighting| skin_mesh(&self.surface, &self.model.to_pose(&sighting.fitted.turns)).0;
        let bodies: Vec<Vec<Vec3>> = sightings.iter().map(body).collect();
        let growth = growth_to_floor(camera, self.rig.world_up, self.config.settings.floor_m, &bodies)?;
        Some(growth * height_m(&self.template)).filter(|height| HEIGHTS_M.contains(height))
    }

    /// Tracks the person or searches whole images at once, without spreading the search over frame sets.
    fn find_at_once(&mut self, set: &FrameSet, others: &[Marks]) -> Result<Fitted, TrackError> {
        let pictures = self.check(set)?;
        let given = (self.config.search_crops, self.infers_always);
        (self.config.search_crops, self.infers_always) = (0, true);
        let found = self.follow_or_search(set, &pictures, others, true, &mut StageSeconds::default());
        (self.config.search_crops, self.infers_always) = given;
        found
    }

    /// Solves for the shape and the poses of all frame sets together, from landmarks and outlines, and finds the clothes.
    fn fit_shape_to_outlines(&mut self, sightings: &[ShapeSighting], fit: &mut ShapeFit) -> Result<(), TrackError> {
        let mut found = Vec::new();
        for ShapeSighting { set, fitted } in sightings {
            let mut fitted = fitted.clone();
            fitted.evidence.before = None;
            let problem = fitted.evidence.problem(&self.model, &self.config);
            let Some((turns, _)) = problem.solve(&fitted.turns, POSE_STEPS).filter(|(turns, _)| finite(turns)) else {
                continue;
            };
            fitted.turns = turns;
            let body = self.posed(set, &fitted, &fitted.turns);
            let masks = self.masks(set, &self.check(set)?, &mut fitted, &body).masks;
            found.push((set, fitted, masks));
        }
        // Most people wear shoes, and legs that reach down to the soles are too long.
        let shoes = Some(Shoes::default());
        self.solve_shape(&mut found, shoes, fit)?;
        fit.outfit = self.outfit(&found);
        if fit.outfit.shoes.is_none() {
            self.solve_shape(&mut found, None, fit)?;
        }
        tracing::debug!(?fit, "fitted the body to landmarks and outlines");
        Ok(())
    }

    /// Solves for the shape and the poses of a person in given shoes.
    fn solve_shape(
        &mut self,
        found: &mut [(&FrameSet, Fitted, Vec<Option<Mask>>)],
        shoes: Option<Shoes>,
        fit: &mut ShapeFit,
    ) -> Result<(), TrackError> {
        let space = ShapeSpace::new(&self.base);
        let mut shape: Vec<f64> =
            space.prior().iter().map(|(name, mean, _)| fit.factor(name).unwrap_or(*mean)).collect();
        self.surface = shod(&self.template, shoes);
        for _ in 0..self.config.shape_rounds {
            let given = |set: &FrameSet, masks: &[Option<Mask>], slot: usize| -> Option<Mask> {
                let own = masks.get(slot).cloned().flatten();
                own.or_else(|| set.frames.get(slot)?.as_ref()?.mask.clone().filter(|_| !self.config.masks))
            };
            let bare = BareBody::new(&self.template);
            let problems: Vec<ShapeSet<'_>> = found
                .iter()
                .map(|(set, fitted, masks)| {
                    let masks: Vec<Option<Mask>> = (0..masks.len()).map(|slot| given(set, masks, slot)).collect();
                    let masks: Vec<Option<&Mask>> = masks.iter().map(Option::as_ref).collect();
                    let mut outline = self.match_outline(set, fitted, &fitted.turns, &masks, 2.0);
                    outline.par_iter_mut().for_each(|point| bare.undress(point, &self.surface));
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
            self.surface = shod(&self.template, shoes);
            self.model = BodyModel::new(&self.template)?;
            fit.set(&space, &shape, &sigma, &self.template);
        }
        Ok(())
    }

    /// Returns the clothes that the masks of fitted frame sets show.
    fn outfit(&self, found: &[(&FrameSet, Fitted, Vec<Option<Mask>>)]) -> Outfit {
        let poses = found.iter().map(|(_, fitted, _)| self.model.to_pose(&fitted.turns)).collect();
        let views = found.iter().enumerate().flat_map(|(pose, (set, _, masks))| {
            let given = |slot: usize| set.frames.get(slot)?.as_ref()?.mask.as_ref().filter(|_| !self.config.masks);
            let masks =
                masks.iter().enumerate().filter_map(move |(slot, mask)| Some((slot, mask.as_ref().or(given(slot))?)));
            masks.map(move |(slot, mask)| MaskedView { camera: &self.rig.cameras[slot], pose, mask })
        });
        find_outfit(&self.template, &MaskedPoses { views: views.collect(), poses })
    }

    /// Replaces the template, and forgets the pose.
    ///
    /// # Errors
    /// Kind `Template` when it is not usable.
    pub fn set_template(&mut self, template: &Template) -> Result<(), TrackError> {
        self.model = BodyModel::new(template)?;
        (self.base, self.template) = (template.clone(), template.clone());
        self.surface = Arc::new(template.clone());
        self.reset();
        Ok(())
    }
}
