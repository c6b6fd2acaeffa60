//! A camera's background in the exposure of one image: evidence for a foreground, and linear light behind it.

use std::sync::Arc;

use crate::image::grid::Grid;
use crate::image::light::linear;
use crate::image::pixels::Rgb;
use crate::masks::drift::Drift;
use crate::masks::key_color::{KeyColor, Screen};
use crate::masks::plate::Plate;
use crate::masks::plate_evidence::{NO_EVIDENCE, plate_evidence};

/// Share of the background around the body that must be known for a mask from background and body alone.
pub(crate) const MOSTLY_KNOWN: f64 = 0.7;

/// Exposure of one image.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Exposure {
    Plate(Drift),
    Screen(Arc<Screen>),
}

/// Background in the exposure of one image.
pub(crate) enum BackgroundLight<'a> {
    Plate(&'a Plate, Drift),
    Screen(&'a KeyColor, Arc<Screen>),
}

impl BackgroundLight<'_> {
    /// Returns the exposure, without the background that it belongs to.
    pub fn exposure(&self) -> Exposure {
        match self {
            Self::Plate(_, drift) => Exposure::Plate(*drift),
            Self::Screen(_, screen) => Exposure::Screen(Arc::clone(screen)),
        }
    }

    /// Returns per-pixel evidence for a foreground inside `bounds` (x0, y0, x1, y1, ends excluded) of the image that this
    /// was made for, 0..=1 with the border at one half; `None` while no pixel is known there.
    pub fn evidence(&self, picture: &Rgb, bounds: [usize; 4]) -> Option<Grid> {
        let (plate, drift) = match self {
            Self::Screen(key, screen) => return Some(key.evidence(picture, screen, bounds)),
            Self::Plate(plate, drift) => (plate, drift),
        };
        let mut evidence = plate_evidence(picture, plate.values(), drift, bounds)?;
        let mut known = 0;
        let rows = evidence.values.chunks_exact_mut((bounds[2] - bounds[0]).max(1));
        for (y, row) in (bounds[1]..).zip(rows) {
            for (x, value) in (bounds[0]..).zip(row) {
                if plate.knows(y * picture.width + x) {
                    known += 1;
                } else {
                    *value = NO_EVIDENCE;
                }
            }
        }
        (known > 0).then_some(evidence)
    }

    /// Returns the linear light of a pixel, 0..=1 by channel; `None` where the background is unknown.
    pub fn at(&self, pixel: usize) -> Option<[f32; 3]> {
        match self {
            Self::Screen(_, screen) => Some(screen.at(pixel)),
            Self::Plate(plate, drift) => {
                let light = |k: usize| linear(drift.gain[k] * plate.values()[3 * pixel + k]);
                plate.knows(pixel).then(|| std::array::from_fn(light))
            }
        }
    }
}
