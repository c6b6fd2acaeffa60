//! Shutter and aperture: blur of moving objects, rolling shutter and defocus.

use glam::Vec2;
use serde::{Deserialize, Serialize};

use crate::camera::sensor::uniform;
use crate::error::SimError;
use crate::error::check;

/// Shutter and aperture of a camera; the default is instantaneous and a pinhole.
///
/// A frame's time is the middle of the middle row's exposure. Blur and defocus are means of `samples` images in linear
/// light, as bright as a sharp one: the amount of light is [`crate::SensorConfig::exposure`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OpticsConfig {
    /// Exposure time of a row, milliseconds.
    pub exposure_ms: f64,
    /// Time between the first row and the last one, milliseconds: the top is exposed earlier. 0 for a global shutter.
    pub readout_ms: f64,
    /// Diameter of the aperture, millimetres; 0 for a pinhole.
    pub aperture_mm: f64,
    /// Distance of the focal plane, metres.
    pub focus_m: f64,
    /// Images averaged for blur or defocus.
    pub samples: u32,
}

impl Default for OpticsConfig {
    fn default() -> Self {
        Self { exposure_ms: 0.0, readout_ms: 0.0, aperture_mm: 0.0, focus_m: 3.0, samples: 8 }
    }
}

/// One of the images that are averaged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SubFrame {
    /// Seconds from the shot's instant.
    pub secs: f64,
    /// Position of the ray in the aperture, metres, camera axes.
    pub lens_point: Vec2,
}

impl OpticsConfig {
    pub(crate) fn validate(&self) -> Result<(), SimError> {
        check("optics.exposure_ms", self.exposure_ms, 0.0, 1000.0, "0 to 1000 milliseconds")?;
        check("optics.readout_ms", self.readout_ms, 0.0, 200.0, "0 to 200 milliseconds")?;
        check("optics.aperture_mm", self.aperture_mm, 0.0, 200.0, "0 to 200 millimetres")?;
        check("optics.focus_m", self.focus_m, 0.2, 1000.0, "0.2 to 1000 metres")?;
        check("optics.samples", self.samples.into(), 1.0, 256.0, "1 to 256")
    }

    /// Returns the images to average: evenly spaced over the exposure, and over the lens in an order independent of
    /// time.
    pub(crate) fn sub_frames(&self) -> Vec<SubFrame> {
        if self.exposure_ms == 0.0 && self.aperture_mm == 0.0 {
            return vec![SubFrame { secs: 0.0, lens_point: Vec2::ZERO }];
        }
        let count = self.samples;
        let mut order: Vec<u32> = (0..count).collect();
        order.sort_by(|&a, &b| uniform(7, a.into()).total_cmp(&uniform(7, b.into())));
        let share = |i: u32| (f64::from(i) + 0.5) / f64::from(count);
        let frame = |(i, place): (u32, u32)| {
            // Vogel's spiral: points of equal areas of the disc.
            let radius = (0.5e-3 * self.aperture_mm * share(place).sqrt()) as f32;
            let lens_point = Vec2::from_angle(place as f32 * 2.399_963) * radius;
            SubFrame { secs: (share(i) - 0.5) * self.exposure_ms * 1e-3, lens_point }
        };
        (0..count).zip(order).map(frame).collect()
    }

    /// Returns half the time from the first light of the first row to the last of the last, seconds.
    pub(crate) fn reach_secs(&self) -> f64 {
        0.5e-3 * (self.exposure_ms + self.readout_ms)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sub_frames_are_spread_over_the_exposure_and_the_lens() {
        let optics = OpticsConfig { exposure_ms: 20.0, aperture_mm: 30.0, samples: 64, ..OpticsConfig::default() };
        let frames = optics.sub_frames();
        let mean = frames.iter().map(|f| f.secs).sum::<f64>() / 64.0;
        assert!(mean.abs() < 1e-12 && frames.iter().all(|f| f.secs.abs() < 0.01));
        let middle = frames.iter().map(|f| f.lens_point).sum::<Vec2>() / 64.0;
        assert!(middle.length() < 0.0008, "{middle}");
        // A disc's mean square radius is half its radius squared.
        let square = frames.iter().map(|f| f.lens_point.length_squared()).sum::<f32>() / 64.0;
        assert!((square / (0.015f32.powi(2) / 2.0) - 1.0).abs() < 1e-3, "{square}");
        // Neither place nor side of the lens goes with time.
        let drift = frames.iter().map(|f| f.lens_point * f.secs as f32).sum::<Vec2>() / 64.0;
        assert!(drift.length() < 0.15 * 0.01 * 0.015, "{drift}");
        assert_eq!(OpticsConfig::default().sub_frames(), [SubFrame { secs: 0.0, lens_point: Vec2::ZERO }]);
    }
}
