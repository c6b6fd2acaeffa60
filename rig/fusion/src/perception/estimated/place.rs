//! One person who is tracked, or a free place for one who may come.

use std::thread::JoinHandle;

use flyrig_body::{Outfit, Template};
use flyrig_tracker::{HandTracker, PoseEstimate, PoseEstimator, ShapeFit, ShapeSighting, TrackError, TrackErrorKind};
use flyrig_types::{FrameSet, PersonId, Pose};

use super::super::{
    clothes_colors::ClothesColors,
    outfit_search::OutfitSearch,
    sampling::{SHAPE_EVERY_NANOS, SHAPE_SETS},
};
use crate::{health::stage_times::StageTimes, perception::observation::KnownPerson};

/// Smallest difference between the bones of two people, as a mean share of their length.
const OTHER_SHAPE: f64 = 0.03;

/// Estimate of the person in one place, or the reason why there is none.
pub(super) type PlaceEstimate = Result<PoseEstimate, String>;

/// Shape that is being measured in a thread of its own.
type Measurement = JoinHandle<Result<(Template, ShapeFit), TrackError>>;

/// Sightings for a shape fit.
#[derive(Debug, Clone)]
pub(super) struct Sightings {
    collected: Vec<ShapeSighting>,
    /// Time of the last one, nanoseconds.
    last_nanos: i64,
}

impl Default for Sightings {
    fn default() -> Self {
        Self { collected: Vec::new(), last_nanos: i64::MIN }
    }
}

/// Tracker of one person, with the state that distinguishes the person from others.
///
/// The state of perception stays here when the session rebuilds the person's subject.
#[derive(Debug)]
pub(super) struct PersonPlace {
    pub id: PersonId,
    pub estimator: PoseEstimator,
    /// Sightings for the shape fit; `None` while the shape is not being measured.
    sightings: Option<Sightings>,
    /// Measurement of the sightings, while it goes on.
    measurement: Option<Measurement>,
    /// Whether a shape is known.
    pub is_known: bool,
    /// Whether the shape that is being measured replaces the known one, however little they differ.
    renews: bool,
    /// Number of the shape.
    pub shape: u32,
    pub outfit: Outfit,
    /// Search for clothes, where the shape is given.
    pub outfit_search: Option<OutfitSearch>,
    /// Clothes of the person at the last look.
    pub clothes: Option<ClothesColors>,
    /// Frame sets in which the person was seen.
    pub seen: u64,
    /// Time since which the person is not seen, nanoseconds; `None` while it is.
    pub missing_since: Option<i64>,
    /// Whether the person has been missing for long enough to have left.
    pub has_left: bool,
    /// Tracker of fingers and head, where they are estimated.
    pub hands: Option<HandTracker>,
}

impl PersonPlace {
    /// Creates a free place. The shape is given unless it is to be measured.
    pub fn new(id: PersonId, estimator: PoseEstimator, hands: Option<HandTracker>, measures: bool) -> Self {
        Self {
            id,
            estimator,
            sightings: measures.then(Sightings::default),
            measurement: None,
            is_known: !measures,
            renews: false,
            shape: 0,
            outfit: Outfit::default(),
            outfit_search: (!measures).then(OutfitSearch::default),
            clothes: None,
            seen: 0,
            missing_since: None,
            has_left: false,
            hands,
        }
    }

    /// Returns whether no person is followed here.
    pub fn is_lost(&self) -> bool {
        self.estimator.sets_lost() > 0
    }

    /// Returns whether a person is seen here whose shape is not known yet.
    pub fn is_being_measured(&self) -> bool {
        !self.is_known && self.seen > 0 && self.missing_since.is_none()
    }

    /// Returns the person as the session knows it.
    pub fn known_person(&self) -> KnownPerson<'_> {
        KnownPerson {
            person: self.id,
            // Another number once clothes are found on a given shape.
            shape: self.shape + u32::from(self.outfit_search.is_some() && !self.outfit.is_bare()),
            template: self.template(),
            outfit: self.outfit,
        }
    }

    /// Returns the template that poses are for.
    pub fn template(&self) -> &Template {
        self.hands.as_ref().map_or(self.estimator.template(), HandTracker::template)
    }

    /// Ends the measurement: the estimator's shape is the person's.
    pub fn finish_measuring(&mut self) -> Result<(), TrackError> {
        (self.sightings, self.is_known, self.renews) = (None, true, false);
        self.estimator.keep_sightings(false);
        self.estimator.wear(self.outfit)?;
        self.hands.as_mut().map_or(Ok(()), |hands| hands.set_template(self.estimator.template()))
    }

    /// Begins to measure the person who is followed.
    pub fn begin_measuring(&mut self) {
        (self.sightings, self.measurement) = (Some(Sightings::default()), None);
        self.estimator.forget_clothes();
        self.estimator.keep_sightings(true);
    }

    /// Begins to measure the person again, to replace the known shape.
    pub fn renew_shape(&mut self) {
        self.renews = true;
        self.begin_measuring();
    }

    /// Collects a sighting for the shape fit, and fits the shape once there are enough: here, or in a thread of its own.
    pub fn learn_shape(&mut self, set: &FrameSet, is_seen: bool, in_thread: bool) {
        self.join_measurement();
        let Some(sightings) = self.sightings.as_mut().filter(|_| is_seen) else { return };
        let is_soon = set.master_nanos.saturating_sub(sightings.last_nanos) < SHAPE_EVERY_NANOS;
        if self.measurement.is_some() || is_soon {
            return;
        }
        let Some(sighting) = self.estimator.take_sighting() else { return };
        sightings.collected.push(sighting);
        sightings.last_nanos = set.master_nanos;
        if sightings.collected.len() < SHAPE_SETS {
            return;
        }
        let collected = std::mem::take(&mut sightings.collected);
        let estimator = self.estimator.clone();
        let measure = move || estimator.measure_shape(&collected);
        if !in_thread {
            return self.take_measurement(measure());
        }
        match std::thread::Builder::new().name("shape".to_owned()).spawn(measure) {
            Ok(thread) => self.measurement = Some(thread),
            Err(error) => tracing::warn!(%error, "person {} cannot be measured, trying again", self.id),
        }
    }

    /// Takes the result of a measurement that has ended.
    fn join_measurement(&mut self) {
        if let Some(measurement) = self.measurement.take_if(|measurement| measurement.is_finished()) {
            let panicked = "measuring the person panicked; please report it with the log".to_owned();
            let panicked = TrackError { kind: TrackErrorKind::Lost, message: panicked };
            self.take_measurement(measurement.join().unwrap_or(Err(panicked)));
        }
    }

    /// Continues with the measured shape, or measures it again after an error.
    fn take_measurement(&mut self, measured: Result<(Template, ShapeFit), TrackError>) {
        let taken = measured.and_then(|(template, fit)| {
            let is_other = self.is_known && bone_difference(self.estimator.template(), &template) > OTHER_SHAPE;
            match (self.is_known, is_other, self.renews) {
                (false, ..) => tracing::info!("person {} is {fit}", self.id),
                (.., true) => tracing::info!("person {} was measured again: {fit}", self.id),
                (_, true, _) => tracing::info!("person {} is another person now, {fit}", self.id),
                // A person who comes back keeps the shape, and with it the colours.
                _ => return Ok(()),
            }
            self.shape += u32::from(self.is_known);
            self.outfit = fit.outfit;
            self.estimator.take_shape(template)
        });
        if let Err(error) = taken {
            tracing::warn!(%error, "the shape of person {} is not known yet, trying again", self.id);
        } else if let Err(error) = self.finish_measuring() {
            tracing::warn!(%error, "hands of person {} are not estimated", self.id);
            self.hands = None;
        }
    }

    /// Returns the body's pose with the fingers and the turn of the head, where those are estimated.
    pub fn with_hands(&mut self, set: &FrameSet, pose: Pose, stages: &mut StageTimes) -> Result<Pose, TrackError> {
        let Some(hands) = &mut self.hands else { return Ok(pose) };
        let (pose, quality) = hands.estimate(set, &pose)?;
        let [net, fit] = quality.seconds.map(flyrig_types::saturating_secs);
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

/// Returns the mean difference of the bones' lengths as a share of their mean length; infinite for templates with other joints.
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
