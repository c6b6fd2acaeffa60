//! People found in the images by the pose network.

use std::{collections::BTreeMap, sync::Arc, thread::JoinHandle, time::Duration};

use flyrig_body::{Outfit, Template, skin_mesh};
use flyrig_tracker::{
    Background, BackgroundEvent, BodyGate, HandConfig, HandTracker, Matte, PersonArea, PoseConfig, PoseEstimate,
    PoseEstimator, PoseNet, ShapeFit, ShapeSighting, TrackError, TrackErrorKind, is_blank, matte,
};
use flyrig_types::{Camera, Frame, FrameSet, Image, Mask, PersonId, Pose, Rig};
use rayon::prelude::*;

use super::background::{BackgroundWatch, backgrounds, report};
use super::colors::ClothesColors;
use super::outfits::OutfitSearch;
use super::split_mask::{PosedMesh, split_mask};
use super::{KnownPerson, Observation, Perception, SeenPerson, ViewObservation};
use crate::{Effort, FusionError, Origin, PerceptionSettings, StageTimes};

/// Frame sets that a person's shape is fitted to.
pub const SHAPE_SETS: usize = 8;
/// Time that they are spread over, seconds: a person who moves is seen in several poses.
pub const SHAPE_SECS: f64 = 1.5;
/// Median residual at which a pose is half believed, pixels.
const HALF_BELIEVED_PX: f64 = 12.0;
/// Two tracks whose landmarks are this close on average follow one person, metres.
const SAME_PERSON_M: f64 = 0.15;
/// Likeness of clothes from which a person who appears is one who was here before, 0..=1.
const SAME_CLOTHES: f64 = 0.6;
/// Sets from one look at a person's clothes to the next.
const CLOTHES_EVERY: u64 = 30;
/// A person who was not seen for so long has left, nanoseconds. Whoever comes then is measured again.
const LEFT_AFTER_NANOS: u64 = 3_000_000_000;
/// Somebody whose bones differ by more than this from those of the person before, as a mean share of their length, is another.
const OTHER_SHAPE: f64 = 0.03;

/// A shape that is being measured in a thread of its own.
type Measurement = JoinHandle<Result<(Template, ShapeFit), TrackError>>;

/// One person who is tracked, or a place for one who may come.
#[derive(Debug)]
struct Place {
    id: PersonId,
    estimator: PoseEstimator,
    /// Sightings for the shape fit and the last one's time, nanoseconds; `None` while the shape is not being measured.
    learning: Option<(Vec<ShapeSighting>, i64)>,
    /// Measurement of the sightings, while it goes on.
    measurement: Option<Measurement>,
    /// Whether a shape is known.
    known: bool,
    /// Whether the shape that is being measured replaces the known one, however little they differ.
    renews: bool,
    /// Number of the shape.
    shape: u32,
    outfit: Outfit,
    /// Where the shape is given.
    outfit_search: Option<OutfitSearch>,
    clothes: Option<ClothesColors>,
    seen: u64,
    /// Time since which nobody is seen; `None` while somebody is.
    missing_since: Option<i64>,
    /// Whether nobody is seen for [`LEFT_AFTER_NANOS`].
    has_left: bool,
    /// Fingers and head, where they are estimated.
    hands: Option<HandTracker>,
}

impl Place {
    /// The shape is known.
    fn know(&mut self) -> Result<(), TrackError> {
        (self.learning, self.known, self.renews) = (None, true, false);
        self.estimator.keep_sightings(false);
        self.estimator.wear(self.outfit)?;
        self.hands.as_mut().map_or(Ok(()), |hands| hands.set_template(self.estimator.template()))
    }

    /// Begins to measure the person who is followed.
    fn measure(&mut self) {
        (self.learning, self.measurement) = (Some((Vec::new(), i64::MIN)), None);
        self.estimator.forget_clothes();
        self.estimator.keep_sightings(true);
    }

    /// Goes on with the shape that was measured, or measures it again.
    fn take_measurement(&mut self, measured: Result<(Template, ShapeFit), TrackError>) {
        let taken = measured.and_then(|(template, fit)| {
            let is_other = self.known && bone_difference(self.estimator.template(), &template) > OTHER_SHAPE;
            match (self.known, is_other, self.renews) {
                (false, ..) => tracing::info!("person {} is {fit}", self.id),
                (.., true) => tracing::info!("person {} was measured again: {fit}", self.id),
                (_, true, _) => tracing::info!("person {} is somebody else now, {fit}", self.id),
                // Somebody who comes back keeps the shape, and with it the colours.
                _ => return Ok(()),
            }
            self.shape += u32::from(self.known);
            self.outfit = fit.outfit;
            self.estimator.take_shape(template)
        });
        if let Err(error) = taken {
            tracing::warn!(%error, "the shape of person {} is not known yet, trying again", self.id);
        } else if let Err(error) = self.know() {
            tracing::warn!(%error, "hands of person {} are not estimated", self.id);
            self.hands = None;
        }
    }

    /// The template that poses are for.
    fn template(&self) -> &Template {
        self.hands.as_ref().map_or(self.estimator.template(), HandTracker::template)
    }

    /// The body's pose with fingers and the head turned, where those are estimated.
    fn with_hands(&mut self, set: &FrameSet, pose: Pose, stages: &mut StageTimes) -> Result<Pose, TrackError> {
        let Some(hands) = &mut self.hands else { return Ok(pose) };
        let (pose, quality) = hands.estimate(set, &pose)?;
        let [net, fit] = quality.seconds.map(|seconds| Duration::from_secs_f64(seconds.max(0.0)));
        stages.add("  hands and face: networks", net);
        stages.add("  hands and face: fit", fit);
        stages.count("crops of hands", quality.crops[0] as u64);
        stages.count("crops of faces", quality.crops[1] as u64);
        stages.count("hands fitted", quality.fitted() as u64);
        stages.count("hands relaxed", 2 - quality.fitted() as u64);
        stages.count("heads turned by the face", u64::from(quality.head.views > 0));
        Ok(pose)
    }
}

/// Estimates shapes, poses and masks of one to four people.
#[derive(Debug)]
pub struct EstimatedPerception {
    places: Vec<Place>,
    rig: Rig,
    masks: Origin,
    watch: BackgroundWatch,
    /// Whether each camera's last image was uniform, by slot.
    blank: Vec<bool>,
    /// Whether shapes are measured, by two or more views.
    measures: bool,
    /// Whether they are measured in threads of their own.
    beside: bool,
    /// Rounds of matching outlines and texture with all the work.
    rounds: usize,
    mattes: bool,
}

impl EstimatedPerception {
    /// Looks for people with the cameras of `rig`, as many as the settings say. `plates` holds an image of the empty scene by
    /// slot, where there is one: masks then use the difference to it. Masks come from the frames where those of the settings
    /// are given. Everybody has the shape of `template` where the shape is given; else the shape is measured while a person is
    /// followed, and the person is known from then on.
    ///
    /// # Errors
    /// [`FusionError::Track`] when template, rig, network or a plate cannot be used, [`FusionError::Setting`] for a wrong key
    /// colour, or a network without depth before a single camera.
    pub fn new(
        rig: &Rig,
        template: &Template,
        settings: &PerceptionSettings,
        plates: &[Option<Image>],
    ) -> Result<Self, FusionError> {
        let config = PoseConfig {
            masks: settings.masks == Origin::Estimated,
            height_m: settings.height_m,
            floor_m: settings.floor_m,
            look_after_m: settings.look_after_m,
            ..PoseConfig::default()
        };
        let rounds = config.outline_rounds;
        let mut estimator = PoseEstimator::new(network(settings, rig)?, template, rig, config)?;
        if settings.masks == Origin::Estimated {
            let known = backgrounds(&rig.cameras, settings, plates)?.into_iter().zip(&rig.cameras);
            let learnt = known.map(|(known, camera)| known.unwrap_or_else(|| Background::unknown(camera)));
            estimator.set_backgrounds(learnt.map(|background| Some(Arc::new(background))).collect());
        }
        let learning = (settings.shape() == Origin::Estimated).then(|| (Vec::new(), i64::MIN));
        estimator.keep_sightings(learning.is_some());
        let hands = match settings.hands {
            Origin::Given => None,
            Origin::Estimated => Some(HandTracker::new(template, rig, HandConfig::default())?),
        };
        let place = |index: usize| Place {
            id: PersonId(index as u32),
            estimator: estimator.clone(),
            learning: learning.clone(),
            measurement: None,
            known: learning.is_none(),
            renews: false,
            shape: 0,
            outfit: Outfit::default(),
            outfit_search: learning.is_none().then(OutfitSearch::default),
            clothes: None,
            seen: 0,
            missing_since: None,
            has_left: false,
            hands: hands.clone(),
        };
        Ok(Self {
            places: (0..settings.people).map(place).collect(),
            rig: rig.clone(),
            masks: settings.masks,
            watch: BackgroundWatch::default(),
            blank: vec![false; rig.cameras.len()],
            measures: settings.shape() == Origin::Estimated && rig.cameras.len() > 1,
            beside: false,
            rounds,
            mattes: true,
        })
    }

    /// Starts with the shape and outfit of the first person, as an earlier session or an avatar has them. Where shapes are estimated, whoever
    /// comes is compared with it.
    ///
    /// # Errors
    /// [`FusionError::Track`] when the template cannot be used.
    pub fn know_shape(&mut self, template: &Template, outfit: Outfit) -> Result<(), FusionError> {
        if let Some(place) = self.places.first_mut() {
            (place.outfit, place.outfit_search) = (outfit, None);
            place.estimator.set_template(template)?;
            place.know()?;
            // Whoever comes first may be somebody else.
            place.has_left = true;
        }
        Ok(())
    }

    /// Fits shapes to the people in a few sets ([`SHAPE_SETS`], over [`SHAPE_SECS`]) before the session is built, so that they
    /// are known from the first set on. Returns the fits of those who were found.
    ///
    /// # Errors
    /// [`FusionError::Track`] when too few of the sets show a person; shapes stay as they were.
    pub fn learn_shapes(&mut self, sets: &[FrameSet]) -> Result<Vec<ShapeFit>, FusionError> {
        let mut fits = Vec::new();
        let mut taken = Vec::new();
        for place in &mut self.places {
            match place.estimator.fit_shape(sets, &taken) {
                Ok((fit, landmarks)) => {
                    place.outfit = fit.outfit;
                    fits.push(fit);
                    taken.push(landmarks);
                    place.know()?;
                }
                Err(error) if fits.is_empty() => return Err(error.into()),
                // Fewer people than places.
                Err(_) => break,
            }
        }
        Ok(fits)
    }

    /// Estimates everybody in a set, by place: those who are followed first, then one search for those who are not.
    fn estimate(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Vec<Result<PoseEstimate, String>> {
        let mut estimates: Vec<Result<PoseEstimate, String>> =
            self.places.iter().map(|_| Err("nobody is here".to_owned())).collect();
        let mut order: Vec<usize> = (0..self.places.len()).collect();
        order.sort_by_key(|&index| self.places[index].estimator.sets_lost() > 0);
        let mut may_search = true;
        for index in order {
            let others: Vec<_> = (0..self.places.len())
                .filter(|&other| other != index && self.places[other].estimator.sets_lost() == 0)
                .filter_map(|other| self.places[other].estimator.predicted_landmarks(set.master_nanos))
                .collect();
            let was_lost = self.places[index].estimator.sets_lost() > 0;
            let place = &mut self.places[index];
            let estimate = place.estimator.estimate_among(set, &others, may_search);
            may_search &= !was_lost;
            if let Ok(estimate) = &estimate {
                count_stages(estimate, stages);
            }
            estimates[index] = match estimate {
                Ok(estimate) if !estimate.pose.is_valid() => {
                    Err("the pose holds numbers that are not finite".to_owned())
                }
                Ok(estimate) if was_lost && self.places.len() > 1 => self.recognise(index, set, estimate),
                Ok(estimate) => Ok(estimate),
                Err(error) => Err(error.to_string()),
            };
        }
        self.part_twins(set.master_nanos, &mut estimates);
        estimates
    }

    /// Gives somebody who was just found to the place whose clothes are most alike.
    fn recognise(&mut self, index: usize, set: &FrameSet, found: PoseEstimate) -> Result<PoseEstimate, String> {
        let Some(colors) = ClothesColors::of(set, &self.own_masks(set, &found)) else { return Ok(found) };
        let lost = |place: &Place| place.estimator.sets_lost() > 0;
        let likeness = |place: &Place| place.clothes.as_ref().map(|clothes| clothes.likeness(&colors));
        let own = likeness(&self.places[index]);
        let known = self.places.iter().enumerate().filter(|(other, place)| *other != index && lost(place));
        let best = known
            .filter_map(|(other, place)| Some((other, likeness(place)?)))
            .filter(|(_, likeness)| *likeness >= SAME_CLOTHES.max(own.unwrap_or(0.0)))
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(other, _)| other);
        // A stranger takes a free place rather than that of somebody who has left.
        let is_stranger = own.is_some_and(|own| own < SAME_CLOTHES);
        let free = || self.places.iter().position(|place| place.clothes.is_none() && lost(place));
        let Some(other) = best.or_else(|| is_stranger.then(free).flatten()) else { return Ok(found) };
        let (low, high) = self.places.split_at_mut(index.max(other));
        let (to, from) = if other < index { (&mut low[other], &mut high[0]) } else { (&mut high[0], &mut low[index]) };
        to.estimator.take_track(&mut from.estimator);
        Err("this is somebody else".to_owned())
    }

    /// Two tracks on one person: the one that explains the images less well is given up.
    fn part_twins(&mut self, nanos: i64, estimates: &mut [Result<PoseEstimate, String>]) {
        for a in 0..self.places.len() {
            for b in a + 1..self.places.len() {
                let (Ok(first), Ok(second)) = (&estimates[a], &estimates[b]) else { continue };
                let marks = |index: usize| self.places[index].estimator.predicted_landmarks(nanos);
                let (Some(x), Some(y)) = (marks(a), marks(b)) else { continue };
                let distance = x.iter().zip(&y).map(|(x, y)| x.distance(*y)).sum::<f64>() / x.len() as f64;
                if distance < SAME_PERSON_M {
                    let worse = if first.quality.residual_px > second.quality.residual_px { a } else { b };
                    self.places[worse].estimator.drop_track();
                    estimates[worse] = Err("another track follows the same person".to_owned());
                }
            }
        }
    }

    /// Masks of an estimate by slot, or those of the frames where masks are given.
    fn own_masks<'a>(&self, set: &'a FrameSet, estimate: &'a PoseEstimate) -> Vec<Option<&'a Mask>> {
        let of_slot = |slot: usize| match self.masks {
            Origin::Given => set.frames[slot].as_ref().and_then(|frame| frame.mask.as_ref()),
            Origin::Estimated => estimate.masks.get(slot).and_then(Option::as_ref),
        };
        (0..set.frames.len()).map(of_slot).collect()
    }

    /// Collects sightings of people whose shape is not known, and fits it once there are enough.
    fn learn(&mut self, set: &FrameSet, estimates: &[Result<PoseEstimate, String>]) {
        let every_nanos = (SHAPE_SECS * 1e9 / SHAPE_SETS as f64) as i64;
        for (place, estimate) in self.places.iter_mut().zip(estimates) {
            if let Some(measurement) = place.measurement.take_if(|measurement| measurement.is_finished()) {
                let panicked = "measuring the person panicked; please report it with the log".to_owned();
                let panicked = TrackError { kind: TrackErrorKind::Lost, message: panicked };
                place.take_measurement(measurement.join().unwrap_or(Err(panicked)));
            }
            let (Some((sightings, last)), Ok(_)) = (&mut place.learning, estimate) else { continue };
            if place.measurement.is_some() || set.master_nanos.saturating_sub(*last) < every_nanos {
                continue;
            }
            let Some(sighting) = place.estimator.take_sighting() else { continue };
            sightings.push(sighting);
            *last = set.master_nanos;
            if sightings.len() < SHAPE_SETS {
                continue;
            }
            let sightings = std::mem::take(sightings);
            let estimator = place.estimator.clone();
            let measure = move || estimator.measure_shape(&sightings);
            if self.beside {
                match std::thread::Builder::new().name("shape".to_owned()).spawn(measure) {
                    Ok(thread) => place.measurement = Some(thread),
                    Err(error) => tracing::warn!(%error, "person {} cannot be measured, trying again", place.id),
                }
            } else {
                place.take_measurement(measure());
            }
        }
    }

    /// Remembers the clothes of people who are seen, and reports who left.
    fn remember(&mut self, set: &FrameSet, estimates: &[Result<PoseEstimate, String>]) {
        for (index, estimate) in estimates.iter().enumerate().take(self.places.len()) {
            match estimate {
                Ok(estimate) => {
                    let masks = self.own_masks(set, estimate);
                    let place = &mut self.places[index];
                    if place.seen.is_multiple_of(CLOTHES_EVERY)
                        && let Some(colors) = ClothesColors::of(set, &masks)
                    {
                        place.clothes = Some(colors);
                    }
                    place.seen += 1;
                    place.missing_since = None;
                    if std::mem::take(&mut place.has_left) && place.known && self.measures {
                        place.measure();
                    }
                }
                Err(_) => {
                    let place = &mut self.places[index];
                    let since = *place.missing_since.get_or_insert(set.master_nanos);
                    if !place.has_left && since.abs_diff(set.master_nanos) >= LEFT_AFTER_NANOS {
                        place.has_left = true;
                        if place.known && place.seen > 0 {
                            tracing::info!("person {} has left", place.id);
                        }
                    }
                }
            }
        }
    }
}

/// The landmark network of the settings.
fn network(settings: &PerceptionSettings, rig: &Rig) -> Result<PoseNet, FusionError> {
    if settings.network.as_os_str().is_empty() {
        return Ok(PoseNet::embedded()?);
    }
    let network = PoseNet::from_description(&settings.network)?;
    if rig.cameras.len() < 2 && !network.sees_depth() {
        return Err(FusionError::Setting(format!(
            "perception.network: {} gives no depth, and a single camera needs it; leave the setting out, or add a camera",
            settings.network.display()
        )));
    }
    Ok(network)
}

/// Mean difference of the bones' lengths, as a share of the mean length; infinite for templates of other joints.
fn bone_difference(a: &Template, b: &Template) -> f64 {
    let lengths = |template: &Template| -> Vec<f64> {
        let joints = template.skeleton.joints().iter().filter(|joint| joint.parent.is_some());
        joints.map(|joint| joint.rest_translation.length()).collect()
    };
    let (a, b) = (lengths(a), lengths(b));
    if a.len() != b.len() || a.is_empty() {
        return f64::INFINITY;
    }
    a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f64>() / a.iter().sum::<f64>()
}

/// Adds the run times of an estimate's parts.
fn count_stages(estimate: &PoseEstimate, stages: &mut StageTimes) {
    let seconds = estimate.quality.seconds;
    for (stage, seconds) in [
        ("  search", seconds.search),
        ("  network", seconds.net),
        ("  fit to landmarks", seconds.triangulate + seconds.fit),
        ("  masks", seconds.masks),
        ("  fit to outlines", seconds.outline),
    ] {
        stages.add(stage, Duration::from_secs_f64(seconds.max(0.0)));
    }
    stages.count("pose network inferences", estimate.quality.inferred as u64);
}

impl Perception for EstimatedPerception {
    fn measure_again(&mut self) -> bool {
        let known = self.places.iter_mut().filter(|place| self.measures && place.known);
        known.for_each(|place| {
            place.renews = true;
            place.measure();
        });
        self.measures
    }

    fn work_beside(&mut self) {
        self.beside = true;
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

    fn people(&self) -> Vec<KnownPerson<'_>> {
        let known = self.places.iter().filter(|place| place.known);
        known
            .map(|place| KnownPerson {
                person: place.id,
                // Another one once clothes are found on a given shape.
                shape: place.shape + u32::from(place.outfit_search.is_some() && !place.outfit.is_bare()),
                template: place.template(),
                outfit: place.outfit,
            })
            .collect()
    }

    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<Observation>, FusionError> {
        let start = std::time::Instant::now();
        self.watch_for_blank_images(set)?;
        let mut estimates = self.estimate(set, stages);
        self.remember(set, &estimates);
        stages.add("pose from images", start.elapsed());
        let before: Vec<(bool, u32)> = self.places.iter().map(|place| (place.known, place.shape)).collect();
        self.learn(set, &estimates);
        let mut views = self.views(set, &mut estimates, stages)?;
        let known = self.places.first().map(|place| &place.estimator);
        let mut known = (0..self.rig.cameras.len()).filter_map(|slot| known?.background(slot));
        if self.masks == Origin::Estimated && self.watch.is_due(known.any(Background::is_learning)) {
            stages.time("background", || self.follow_backgrounds(set, &estimates, &views))?;
        }
        let mut observations = Vec::new();
        // A pose belongs to the shape that it was estimated with.
        let fitting: Vec<bool> =
            self.places.iter().zip(&before).map(|(place, before)| *before == (true, place.shape)).collect();
        for (index, estimate) in estimates.into_iter().enumerate().filter(|(index, _)| fitting[*index]) {
            let person = self.places[index].id;
            observations.push(match estimate {
                Err(reason) => {
                    self.places[index].hands.iter_mut().for_each(HandTracker::reset);
                    Observation::Lost { person, reason }
                }
                Ok(estimate) => {
                    let confidence = 1.0 / (1.0 + (estimate.quality.residual_px / HALF_BELIEVED_PX).powi(2));
                    let views = std::mem::take(&mut views[index]);
                    let pose = self.places[index].with_hands(set, estimate.pose, stages)?;
                    Observation::Seen(SeenPerson { person, pose, confidence, views })
                }
            });
        }
        for observation in &observations {
            let Observation::Seen(seen) = observation else { continue };
            let Some(place) = self.places.iter_mut().find(|place| place.id == seen.person) else { continue };
            if let Some(search) = &mut place.outfit_search {
                let body = place.hands.as_ref().map_or(place.estimator.template(), HandTracker::template);
                let was_over = search.is_over();
                search.take(set, seen, body, &self.rig.cameras);
                place.outfit = search.outfit();
                if search.is_over() && !was_over {
                    place.estimator.wear(place.outfit)?;
                }
            }
        }
        Ok(observations)
    }
}

impl EstimatedPerception {
    /// Looks for clothes on people whose shapes are given, in a few sets ([`SHAPE_SETS`], over [`SHAPE_SECS`]) before the session is
    /// built, so that they are known from the first set on. Otherwise they are found in the first seconds.
    ///
    /// # Errors
    /// Those of [`Perception::observe`].
    pub fn find_outfits(&mut self, sets: &[FrameSet]) -> Result<(), FusionError> {
        let mut searches = vec![OutfitSearch::default(); self.places.len()];
        for set in sets {
            for observation in self.observe(set, &mut StageTimes::default())? {
                let Observation::Seen(seen) = observation else { continue };
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

    /// Reports cameras whose images have become uniform, and those that see again.
    fn watch_for_blank_images(&mut self, set: &FrameSet) -> Result<(), FusionError> {
        for ((frame, camera), was) in set.frames.iter().zip(&self.rig.cameras).zip(&mut self.blank) {
            let Some(frame) = frame else { continue };
            let now = is_blank(&frame.image)?;
            match (std::mem::replace(was, now), now) {
                (false, true) => {
                    let camera = &camera.id;
                    tracing::warn!(
                        "camera {camera}: the image is uniform, so it is left out; uncover the lens, or check exposure and light"
                    );
                }
                (true, false) => tracing::info!("camera {}: the image is no longer uniform", camera.id),
                _ => {}
            }
        }
        Ok(())
    }

    /// Lets the backgrounds follow the light where nobody stands.
    fn follow_backgrounds(
        &mut self,
        set: &FrameSet,
        estimates: &[Result<PoseEstimate, String>],
        views: &[Vec<ViewObservation>],
    ) -> Result<(), FusionError> {
        let bodies: Vec<_> = (self.places.iter())
            .zip(estimates)
            .zip(views)
            .filter_map(|((place, estimate), views)| {
                let (template, pose) = (place.estimator.template(), &estimate.as_ref().ok()?.pose);
                Some((template.triangles.clone(), skin_mesh(template, pose).0, views))
            })
            .collect();
        // Somebody who was lost a moment ago may stand anywhere, and must not become background.
        let is_missing = |place: &Place| place.missing_since.is_some() && !place.has_left && place.seen > 0;
        if bodies.is_empty() || self.places.iter().any(is_missing) {
            return Ok(());
        }
        // Everybody shares them: with one owner they need not be copied.
        let places = self.places.iter_mut();
        let mut taken = places.fold(Vec::new(), |_, place| place.estimator.take_backgrounds());
        let slots: Vec<usize> = set.present().map(|(slot, _)| slot).collect();
        let areas = |slot: usize, camera| -> Vec<PersonArea<'_>> {
            let present = slots.iter().position(|present| *present == slot);
            let areas = bodies.iter().filter_map(|(sides, points, views)| {
                let mask = present.and_then(|index| views.get(index)?.mask.as_ref());
                Some(PersonArea { gate: BodyGate::new(camera, points, sides)?, mask })
            });
            areas.collect()
        };
        let cameras = self.rig.cameras.par_iter().zip(&set.frames).zip(&self.blank).enumerate();
        let events: Result<Vec<Vec<BackgroundEvent>>, TrackError> = (taken.par_iter_mut().zip(cameras))
            .map(|(background, (slot, ((camera, frame), is_blank)))| match (background, frame, is_blank) {
                (Some(background), Some(frame), false) => {
                    Arc::make_mut(background).update(&frame.image, &areas(slot, camera))
                }
                _ => Ok(Vec::new()),
            })
            .collect();
        self.places.iter_mut().for_each(|place| place.estimator.set_backgrounds(taken.clone()));
        events?.iter().zip(&self.rig.cameras).for_each(|(events, camera)| report(camera, events));
        Ok(())
    }

    /// Solves for coverage and colour along the outlines of all masks; by slot and place.
    fn mattes(
        &self,
        set: &FrameSet,
        seen: &[usize],
        estimates: &mut [Result<PoseEstimate, String>],
    ) -> Result<BTreeMap<(usize, usize), Matte>, FusionError> {
        let mut masks = Vec::new();
        for (slot, frame) in set.present() {
            for &index in seen {
                let Ok(estimate) = &mut estimates[index] else { continue };
                if let Some(mask) = estimate.masks.get_mut(slot).and_then(Option::take) {
                    masks.push(((slot, index), frame, mask));
                }
            }
        }
        let solve = |((slot, index), frame, mask): ((usize, usize), &Arc<Frame>, Mask)| {
            let background = self.places[index].estimator.background(slot);
            Ok(((slot, index), matte(&frame.image, &mask, background)?))
        };
        masks.into_par_iter().map(solve).collect()
    }

    /// The views of everybody, by place, then by present frame. Masks of several people are divided by their bodies.
    fn views(
        &self,
        set: &FrameSet,
        estimates: &mut [Result<PoseEstimate, String>],
        stages: &mut StageTimes,
    ) -> Result<Vec<Vec<ViewObservation>>, FusionError> {
        let seen: Vec<usize> = (0..estimates.len()).filter(|&index| estimates[index].is_ok()).collect();
        let mut views: Vec<Vec<ViewObservation>> = estimates.iter().map(|_| Vec::new()).collect();
        let mut meshes = Vec::new();
        if seen.len() > 1 {
            for (place, estimate) in self.places.iter().zip(estimates.iter()) {
                let Ok(estimate) = estimate else { continue };
                let template = place.estimator.template();
                let vertices = skin_mesh(template, &estimate.pose).0;
                meshes.push(PosedMesh { vertices, triangles: &template.triangles });
            }
        }
        let mut mattes = match self.masks {
            Origin::Estimated if self.mattes => stages.time("matte", || self.mattes(set, &seen, estimates))?,
            _ => BTreeMap::new(),
        };
        for (slot, frame) in set.present() {
            let mut own = Vec::new();
            for &index in &seen {
                let Ok(estimate) = &mut estimates[index] else { continue };
                let quality = estimate.quality.views.get(slot);
                let overlap = quality.and_then(|quality| quality.mask_overlap).unwrap_or(0.0);
                let confidence = if self.masks == Origin::Given { 1.0 } else { overlap };
                let (mask, edge_colors) = match self.masks {
                    Origin::Given => (frame.mask.clone(), Vec::new()),
                    Origin::Estimated => match mattes.remove(&(slot, index)) {
                        Some(Matte { mask, colors }) => (Some(mask), colors),
                        None => (estimate.masks.get_mut(slot).and_then(Option::take), Vec::new()),
                    },
                };
                let landmarks = estimate.keypoints.get_mut(slot).and_then(Option::take);
                own.push(ViewObservation { landmarks, edge_colors, ..ViewObservation::of_mask(mask, confidence) });
            }
            if let (2.., Some(camera)) = (own.len(), self.rig.cameras.get(slot)) {
                let everybody = union(own.iter().filter_map(|view| view.mask.as_ref()));
                if let Some(everybody) = everybody {
                    let parts = stages.time("divide masks", || split_mask(camera, &everybody, &meshes));
                    for (view, (part, others)) in own.iter_mut().zip(parts) {
                        view.mask = view.mask.is_some().then_some(part);
                        view.others = Some(others);
                    }
                }
            }
            for (index, view) in seen.iter().zip(own) {
                views[*index].push(view);
            }
        }
        Ok(views)
    }
}

/// Coverage by anybody; `None` without a mask, or where sizes differ.
fn union<'a>(mut masks: impl Iterator<Item = &'a Mask>) -> Option<Mask> {
    let first = masks.next()?;
    let mut coverage = first.coverage().to_vec();
    for mask in masks.filter(|mask| (mask.width(), mask.height()) == (first.width(), first.height())) {
        for (all, one) in coverage.iter_mut().zip(mask.coverage()) {
            *all = (*all).max(*one);
        }
    }
    Mask::new(first.width(), first.height(), coverage).ok()
}
