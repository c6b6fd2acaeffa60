//! Estimation of masks around the fitted body.
//!
//! A view's mask joins the network's coarse mask (warped from its last inference), the background and the body's gate;
//! without an inference that shows the person, it comes from the background and the gate alone.

use super::*;
use crate::masks::background_light::MOSTLY_KNOWN;
use crate::masks::support::drop_unsupported;

impl PoseEstimator {
    /// Estimates the masks, in rig order; the reason for a missing one goes into the view's quality.
    pub(super) fn masks(&self, set: &FrameSet, pictures: &[Option<Rgb<'_>>], fitted: &mut Fitted) -> Vec<Option<Mask>> {
        if !self.config.masks {
            return vec![None; pictures.len()];
        }
        let made: Vec<Result<(Mask, BodyGate), NoMask>> = pictures
            .par_iter()
            .enumerate()
            .map(|(slot, picture)| {
                let picture = picture.as_ref().ok_or(NoMask::NoFrame)?;
                let camera = &self.rig.cameras[slot];
                let (vertices, _) = self.skinned(&fitted.turns, set, fitted.delay_secs(slot));
                let gate = match &self.clothes {
                    Clothes::Unknown => BodyGate::new(camera, &vertices, &self.surface.triangles),
                    Clothes::Known(dressed) => {
                        let (vertices, _) = self.skinned_in(dressed, &fitted.turns, set, fitted.delay_secs(slot));
                        BodyGate::new(camera, &vertices, &dressed.triangles).map(BodyGate::of_known_clothes)
                    }
                };
                let gate = gate.ok_or(NoMask::OutOfView)?;
                let inference = fitted.inferences[slot].as_ref();
                let inference = inference.filter(|l| l.sighting.output.presence >= self.config.presence_threshold);
                let light = self.background(slot).and_then(|known| known.light(picture, &|at| !gate.reaches_pixel(at)));
                let evidence = light.as_ref().and_then(|light| light.evidence(picture, gate.bounds));
                let mask = match (inference, &evidence) {
                    (Some(inference), evidence) => {
                        let coarse = match (&inference.body, &inference.sighting.output.mask) {
                            (Some(body), Some(mask)) => {
                                let (then, _) = self.skinned(&body.turns, set, fitted.delay_secs(slot));
                                let (then, now) = (corners(camera, &then), corners(camera, &vertices));
                                carried_mask(mask, inference.sighting.crop, &then, &now, gate.bounds)
                            }
                            _ => coarse_mask(&inference.sighting, &gate),
                        };
                        refine(picture, &coarse, inference.sighting.crop.scale(), &gate, evidence.as_ref())
                    }
                    // The network finds no person here, but the other cameras place the body in this image.
                    (None, Some(evidence))
                        if light.is_some_and(|light| light.known_share(picture.width, gate.bounds) > MOSTLY_KNOWN) =>
                    {
                        gated_mask(evidence, &gate)
                    }
                    (None, _) => return Err(NoMask::NoPerson),
                };
                Ok((mask.ok_or(NoMask::Empty)?, gate))
            })
            .collect();
        let (mut masks, mut gates) = (Vec::with_capacity(made.len()), Vec::with_capacity(made.len()));
        for (view, made) in fitted.views.iter_mut().zip(made) {
            view.no_mask = made.as_ref().err().copied();
            let (mask, gate) = made.ok().unzip();
            masks.push(mask);
            gates.push(gate);
        }
        if self.is_alone {
            drop_unsupported(&self.rig.cameras, &gates, &mut masks);
        }
        for ((view, mask), gate) in fitted.views.iter_mut().zip(&masks).zip(&gates) {
            view.mask_overlap = mask.as_ref().zip(gate.as_ref()).map(|(mask, gate)| gate.overlap(mask));
        }
        masks
    }
}
