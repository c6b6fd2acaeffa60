//! Masks from per-pixel evidence and the posed body.
//!
//! The body is a prior on each pixel: more evidence inside it, less where most clothes end. Farther out, only pixels that
//! surely differ and touch nearer ones count: a wide skirt. Large pieces stay, small holes are filled.

use flyrig_types::Mask;

use crate::image::grid::{Grid, clean, components};
use crate::masks::gate::BodyGate;

/// Evidence added on the body, further evidence inside it in proportion to depth over [`DEEP_M`], and evidence taken off
/// where most clothes end and beyond.
const ON_BODY: f32 = 0.15;
const DEEP_IN_BODY: f32 = 0.35;
const OFF_BODY: f32 = 0.4;
/// Depth in the body beyond which only a sure match of the background speaks against a person, metres.
const DEEP_M: f64 = 0.04;

/// Returns the mask, in the image's size, from evidence inside the gate's bounds and the body; `None` when nothing stands
/// out near the body or the sizes differ.
pub(crate) fn gated_mask(evidence: &Grid, gate: &BodyGate) -> Option<Mask> {
    let ([x0, y0, ..], [width, height]) = (gate.bounds, gate.image);
    if (evidence.width, evidence.height) != (gate.distance.width, gate.distance.height) {
        return None;
    }
    // A vote among neighbours removes specks and closes pinholes.
    let mut voted = evidence.box_mean(1);
    let mut outside = gate.distance.clone();
    outside.values.iter_mut().for_each(|d| *d = f32::from(*d > 0.0));
    let depth = outside.distance_to_set();
    let deep_px = (DEEP_M * gate.px_per_m).max(1.0) as f32;
    for ((value, distance), depth) in voted.values.iter_mut().zip(&gate.distance.values).zip(&depth.values) {
        let prior = if *distance > 0.0 {
            ON_BODY - (ON_BODY + OFF_BODY) * distance.min(1.0)
        } else {
            ON_BODY + DEEP_IN_BODY * (depth / deep_px).min(1.0)
        };
        let is_out = *distance >= gate.reach;
        *value = if is_out { 0.0 } else { ((*value + prior - 0.5) * 2.0 + 0.5).clamp(0.0, 1.0) };
    }
    drop_unattached(&mut voted, &gate.distance);
    clean(&mut voted, (0.02 * gate.px_per_m).round().max(2.0) as usize);
    let least = (width * height / 5000).max(12);
    if voted.values.iter().filter(|v| **v >= 0.5).count() < least {
        return None;
    }
    voted.paste(width, height, x0, y0)
}

/// Clears pieces that lie farther from the body than most clothes in all their pixels: they are no clothes of the person.
fn drop_unattached(voted: &mut Grid, distance: &Grid) {
    let mut alone = Vec::new();
    let take_alone = |pixels: &[usize]| {
        if pixels.iter().all(|at| distance.values[*at] >= 1.0) {
            alone.extend_from_slice(pixels);
        }
    };
    components(voted, |value| value >= 0.5, take_alone);
    alone.into_iter().for_each(|at| voted.values[at] = 0.0);
}

#[cfg(test)]
#[path = "gated_mask_tests.rs"]
mod tests;
