//! Augmentation of samples: colour channels swapped and darkened, left and right mirrored.

use rand::{RngExt as _, rngs::SmallRng, seq::SliceRandom as _};

use crate::{
    inputs::{CANDIDATES, STATE},
    taps::Taps,
    train_settings::TrainSettings,
};

/// Augmentation of one step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Variation {
    pub(crate) channels: [usize; 3],
    /// Factor on the sRGB values of each channel, at most 1.
    pub(crate) gain: [f32; 3],
    /// Whether left and right are mirrored.
    pub(crate) flip: bool,
    /// Whether the graph network is used.
    pub(crate) space: bool,
}

impl Variation {
    pub(crate) fn plain(space: bool) -> Self {
        Self { channels: [0, 1, 2], gain: [1.0; 3], flip: false, space }
    }

    pub(crate) fn draw(settings: &TrainSettings, rng: &mut SmallRng) -> Self {
        let mut out = Self::plain(!rng.random_bool(settings.without_space.clamp(0.0, 1.0)));
        if settings.vary {
            out.channels.shuffle(rng);
            out.flip = rng.random_bool(0.5);
            if rng.random_bool(0.7) {
                let all: f32 = rng.random_range(0.55..1.0);
                out.gain = std::array::from_fn(|_| all * rng.random_range(0.85..1.0));
            }
        }
        out
    }

    /// Swaps and darkens every sRGB triple that starts at one of `at`.
    pub(crate) fn row<const N: usize>(&self, row: &[f32; N], at: &[usize]) -> [f32; N] {
        let mut out = *row;
        for &first in at {
            for c in 0..3 {
                out[first + c] = row[first + self.channels[c]] * self.gain[c];
            }
        }
        out
    }

    /// Applies the colours' augmentation to a Gaussian's state, whose first triple is linear.
    pub(crate) fn state(&self, row: &[f32; STATE]) -> [f32; STATE] {
        let mut out = self.row(row, &CANDIDATE_PLACES);
        for c in 0..3 {
            let encoded = flyrig_renderer::srgb_from_linear(row[self.channels[c]]);
            out[c] = flyrig_renderer::linear_from_srgb(encoded * self.gain[c]);
        }
        out
    }

    pub(crate) fn taps(&self, taps: &Taps, width: usize) -> Taps {
        if self.flip { taps.flipped(width) } else { taps.clone() }
    }
}

/// Offsets of the candidates in a state.
const CANDIDATE_PLACES: [usize; CANDIDATES] = {
    let mut places = [0; CANDIDATES];
    let mut i = 0;
    while i < CANDIDATES {
        places[i] = STATE - 3 * (CANDIDATES - i);
        i += 1;
    }
    places
};
