//! Search for shoes and a skirt on a person whose shape is given.
//!
//! Joints stay those of the body: the session draws it dressed, and outlines are those of the feet in shoes.

use flyrig_body::{Outfit, Template};
use flyrig_tracker::{MaskedPoses, MaskedView, find_outfit};
use flyrig_types::{Camera, FrameSet, Mask, PersonId, Pose};

use super::{
    observation::SeenPerson,
    sampling::{SHAPE_EVERY_NANOS, SHAPE_SETS},
};

/// Collector of a person's poses and masks, which looks for clothes once there are as many as for a shape.
#[derive(Debug, Clone, Default)]
pub(crate) struct OutfitSearch {
    poses: Vec<Pose>,
    /// Index of the pose, slot of the camera, and mask.
    masks: Vec<(usize, usize, Mask)>,
    last_nanos: Option<i64>,
    is_over: bool,
    outfit: Outfit,
    dressed: Option<Template>,
}

impl OutfitSearch {
    /// Returns a search that is over, for a template that is dressed already.
    pub fn over() -> Self {
        Self { is_over: true, ..Self::default() }
    }

    /// Returns the clothes that were found.
    pub fn outfit(&self) -> Outfit {
        self.outfit
    }

    /// Returns the dressed body; `None` while it is bare.
    pub fn dressed(&self) -> Option<&Template> {
        self.dressed.as_ref()
    }

    /// Returns whether the search is over.
    pub fn is_over(&self) -> bool {
        self.is_over
    }

    /// Ingests a frame set of a running session, and looks for clothes once enough time has passed.
    pub fn ingest(&mut self, set: &FrameSet, seen: &SeenPerson, body: &Template, cameras: &[Camera]) {
        let is_soon = self.last_nanos.is_some_and(|last| set.master_nanos.saturating_sub(last) < SHAPE_EVERY_NANOS);
        if self.is_over || is_soon {
            return;
        }
        self.last_nanos = Some(set.master_nanos);
        self.add(set, seen);
        if self.poses.len() >= SHAPE_SETS {
            self.finish(seen.person, body, cameras);
        }
    }

    /// Keeps the pose and masks of a frame set.
    pub fn add(&mut self, set: &FrameSet, seen: &SeenPerson) {
        for ((slot, _), view) in set.present().zip(&seen.views) {
            // Where another person hides a part, the mask is not informative for clothes.
            let own = view.mask.as_ref().filter(|_| view.others.is_none());
            self.masks.extend(own.map(|mask| (self.poses.len(), slot, mask.clone())));
        }
        self.poses.push(seen.pose.clone());
    }

    /// Looks for clothes in the frame sets so far. Later ones change nothing.
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
