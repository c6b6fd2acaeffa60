//! Backgrounds of the cameras while people are estimated, and cameras that see nothing.

use std::sync::Arc;

use flyrig_body::skin_mesh;
use flyrig_tracker::{Background, BackgroundEvent, BodyGate, PersonArea, TrackError, is_blank};
use flyrig_types::FrameSet;
use rayon::prelude::*;

use super::{
    EstimatedPerception,
    place::{PersonPlace, PlaceEstimate},
};
use crate::{
    error::FusionError,
    perception::{background::report, observation::ViewObservation},
};

impl EstimatedPerception {
    /// Returns whether any camera's background is still being learnt.
    pub(super) fn are_learning(&self) -> bool {
        let known = self.places.first().map(|place| &place.estimator);
        let mut known = (0..self.rig.cameras.len()).filter_map(|slot| known?.background(slot));
        known.any(Background::is_learning)
    }

    /// Reports cameras whose images have become uniform, and those that see again.
    pub(super) fn watch_for_blank_images(&mut self, set: &FrameSet) -> Result<(), FusionError> {
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

    /// Lets the backgrounds follow the light where no person stands.
    pub(super) fn follow_backgrounds(
        &mut self,
        set: &FrameSet,
        estimates: &[PlaceEstimate],
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
        // A person who was lost a moment ago may stand anywhere, and must not become background.
        let is_missing = |place: &PersonPlace| place.missing_since.is_some() && !place.has_left && place.seen > 0;
        if bodies.is_empty() || self.places.iter().any(is_missing) {
            return Ok(());
        }
        // All places share them: with one owner they need not be copied.
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
}
