//! Estimation of masks around the fitted body.
//!
//! A view's mask joins the network's coarse mask (warped from its last inference), the background and the body's gate;
//! without an inference that shows the person, it comes from the background and the gate alone.

use super::refine::PosedBody;
use super::*;
use crate::masks::background_light::MOSTLY_KNOWN;
use crate::masks::support::drop_unsupported;

/// Mask of one view and what it was made of.
type Made = (Mask, BodyGate, Option<SeenBackground>);

/// Masks of one frame set and what they were made of, in rig order.
pub(super) struct Masks {
    pub masks: Vec<Option<Mask>>,
    pub gates: Vec<Option<BodyGate>>,
    pub backgrounds: Vec<Option<SeenBackground>>,
}

impl Masks {
    /// Returns no mask of any view.
    fn none(views: usize) -> Self {
        Self { masks: vec![None; views], gates: vec![None; views], backgrounds: vec![None; views] }
    }
}

impl PoseEstimator {
    /// Estimates the masks around `body`, the person in the fitted pose; the reason for a missing one goes into the view's
    /// quality.
    pub(super) fn masks(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        fitted: &mut Fitted,
        body: &PosedBody,
    ) -> Masks {
        if !self.config.masks {
            return Masks::none(pictures.len());
        }
        let made: Vec<Result<Made, NoMask>> = pictures
            .par_iter()
            .enumerate()
            .map(|(slot, picture)| {
                let picture = picture.as_ref().ok_or(NoMask::NoFrame)?;
                let camera = &self.rig.cameras[slot];
                let view = fitted.evidence.views.iter().position(|view| view.slot == slot).ok_or(NoMask::NoFrame)?;
                let (vertices, _) = body.at(view);
                let gate = match &self.clothes {
                    Clothes::Unknown => BodyGate::new(camera, vertices, &self.surface.triangles),
                    Clothes::Known(dressed) if Arc::ptr_eq(dressed, &self.surface) => {
                        BodyGate::new(camera, vertices, &dressed.triangles).map(BodyGate::of_known_clothes)
                    }
                    Clothes::Known(dressed) => {
                        let (vertices, _) = self.skinned_in(dressed, &fitted.turns, set, fitted.delay_secs(slot));
                        BodyGate::new(camera, &vertices, &dressed.triangles).map(BodyGate::of_known_clothes)
                    }
                };
                let gate = gate.ok_or(NoMask::OutOfView)?;
                let inference = fitted.inferences[slot].as_ref();
                let inference = inference.filter(|l| l.sighting.output.presence >= self.config.presence_threshold);
                let known = self.background(slot);
                let seen = known.and_then(|known| known.seen(picture, &gate));
                let evidence = seen.as_ref().and_then(SeenBackground::evidence);
                let mask = match (inference, evidence) {
                    (Some(inference), evidence) => {
                        let crop = inference.sighting.crop;
                        let coarse = match (&inference.sighting.output.mask, &inference.body) {
                            (Some(mask), Some(body)) => {
                                let (then, _) = self.skinned(&body.turns, set, fitted.delay_secs(slot));
                                let (then, now) = (corners(camera, &then), corners(camera, vertices));
                                carried_mask(mask, crop, &then, &now, gate.bounds)
                            }
                            (Some(mask), None) => coarse_mask(mask, crop, &gate),
                            (None, _) => body_mask(&gate),
                        };
                        refine(picture, &coarse, crop.scale(), &gate, evidence)
                    }
                    // The network finds no person here, but the other cameras place the body in this image.
                    (None, Some(evidence))
                        if known.is_some_and(|it| it.known_share(picture.width, gate.bounds) > MOSTLY_KNOWN) =>
                    {
                        gated_mask(evidence, &gate)
                    }
                    (None, _) => return Err(NoMask::NoPerson),
                };
                Ok((mask.ok_or(NoMask::Empty)?, gate, seen))
            })
            .collect();
        let Masks { mut masks, mut gates, mut backgrounds } = Masks::none(made.len());
        for (slot, (view, made)) in fitted.views.iter_mut().zip(made).enumerate() {
            view.no_mask = made.as_ref().err().copied();
            if let Ok((mask, gate, seen)) = made {
                (masks[slot], gates[slot], backgrounds[slot]) = (Some(mask), Some(gate), seen);
            }
        }
        if self.is_alone {
            drop_unsupported(&self.rig.cameras, &gates, &mut masks);
        }
        for ((view, mask), gate) in fitted.views.iter_mut().zip(&masks).zip(&gates) {
            view.mask_overlap = mask.as_ref().zip(gate.as_ref()).map(|(mask, gate)| gate.overlap(mask));
        }
        Masks { masks, gates, backgrounds }
    }

    /// Whether gates are drawn from the same surface as outlines are matched with.
    pub(super) fn gates_show_surface(&self) -> bool {
        match &self.clothes {
            Clothes::Unknown => true,
            Clothes::Known(dressed) => Arc::ptr_eq(dressed, &self.surface),
        }
    }
}
