//! Correction of a camera's colours towards those of its rig.

use flyrig_model::srgb;
use serde::{Deserialize, Serialize};

/// Colour correction of one camera towards the colours that the rig's cameras agree on.
///
/// For the sRGB value `s` in 0..=1 of a channel, at the distance `r` from the principal point in halves of the image's diagonal,
/// the corrected light is `gain · linear(s^exponent) · exp(falloff[0] r² + falloff[1] r⁴)`, where `linear` decodes sRGB.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColorMatch {
    /// Factors of red, green and blue light: exposure and white balance.
    pub gain: [f64; 3],
    /// Response; 1 for a camera whose middle tones are as bright as those of the others.
    #[serde(default = "one")]
    pub exponent: f64,
    /// Compensation of vignetting: brightening towards the corners.
    #[serde(default)]
    pub falloff: [f64; 2],
}

impl ColorMatch {
    /// Correction that leaves colours as they are.
    pub const NONE: Self = Self { gain: [1.0; 3], exponent: 1.0, falloff: [0.0; 2] };

    /// Returns the first number out of range: its key, its value, and the permitted range.
    #[must_use]
    pub fn fault(&self) -> Option<(&'static str, f64, &'static str)> {
        let outside = |value: f64, from: f64, to: f64| !(from..=to).contains(&value);
        let gain = self.gain.into_iter().find(|gain| outside(*gain, 0.05, 20.0));
        let falloff = self.falloff.into_iter().find(|share| outside(*share, -5.0, 5.0));
        gain.map(|gain| ("color.gain", gain, "0.05 to 20"))
            .or_else(|| outside(self.exponent, 0.2, 5.0).then_some(("color.exponent", self.exponent, "0.2 to 5")))
            .or_else(|| falloff.map(|share| ("color.falloff", share, "-5 to 5")))
    }

    /// Returns the corrected linear light of sRGB values at the squared distance `r2` from the principal point, see [`ColorMatch`]; clamps
    /// to 0..=1.
    #[must_use]
    pub fn apply(&self, srgb: [f64; 3], r2: f64) -> [f64; 3] {
        let corner = (self.falloff[0] * r2 + self.falloff[1] * r2 * r2).exp();
        std::array::from_fn(|k| {
            let bent = srgb[k].clamp(0.0, 1.0).powf(self.exponent);
            let corrected = self.gain[k] * srgb::decode(bent, f64::powf) * corner;
            // NaN fails the comparison.
            if corrected > 0.0 { corrected.min(1.0) } else { 0.0 }
        })
    }
}

impl Default for ColorMatch {
    fn default() -> Self {
        Self::NONE
    }
}

fn one() -> f64 {
    1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrects_by_its_formula_and_stays_within_range() {
        let of = ColorMatch { gain: [2.0, 1.0, 0.5], exponent: 1.2, falloff: [0.3, 0.1] };
        let [red, green, blue] = of.apply([0.4, 0.4, 0.4], 0.5);
        let expected = ((0.4f64.powf(1.2) + 0.055) / 1.055).powf(2.4) * (0.15f64 + 0.025).exp();
        assert!((red - 2.0 * expected).abs() < 1e-12 && (green - expected).abs() < 1e-12);
        assert!((blue - 0.5 * expected).abs() < 1e-12);
        assert!(of.apply([f64::NAN, -1.0, 5.0], 0.0)[..2].iter().all(|light| *light <= 0.0));
        let near = |found: [f64; 3], expected: [f64; 3]| found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(of.apply([1.0; 3], 1.0), [1.0, 1.0, 0.5 * 0.4f64.exp()]), "clipped");
        assert!(near(ColorMatch::NONE.apply([0.01292, 0.0, 1.0], 0.7), [0.001, 0.0, 1.0]), "sRGB alone");
    }

    #[test]
    fn faults_name_the_key() {
        assert_eq!(ColorMatch::NONE.fault(), None);
        let fault = |of: ColorMatch| of.fault().map(|(key, ..)| key);
        assert_eq!(fault(ColorMatch { gain: [1.0, f64::NAN, 1.0], ..ColorMatch::NONE }), Some("color.gain"));
        assert_eq!(fault(ColorMatch { gain: [1.0, 0.0, 1.0], ..ColorMatch::NONE }), Some("color.gain"));
        assert_eq!(fault(ColorMatch { exponent: f64::INFINITY, ..ColorMatch::NONE }), Some("color.exponent"));
        assert_eq!(fault(ColorMatch { falloff: [0.0, -9.0], ..ColorMatch::NONE }), Some("color.falloff"));
    }
}
