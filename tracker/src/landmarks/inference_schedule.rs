//! Looks of the network at each view, and when the next one is due.
//!
//! A look stays good while the body hardly moves: its landmarks and its mask are carried along with the body. The network is
//! the dearest part of an estimate, so a view gets a new look only once the body has moved in it.

use std::sync::Arc;

use flyrig_types::Camera;
use glam::{DVec2, DVec3, Vec3};

use crate::image::crop::Crop;
use crate::image::grid::Grid;
use crate::landmarks::keypoints::LANDMARK_COUNT;
use crate::landmarks::sighting::Sighting;
use crate::masks::silhouette::net_probability;
use crate::pose::body_model::Turns;

/// A look grows old by this much a second, metres, so that a person who is gone is noticed.
const AGING_M_PER_SEC: f64 = 0.1;
/// All views that need a look by more than this factor get it at once, the others in turn.
const URGENT: f64 = 3.0;
/// A landmark that the body has carried this far counts half, metres.
const CARRIED_M: f64 = 0.05;

/// The network's view of the person in one camera.
#[derive(Debug, Clone)]
pub(crate) struct Look {
    pub sighting: Arc<Sighting>,
    /// The body as it was estimated then; `None` while it is being estimated.
    pub body: Option<LookBody>,
}

/// The body at the time of a look.
#[derive(Debug, Clone)]
pub(crate) struct LookBody {
    pub nanos: i64,
    pub turns: Arc<Turns>,
    pub marks: [DVec3; LANDMARK_COUNT],
}

impl Look {
    /// A look at the set that is being estimated.
    pub fn fresh(sighting: Sighting) -> Self {
        Self { sighting: Arc::new(sighting), body: None }
    }

    /// How far the body's landmarks have moved since, metres, with the share of age; 0 for a fresh look.
    fn staleness_m(&self, marks: &[DVec3; LANDMARK_COUNT], nanos: i64) -> f64 {
        let Some(body) = &self.body else { return 0.0 };
        let moved = marks.iter().zip(&body.marks).map(|(now, then)| now.distance(*then)).fold(0.0, f64::max);
        moved + AGING_M_PER_SEC * 1e-9 * nanos.saturating_sub(body.nanos).max(0) as f64
    }

    /// Where each landmark was at the look less where it was at the last set, metres, and the factor of its confidence. An old
    /// look says nothing of what has moved since the last set: a predicted motion that counted as seen would feed itself.
    pub fn carried(
        &self,
        last: &[DVec3; LANDMARK_COUNT],
        predicted: &[DVec3; LANDMARK_COUNT],
    ) -> [(DVec3, f64); LANDMARK_COUNT] {
        let Some(body) = &self.body else { return [(DVec3::ZERO, 1.0); LANDMARK_COUNT] };
        std::array::from_fn(|i| {
            let moved = body.marks[i].distance(predicted[i]);
            (body.marks[i] - last[i], 1.0 / (1.0 + (moved / CARRIED_M).powi(2)))
        })
    }
}

/// Chooses the views that the network looks at again: all that have no look, all in which the body has moved far, and of
/// those in which it has moved by more than `limit_m` the one that waits most. Views without an image get none. Of those
/// that have a look no more than `most` are chosen.
pub(crate) fn due(
    looks: &[Option<Look>],
    has_image: impl Fn(usize) -> bool,
    marks: &[DVec3; LANDMARK_COUNT],
    nanos: i64,
    limit_m: f64,
    most: usize,
) -> Vec<bool> {
    let staleness: Vec<f64> = looks
        .iter()
        .enumerate()
        .map(|(slot, look)| match look {
            _ if !has_image(slot) => f64::NEG_INFINITY,
            None => f64::INFINITY,
            Some(look) => look.staleness_m(marks, nanos),
        })
        .collect();
    let stalest = staleness.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut due: Vec<bool> = staleness.iter().map(|&s| s > URGENT * limit_m || (s > limit_m && s >= stalest)).collect();
    let mut order: Vec<usize> = (0..due.len()).filter(|&slot| due[slot] && looks[slot].is_some()).collect();
    order.sort_by(|&a, &b| staleness[b].total_cmp(&staleness[a]));
    order.into_iter().skip(most).for_each(|slot| due[slot] = false);
    due
}

#[cfg(test)]
#[path = "inference_schedule_tests.rs"]
mod tests;
