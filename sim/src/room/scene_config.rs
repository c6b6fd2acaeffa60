//! Configuration of the scene and its lamps.

use serde::{Deserialize, Serialize};

use crate::error::SimError;
use crate::error::check;

/// Most lamps of a scene.
pub(crate) const MAX_LAMPS: usize = 3;

/// Kind of room.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SceneKind {
    /// Studio with a plank floor, a paper backdrop, stands, cases and soft boxes.
    #[default]
    Studio,
    /// Office with desks, chairs, screens, bookshelves, plants, ceiling panels and a window.
    Office,
    /// Room full of objects: shelves, boxes, a sofa, rugs, posters, plants, lamps.
    Cluttered,
    /// One of the others, chosen by the seed.
    BySeed,
}

/// Room and other people in it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SceneConfig {
    /// Kind of room.
    pub kind: SceneKind,
    /// Seed of the room, its colours and its lamps; the simulation's when `None`.
    pub seed: Option<u64>,
    /// Pieces of furniture (0 to 6) between cameras and the person, none of them within 1.15 m of the centre.
    pub occluders: u32,
    /// Whether a second person walks through.
    pub passer_by: bool,
}

/// Lamp; the person stands in the centre of the ring, and camera 0 is at azimuth -90 degrees.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LightConfig {
    /// Direction from the centre, degrees counter-clockwise from the x axis seen from above.
    pub azimuth_deg: f64,
    /// Direction above the horizon, seen from the lamp's target, degrees.
    pub elevation_deg: f64,
    /// Distance from the lamp's target (the centre, 0.9 m above the floor), metres.
    pub distance_m: f64,
    /// Light on a white surface in the centre that faces the lamp: 1 is the brightest sRGB value at exposure 1.
    pub intensity: f64,
    /// Linear colour; the largest channel counts as 1.
    pub colour: [f64; 3],
    /// Width of the lamp, which softens its shadows, metres.
    pub size_m: f64,
    /// Changes of its light, in order of time.
    pub switch: Vec<LightSwitch>,
}

/// Instantaneous change of a lamp's light.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightSwitch {
    /// Seconds from the start.
    pub secs: f64,
    /// Factor on the intensity from then on; 1 before the first switch.
    pub level: f64,
}

impl Default for LightConfig {
    fn default() -> Self {
        Self {
            azimuth_deg: -125.0,
            elevation_deg: 36.0,
            distance_m: 3.6,
            intensity: 0.8,
            colour: [1.0, 0.96, 0.90],
            size_m: 0.35,
            switch: Vec::new(),
        }
    }
}

impl SceneConfig {
    pub(crate) fn validate(&self, ring_radius_m: f64) -> Result<(), SimError> {
        check("scene.occluders", self.occluders.into(), 0.0, 6.0, "0 to 6 pieces")?;
        if self.occluders > 0 {
            let expected = "at least 2.2 metres where scene.occluders have to stand between cameras and person";
            check("cameras.radius_m", ring_radius_m, 2.2, 6.0, expected)?;
        }
        Ok(())
    }
}

impl LightConfig {
    pub(crate) fn validate_all(lights: &[Self]) -> Result<(), SimError> {
        check("lights", lights.len() as f64, 0.0, MAX_LAMPS as f64, "at most 3 lights (none for the scene's own)")?;
        lights.iter().try_for_each(Self::validate)
    }

    fn validate(&self) -> Result<(), SimError> {
        check("lights.azimuth_deg", self.azimuth_deg, -360.0, 360.0, "-360 to 360 degrees")?;
        check("lights.elevation_deg", self.elevation_deg, 0.0, 90.0, "0 to 90 degrees")?;
        check("lights.distance_m", self.distance_m, 1.5, 20.0, "1.5 to 20 metres")?;
        check("lights.intensity", self.intensity, 0.0, 16.0, "0 to 16")?;
        for part in self.colour {
            check("lights.colour", part, 0.0, 1.0, "parts from 0 to 1")?;
        }
        if self.colour.iter().all(|&part| part < 0.01) {
            let found = format!("{:?}", self.colour);
            return Err(SimError::Config { field: "lights.colour", found, expected: "some colour" });
        }
        check("lights.size_m", self.size_m, 0.02, 1.5, "0.02 to 1.5 metres")?;
        let mut earlier = f64::NEG_INFINITY;
        for switch in &self.switch {
            check("lights.switch.secs", switch.secs, -1e6, 1e6, "-1000000 to 1000000 seconds")?;
            check("lights.switch.level", switch.level, 0.0, 16.0, "0 to 16")?;
            if switch.secs < earlier {
                let found = switch.secs.to_string();
                return Err(SimError::Config { field: "lights.switch.secs", found, expected: "times in order" });
            }
            earlier = switch.secs;
        }
        Ok(())
    }

    /// Returns the factor on the intensity at a time.
    pub(crate) fn level(&self, secs: f64) -> f64 {
        self.switch.iter().rev().find(|switch| switch.secs <= secs).map_or(1.0, |switch| switch.level)
    }
}
