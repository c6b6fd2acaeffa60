//! Background as the mask estimation measured it in one image; the matte of the same image uses it again.

use crate::image::grid::Grid;
use crate::image::pixels::Rgb;
use crate::masks::background_light::{BackgroundLight, Exposure};
use crate::masks::gate::BodyGate;

/// Background of one camera as one image shows it around a person.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenBackground {
    pub(crate) exposure: Exposure,
    /// Part of the image that `evidence` covers: x0, y0, x1, y1 (ends excluded).
    bounds: [usize; 4],
    evidence: Option<Grid>,
}

impl SeenBackground {
    /// Measures the evidence around a posed body.
    pub(crate) fn new(light: &BackgroundLight<'_>, picture: &Rgb, gate: &BodyGate) -> Self {
        let evidence = light.evidence(picture, gate.bounds);
        Self { exposure: light.exposure(), bounds: gate.bounds, evidence }
    }

    /// Returns evidence for a foreground inside the bounds of the gate, 0..=1 with the border at one half; `None` while no
    /// pixel of the background is known there.
    pub(crate) fn evidence(&self) -> Option<&Grid> {
        self.evidence.as_ref()
    }

    /// Returns the evidence inside `bounds` (x0, y0, x1, y1, ends excluded): a part of what was measured, or all of it measured
    /// anew where `bounds` exceed the gate's.
    pub(crate) fn evidence_in(&self, light: &BackgroundLight<'_>, picture: &Rgb, bounds: [usize; 4]) -> Option<Grid> {
        let ([x0, y0, x1, y1], [left, top, right, bottom]) = (bounds, self.bounds);
        if x0 < left || y0 < top || x1 > right || y1 > bottom {
            return light.evidence(picture, bounds);
        }
        let evidence = self.evidence.as_ref()?;
        let row = |y: usize| &evidence.values[(y - top) * evidence.width..][x0 - left..x1 - left];
        Some(Grid { width: x1 - x0, height: y1 - y0, values: (y0..y1).flat_map(row).copied().collect() })
    }
}
