//! Masks of all people in every image, with coverage and colours along their outlines.
//!
//! `tracker::matte` solves for coverage and foreground colour along each outline; the session paints these colours in place of the image's.

use std::{collections::BTreeMap, sync::Arc};

use flyrig_body::skin_mesh;
use flyrig_tracker::{Matte, SeenBackground, matte};
use flyrig_types::{Frame, FrameSet, Mask};
use rayon::prelude::*;

use super::{EstimatedPerception, place::PlaceEstimate};
use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    perception::{
        observation::ViewObservation,
        split_mask::{PosedMesh, split_mask},
    },
    settings::perception::Origin,
};

/// Mattes by slot and place.
type Mattes = BTreeMap<(usize, usize), Matte>;

impl EstimatedPerception {
    /// Returns the views of all people: one element per place, then per present frame. Masks of several people are divided by their
    /// posed bodies.
    pub(super) fn views(
        &self,
        set: &FrameSet,
        estimates: &mut [PlaceEstimate],
        stages: &mut StageTimes,
    ) -> Result<Vec<Vec<ViewObservation>>, FusionError> {
        let seen: Vec<usize> = (0..estimates.len()).filter(|&index| estimates[index].is_ok()).collect();
        let mut views: Vec<Vec<ViewObservation>> = estimates.iter().map(|_| Vec::new()).collect();
        let meshes = if seen.len() > 1 { self.meshes(estimates) } else { Vec::new() };
        let mut mattes = match self.masks {
            Origin::Estimated if self.mattes => stages.time("matte", || self.mattes(set, &seen, estimates))?,
            _ => BTreeMap::new(),
        };
        for (slot, frame) in set.present() {
            let mut own = self.own_views(slot, frame, &seen, estimates, &mut mattes);
            self.divide(slot, &mut own, &meshes, stages);
            for (index, view) in seen.iter().zip(own) {
                views[*index].push(view);
            }
        }
        Ok(views)
    }

    /// Poses the bodies of all people who are seen.
    fn meshes(&self, estimates: &[PlaceEstimate]) -> Vec<PosedMesh<'_>> {
        let mut meshes = Vec::new();
        for (place, estimate) in self.places.iter().zip(estimates) {
            let Ok(estimate) = estimate else { continue };
            let template = place.estimator.template();
            let vertices = skin_mesh(template, &estimate.pose).0;
            meshes.push(PosedMesh { vertices, triangles: &template.triangles });
        }
        meshes
    }

    /// Returns one image's views of the people in the places `seen`, as if each were alone.
    fn own_views(
        &self,
        slot: usize,
        frame: &Frame,
        seen: &[usize],
        estimates: &mut [PlaceEstimate],
        mattes: &mut Mattes,
    ) -> Vec<ViewObservation> {
        let mut own = Vec::new();
        for &index in seen {
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
        own
    }

    /// Divides the union of several people's masks in one image by their bodies.
    fn divide(&self, slot: usize, own: &mut [ViewObservation], meshes: &[PosedMesh<'_>], stages: &mut StageTimes) {
        let (2.., Some(camera)) = (own.len(), self.rig.cameras.get(slot)) else { return };
        let Some(all) = union(own.iter().filter_map(|view| view.mask.as_ref())) else { return };
        let parts = stages.time("divide masks", || split_mask(camera, &all, meshes));
        for (view, (part, others)) in own.iter_mut().zip(parts) {
            view.mask = view.mask.is_some().then_some(part);
            view.others = Some(others);
        }
    }

    /// Solves for coverage and colour along the outlines of all masks.
    fn mattes(&self, set: &FrameSet, seen: &[usize], estimates: &mut [PlaceEstimate]) -> Result<Mattes, FusionError> {
        let mut masks = Vec::new();
        for (slot, frame) in set.present() {
            for &index in seen {
                let Ok(estimate) = &mut estimates[index] else { continue };
                if let Some(mask) = estimate.masks.get_mut(slot).and_then(Option::take) {
                    let seen = estimate.backgrounds.get_mut(slot).and_then(Option::take);
                    masks.push(((slot, index), frame, mask, seen));
                }
            }
        }
        type Made<'a> = ((usize, usize), &'a Arc<Frame>, Mask, Option<SeenBackground>);
        let solve = |((slot, index), frame, mask, seen): Made<'_>| {
            let background = self.places[index].estimator.background(slot);
            Ok(((slot, index), matte(&frame.image, &mask, background, seen.as_ref())?))
        };
        masks.into_par_iter().map(solve).collect()
    }
}

/// Returns the largest coverage of each pixel; `None` without a mask. Masks of another size than the first are left out.
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
