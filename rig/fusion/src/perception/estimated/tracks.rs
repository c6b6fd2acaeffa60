//! Assignment of people to places: following, searching, recognizing and losing them.

use flyrig_tracker::PoseEstimate;
use flyrig_types::{FrameSet, Mask};

use super::{
    EstimatedPerception,
    place::{PersonPlace, PlaceEstimate},
};
use crate::{health::stage_times::StageTimes, perception::clothes_colors::ClothesColors, settings::perception::Origin};

/// Largest mean distance between the landmarks of two tracks that follow one person, metres.
const SAME_PERSON_M: f64 = 0.15;
/// Least likeness of clothes at which a person who appears is one who was here before, 0..=1.
const SAME_CLOTHES: f64 = 0.6;
/// Frame sets from one look at a person's clothes to the next.
const CLOTHES_EVERY: u64 = 30;
/// Time after which a person who is not seen has left, nanoseconds. The next person is measured again.
const LEFT_AFTER_NANOS: u64 = 3_000_000_000;

impl EstimatedPerception {
    /// Estimates all people in a frame set, one element per place: those who are followed first, then one search for the others.
    pub(super) fn estimate(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Vec<PlaceEstimate> {
        let mut estimates: Vec<PlaceEstimate> =
            self.places.iter().map(|_| Err("no person is here".to_owned())).collect();
        let mut order: Vec<usize> = (0..self.places.len()).collect();
        order.sort_by_key(|&index| self.places[index].is_lost());
        let mut may_search = true;
        for index in order {
            let others: Vec<_> = (0..self.places.len())
                .filter(|&other| other != index && !self.places[other].is_lost())
                .filter_map(|other| self.places[other].estimator.predicted_landmarks(set.master_nanos))
                .collect();
            let was_lost = self.places[index].is_lost();
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
                Ok(estimate) if was_lost && self.places.len() > 1 => self.recognize(index, set, estimate),
                Ok(estimate) => Ok(estimate),
                Err(error) => Err(error.to_string()),
            };
        }
        self.drop_duplicates(set.master_nanos, &mut estimates);
        estimates
    }

    /// Gives a person who was just found to the place whose clothes are most alike.
    fn recognize(&mut self, index: usize, set: &FrameSet, found: PoseEstimate) -> PlaceEstimate {
        let Some(colors) = ClothesColors::of(set, &self.own_masks(set, &found)) else { return Ok(found) };
        let likeness = |place: &PersonPlace| place.clothes.as_ref().map(|clothes| clothes.likeness(&colors));
        let own = likeness(&self.places[index]);
        let known = self.places.iter().enumerate().filter(|(other, place)| *other != index && place.is_lost());
        let best = known
            .filter_map(|(other, place)| Some((other, likeness(place)?)))
            .filter(|(_, likeness)| *likeness >= SAME_CLOTHES.max(own.unwrap_or(0.0)))
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(other, _)| other);
        // A stranger takes a free place rather than that of a person who has left.
        let is_stranger = own.is_some_and(|own| own < SAME_CLOTHES);
        let free = || self.places.iter().position(|place| place.clothes.is_none() && place.is_lost());
        let Some(other) = best.or_else(|| is_stranger.then(free).flatten()) else { return Ok(found) };
        let (low, high) = self.places.split_at_mut(index.max(other));
        let (to, from) = if other < index { (&mut low[other], &mut high[0]) } else { (&mut high[0], &mut low[index]) };
        to.estimator.take_track(&mut from.estimator);
        Err("this is another person".to_owned())
    }

    /// Drops one of two tracks that follow the same person: the one that explains the images less well.
    fn drop_duplicates(&mut self, nanos: i64, estimates: &mut [PlaceEstimate]) {
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

    /// Returns the masks of an estimate, one element per slot, or those of the frames where masks are given.
    fn own_masks<'a>(&self, set: &'a FrameSet, estimate: &'a PoseEstimate) -> Vec<Option<&'a Mask>> {
        let of_slot = |slot: usize| match self.masks {
            Origin::Given => set.frames[slot].as_ref().and_then(|frame| frame.mask.as_ref()),
            Origin::Estimated => estimate.masks.get(slot).and_then(Option::as_ref),
        };
        (0..set.frames.len()).map(of_slot).collect()
    }

    /// Remembers the clothes of people who are seen, and reports people who left.
    pub(super) fn remember(&mut self, set: &FrameSet, estimates: &[PlaceEstimate]) {
        for (index, estimate) in estimates.iter().enumerate().take(self.places.len()) {
            let Ok(estimate) = estimate else {
                note_missing(&mut self.places[index], set.master_nanos);
                continue;
            };
            let masks = self.own_masks(set, estimate);
            let place = &mut self.places[index];
            if place.seen.is_multiple_of(CLOTHES_EVERY)
                && let Some(colors) = ClothesColors::of(set, &masks)
            {
                place.clothes = Some(colors);
            }
            place.seen += 1;
            place.missing_since = None;
            if std::mem::take(&mut place.has_left) && place.is_known && self.measures {
                place.begin_measuring();
            }
        }
    }
}

/// Notes that a place's person is not seen, and logs when the person has left.
fn note_missing(place: &mut PersonPlace, nanos: i64) {
    let since = *place.missing_since.get_or_insert(nanos);
    if !place.has_left && since.abs_diff(nanos) >= LEFT_AFTER_NANOS {
        place.has_left = true;
        if place.is_known && place.seen > 0 {
            tracing::info!("person {} has left", place.id);
        }
    }
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
        stages.add(stage, flyrig_types::saturating_secs(seconds));
    }
    stages.count("pose network inferences", estimate.quality.inferred as u64);
}
