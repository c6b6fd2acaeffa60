//! Schedule of the pose network: its last inference in each view, and when the next one is due.
//!
//! The network is the most expensive part of an estimate. An inference stays valid while the body hardly moves: its
//! landmarks and its mask are carried along with the body ([`carried_mask`](crate::masks::carried_mask)). A view is due
//! once the body has moved in it by more than [`PoseConfig::look_after_m`](crate::PoseConfig::look_after_m), or with age.

use std::sync::Arc;

use glam::DVec3;

use crate::landmarks::keypoints::LANDMARK_COUNT;
use crate::landmarks::sighting::Sighting;
use crate::pose::body_model::JointTurns;

/// Staleness that an inference gains with age, metres per second, so that the absence of a person is noticed.
const AGING_M_PER_SEC: f64 = 0.1;
/// Multiple of the limit beyond which all stale views are due at once; below, they are in turn.
const URGENT: f64 = 3.0;
/// Distance over which a landmark was carried at which its confidence is halved, metres.
const CARRIED_M: f64 = 0.05;

/// Last inference of the network in one view.
#[derive(Debug, Clone)]
pub(crate) struct Inference {
    pub sighting: Arc<Sighting>,
    /// Body as it was estimated then; `None` while it is being estimated.
    pub body: Option<InferredBody>,
}

/// Body at the time of an inference.
#[derive(Debug, Clone)]
pub(crate) struct InferredBody {
    pub nanos: i64,
    pub turns: Arc<JointTurns>,
    pub marks: [DVec3; LANDMARK_COUNT],
}

impl Inference {
    /// Returns an inference in the frame set that is being estimated.
    pub fn fresh(sighting: Sighting) -> Self {
        Self { sighting: Arc::new(sighting), body: None }
    }

    /// Returns the largest motion of the body's landmarks since, metres, plus the share of age; 0 for a fresh inference.
    fn staleness_m(&self, marks: &[DVec3; LANDMARK_COUNT], nanos: i64) -> f64 {
        let Some(body) = &self.body else { return 0.0 };
        let moved = marks.iter().zip(&body.marks).map(|(now, then)| now.distance(*then)).fold(0.0, f64::max);
        moved + AGING_M_PER_SEC * 1e-9 * nanos.saturating_sub(body.nanos).max(0) as f64
    }

    /// Returns each landmark's displacement from the last frame set to the inference, metres, and the factor of its
    /// confidence. An old inference does not observe motion since the last frame set: a predicted motion that counted as
    /// seen would feed itself.
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

/// Chooses the views in which the network runs again: all without an inference, all in which the body has moved far, and
/// the stalest of those in which it has moved by more than `limit_m` metres. Views without an image are never due. At most
/// `most` views that have an inference are chosen, the stalest first.
pub(crate) fn due(
    inferences: &[Option<Inference>],
    has_image: impl Fn(usize) -> bool,
    marks: &[DVec3; LANDMARK_COUNT],
    nanos: i64,
    limit_m: f64,
    most: usize,
) -> Vec<bool> {
    let staleness: Vec<f64> = inferences
        .iter()
        .enumerate()
        .map(|(slot, inference)| match inference {
            _ if !has_image(slot) => f64::NEG_INFINITY,
            None => f64::INFINITY,
            Some(inference) => inference.staleness_m(marks, nanos),
        })
        .collect();
    let stalest = staleness.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut due: Vec<bool> = staleness.iter().map(|&s| s > URGENT * limit_m || (s > limit_m && s >= stalest)).collect();
    let mut order: Vec<usize> = (0..due.len()).filter(|&slot| due[slot] && inferences[slot].is_some()).collect();
    order.sort_by(|&a, &b| staleness[b].total_cmp(&staleness[a]));
    order.into_iter().skip(most).for_each(|slot| due[slot] = false);
    due
}

#[cfg(test)]
#[path = "inference_schedule_tests.rs"]
mod tests;
