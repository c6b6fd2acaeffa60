//! People found in the images by the pose network.
//!
//! A `tracker::PoseEstimator` follows each person: landmarks of a network, masks gated by the body that is fitted to them, then the pose
//! whose outline lies on that of the masks and whose surface shows the brightness that each camera remembers of it. A network is run
//! again on a view only once the body has moved in it, and a lost person is searched for over several frame sets. `tracker::HandTracker`
//! adds fingers and the turn of the head.
//!
//! A person who is not found keeps the last state in the session, and the loss is counted there. A single camera measures only a person's
//! height, from where the feet stand. Shoes and a skirt are looked for once the shape is known.
//!
//! [`place`] is one person or a free place, and measures the shape from landmarks and outlines of eight frame sets; [`tracks`] assigns
//! people to places; [`views`] makes the masks; [`backgrounds`] keeps the empty scene up to date.

mod backgrounds;
mod place;
mod tracks;
mod views;

use std::sync::Arc;

use flyrig_body::{Outfit, Template};
use flyrig_tracker::{Background, HandConfig, HandTracker, PoseConfig, PoseEstimator, PoseNet, ShapeFit};
use flyrig_types::{Camera, FrameSet, Image, PersonId, Rig};

use super::{
    background::{BackgroundWatch, backgrounds},
    observation::{KnownPerson, Perception, PersonObservation, SeenPerson, ViewObservation},
    outfit_search::OutfitSearch,
};
use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    settings::{
        effort::Effort,
        perception::{Origin, PerceptionSettings},
    },
};

use place::{PersonPlace, PlaceEstimate};

/// Median residual at which the confidence in a pose is one half, pixels.
const HALF_CONFIDENT_PX: f64 = 12.0;

/// Perception that estimates shapes, poses and masks of one to four people.
#[derive(Debug)]
pub struct EstimatedPerception {
    places: Vec<PersonPlace>,
    rig: Rig,
    masks: Origin,
    watch: BackgroundWatch,
    /// Whether each camera's last image was uniform, one element per slot.
    blank: Vec<bool>,
    /// Whether shapes are measured, by two or more views.
    measures: bool,
    /// Whether shapes are measured in threads of their own.
    in_threads: bool,
    /// Rounds of matching outlines and texture at full effort.
    rounds: usize,
    /// Whether coverage and colours along outlines are solved for.
    mattes: bool,
}

impl EstimatedPerception {
    /// Looks for people with the cameras of `rig`, as many as the settings say. `plates` holds an image of the empty scene per slot, where
    /// there is one: masks then use the difference to it. Masks come from the frames where those of the settings are given. All people
    /// have the shape of `template` where the shape is given; else the shape is measured while a person is followed, and the person is
    /// known from then on.
    ///
    /// # Errors
    /// [`FusionError::Track`] when template, rig, network or a plate cannot be used, [`FusionError::Setting`] for a wrong key colour, or a
    /// network without depth before a single camera.
    pub fn new(
        rig: &Rig,
        template: &Template,
        settings: &PerceptionSettings,
        plates: &[Option<Image>],
    ) -> Result<Self, FusionError> {
        let config = PoseConfig {
            masks: settings.masks == Origin::Estimated,
            settings: settings.tracker.clone(),
            ..PoseConfig::default()
        };
        let rounds = config.outline_rounds;
        let mut estimator = PoseEstimator::new(network(settings, rig)?, template, rig, config)?;
        if settings.masks == Origin::Estimated {
            let known = backgrounds(&rig.cameras, settings, plates)?.into_iter().zip(&rig.cameras);
            let learnt = known.map(|(known, camera)| known.unwrap_or_else(|| Background::unknown(camera)));
            estimator.set_backgrounds(learnt.map(|background| Some(Arc::new(background))).collect());
        }
        let measures = settings.shape() == Origin::Estimated;
        estimator.keep_sightings(measures);
        let hands = match settings.hands {
            Origin::Given => None,
            Origin::Estimated => Some(HandTracker::new(template, rig, HandConfig::default())?),
        };
        let place = |index: usize| PersonPlace::new(PersonId(index as u32), estimator.clone(), hands.clone(), measures);
        Ok(Self {
            places: (0..settings.people).map(place).collect(),
            rig: rig.clone(),
            masks: settings.masks,
            watch: BackgroundWatch::default(),
            blank: vec![false; rig.cameras.len()],
            measures: measures && rig.cameras.len() > 1,
            in_threads: false,
            rounds,
            mattes: true,
        })
    }

    /// Starts with the shape and outfit of the first person, as an earlier session or an avatar has them. Where shapes are estimated, the
    /// person who comes is compared with it.
    ///
    /// # Errors
    /// [`FusionError::Track`] when the template cannot be used.
    pub fn know_shape(&mut self, template: &Template, outfit: Outfit) -> Result<(), FusionError> {
        if let Some(place) = self.places.first_mut() {
            (place.outfit, place.outfit_search) = (outfit, None);
            place.estimator.set_template(template)?;
            place.finish_measuring()?;
            // The first person to come may be another one.
            place.has_left = true;
        }
        Ok(())
    }

    /// Fits shapes to the people in a few frame sets ([`crate::SHAPE_SETS`], over [`crate::SHAPE_SECS`]) before the session is built, so
    /// that they are known from the first frame set on. Returns the fits of the people who were found.
    ///
    /// # Errors
    /// [`FusionError::Track`] when too few of the frame sets show a person; shapes stay as they were.
    pub fn learn_shapes(&mut self, sets: &[FrameSet]) -> Result<Vec<ShapeFit>, FusionError> {
        let mut fits = Vec::new();
        let mut taken = Vec::new();
        for place in &mut self.places {
            match place.estimator.fit_shape(sets, &taken) {
                Ok((fit, landmarks)) => {
                    place.outfit = fit.outfit;
                    fits.push(fit);
                    taken.push(landmarks);
                    place.finish_measuring()?;
                }
                Err(error) if fits.is_empty() => return Err(error.into()),
                // Fewer people than places.
                Err(_) => break,
            }
        }
        Ok(fits)
    }

    /// Looks for clothes on people whose shapes are given, in a few frame sets ([`crate::SHAPE_SETS`], over [`crate::SHAPE_SECS`]) before
    /// the session is built, so that they are known from the first frame set on. Otherwise they are found in the first seconds.
    ///
    /// # Errors
    /// As [`Perception::observe`].
    pub fn find_outfits(&mut self, sets: &[FrameSet]) -> Result<(), FusionError> {
        let mut searches = vec![OutfitSearch::default(); self.places.len()];
        for set in sets {
            for observation in self.observe(set, &mut StageTimes::default())? {
                let PersonObservation::Seen(seen) = observation else { continue };
                if let Some(index) = self.places.iter().position(|place| place.id == seen.person) {
                    searches[index].add(set, &seen);
                }
            }
        }
        for (place, mut search) in self.places.iter_mut().zip(searches) {
            search.finish(place.id, place.template(), &self.rig.cameras);
            (place.outfit, place.outfit_search) = (search.outfit(), Some(search));
            place.estimator.reset();
            place.estimator.wear(place.outfit)?;
        }
        Ok(())
    }

    /// Turns the estimates of people with a fitting shape into observations.
    fn observations(
        &mut self,
        set: &FrameSet,
        estimates: Vec<PlaceEstimate>,
        mut views: Vec<Vec<ViewObservation>>,
        fitting: &[bool],
        stages: &mut StageTimes,
    ) -> Result<Vec<PersonObservation>, FusionError> {
        let mut observations = Vec::new();
        for (index, estimate) in estimates.into_iter().enumerate().filter(|(index, _)| fitting[*index]) {
            let person = self.places[index].id;
            observations.push(match estimate {
                Err(reason) => {
                    self.places[index].hands.iter_mut().for_each(HandTracker::reset);
                    PersonObservation::Lost { person, reason }
                }
                Ok(estimate) => {
                    let confidence = 1.0 / (1.0 + (estimate.quality.residual_px / HALF_CONFIDENT_PX).powi(2));
                    let views = std::mem::take(&mut views[index]);
                    let pose = self.places[index].with_hands(set, estimate.pose, stages)?;
                    PersonObservation::Seen(SeenPerson { person, pose, confidence, views })
                }
            });
        }
        Ok(observations)
    }

    /// Continues the search for clothes on people whose shapes are given.
    fn search_outfits(&mut self, set: &FrameSet, observations: &[PersonObservation]) -> Result<(), FusionError> {
        for observation in observations {
            let PersonObservation::Seen(seen) = observation else { continue };
            let Some(place) = self.places.iter_mut().find(|place| place.id == seen.person) else { continue };
            let Some(search) = &mut place.outfit_search else { continue };
            let body = place.hands.as_ref().map_or(place.estimator.template(), HandTracker::template);
            let was_over = search.is_over();
            search.ingest(set, seen, body, &self.rig.cameras);
            place.outfit = search.outfit();
            if search.is_over() && !was_over {
                place.estimator.wear(place.outfit)?;
            }
        }
        Ok(())
    }
}

impl Perception for EstimatedPerception {
    fn measure_again(&mut self) -> bool {
        let known = self.places.iter_mut().filter(|place| self.measures && place.is_known);
        known.for_each(PersonPlace::renew_shape);
        self.measures
    }

    fn use_threads(&mut self) {
        self.in_threads = true;
    }

    fn move_camera(&mut self, slot: usize, camera: &Camera, plate: Option<&Image>) -> Result<(), FusionError> {
        let Some(known) = self.rig.cameras.get_mut(slot) else { return Ok(()) };
        known.clone_from(camera);
        let background = self.places.first().and_then(|place| place.estimator.background(slot));
        let moved = background.map(|background| background.after_move(camera, plate)).transpose()?.map(Arc::new);
        for place in &mut self.places {
            place.estimator.move_camera(slot, camera);
            place.hands.iter_mut().for_each(|hands| hands.move_camera(slot, camera));
            // All places share one background.
            let mut backgrounds = place.estimator.take_backgrounds();
            backgrounds[slot].clone_from(&moved);
            place.estimator.set_backgrounds(backgrounds);
        }
        Ok(())
    }

    fn set_effort(&mut self, effort: Effort) {
        self.mattes = effort.mattes;
        for place in &mut self.places {
            let config = place.estimator.config_mut();
            config.max_inferences = effort.looks;
            config.search_crops = effort.search_crops;
            config.outline_rounds = self.rounds.min(effort.rounds);
        }
    }

    fn is_measuring(&self) -> bool {
        self.places.iter().any(PersonPlace::is_being_measured)
    }

    fn people(&self) -> Vec<KnownPerson<'_>> {
        self.places.iter().filter(|place| place.is_known).map(PersonPlace::known_person).collect()
    }

    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError> {
        let start = std::time::Instant::now();
        self.watch_for_blank_images(set)?;
        let mut estimates = self.estimate(set, stages);
        self.remember(set, &estimates);
        stages.add("pose from images", start.elapsed());
        let before: Vec<(bool, u32)> = self.places.iter().map(|place| (place.is_known, place.shape)).collect();
        for (place, estimate) in self.places.iter_mut().zip(&estimates) {
            place.learn_shape(set, estimate.is_ok(), self.in_threads);
        }
        let views = self.views(set, &mut estimates, stages)?;
        if self.masks == Origin::Estimated && self.watch.is_due(self.are_learning()) {
            stages.time("background", || self.follow_backgrounds(set, &estimates, &views))?;
        }
        // A pose belongs to the shape that it was estimated with.
        let fitting: Vec<bool> =
            self.places.iter().zip(&before).map(|(place, before)| *before == (true, place.shape)).collect();
        let observations = self.observations(set, estimates, views, &fitting, stages)?;
        self.search_outfits(set, &observations)?;
        Ok(observations)
    }
}

/// Loads the landmark network of the settings.
fn network(settings: &PerceptionSettings, rig: &Rig) -> Result<PoseNet, FusionError> {
    let network = PoseNet::load(&settings.network, settings.masks == Origin::Estimated)?;
    if rig.cameras.len() < 2 && !network.sees_depth() {
        return Err(FusionError::Setting(format!(
            "perception.network: {} gives no depth, and a single camera needs it; leave the setting out, or add a camera",
            settings.network.display()
        )));
    }
    Ok(network)
}
