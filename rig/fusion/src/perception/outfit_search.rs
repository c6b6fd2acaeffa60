//! The search for clothes on a person whose shape is given.

use flyrig_body::{Outfit, Template};
use flyrig_tracker::{MaskedPoses, MaskedView, find_outfit};
use flyrig_types::{Camera, FrameSet, Mask, PersonId, Pose};

use super::SeenPerson;
use crate::{SHAPE_SECS, SHAPE_SETS};

/// Collects poses and masks of a person, as many as a shape takes, and looks for clothes once.
#[derive(Debug, Clone, Default)]
pub(crate) struct OutfitSearch {
    poses: Vec<Pose>,
    /// Which pose, which slot.
    masks: Vec<(usize, usize, Mask)>,
    last_nanos: Option<i64>,
    is_over: bool,
    outfit: Outfit,
    dressed: Option<Template>,
}

impl OutfitSearch {
    /// Returns a search that is over, for a template that wears its clothes already.
    pub fn over() -> Self {
        Self { is_over: true, ..Self::default() }
    }

    /// Returns the clothes that were found.
    pub fn outfit(&self) -> Outfit {
        self.outfit
    }

    /// Returns the body in these clothes; `None` while it is bare.
    pub fn dressed(&self) -> Option<&Template> {
        self.dressed.as_ref()
    }

    /// Returns whether the search is over.
    pub fn is_over(&self) -> bool {
        self.is_over
    }

    /// Takes in a set of a running session, and looks for clothes once enough time has passed.
    pub fn take(&mut self, set: &FrameSet, seen: &SeenPerson, body: &Template, cameras: &[Camera]) {
        let every_nanos = (SHAPE_SECS * 1e9 / SHAPE_SETS as f64) as i64;
        let is_soon = self.last_nanos.is_some_and(|last| set.master_nanos.saturating_sub(last) < every_nanos);
        if self.is_over || is_soon {
            return;
        }
        self.last_nanos = Some(set.master_nanos);
        self.add(set, seen);
        if self.poses.len() >= SHAPE_SETS {
            self.finish(seen.person, body, cameras);
        }
    }

    /// Keeps the pose and masks of a set.
    pub fn add(&mut self, set: &FrameSet, seen: &SeenPerson) {
        for ((slot, _), view) in set.present().zip(&seen.views) {
            // Where somebody else hides a part, the mask says nothing of clothes.
            let own = view.mask.as_ref().filter(|_| view.others.is_none());
            self.masks.extend(own.map(|mask| (self.poses.len(), slot, mask.clone())));
        }
        self.poses.push(seen.pose.clone());
    }

    /// Looks for clothes in the sets so far. Later sets change nothing.
    pub fn finish(&mut self, person: PersonId, body: &Template, cameras: &[Camera]) {
        let (poses, masks) = (std::mem::take(&mut self.poses), std::mem::take(&mut self.masks));
        let views = masks
            .iter()
            .filter_map(|(pose, slot, mask)| Some(MaskedView { camera: cameras.get(*slot)?, pose: *pose, mask }))
            .collect();
        (self.outfit, self.is_over) = (find_outfit(body, &MaskedPoses { poses, views }), true);
        if !self.outfit.is_bare() {
            self.dressed = self.outfit.on(body).ok();
            tracing::info!("person {person} wears {}", self.outfit);
        }
    }
}
