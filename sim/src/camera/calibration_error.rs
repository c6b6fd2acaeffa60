//! Errors of the reported calibration.

use flyrig_types::{Camera, Isometry, Rig};
use glam::{DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::sensor::{gaussian, hash};
use crate::error::SimError;
use crate::error::check;

/// Deviations of the reported cameras from the true ones, drawn per camera from Gaussians of these standard deviations
/// (per axis for rotation, translation and centre).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationError {
    /// Seed of the errors; the simulation's when `None`.
    pub seed: Option<u64>,
    /// Rotation about each axis of the camera, degrees.
    pub rotation_deg: f64,
    /// Position of the camera along each axis, millimetres.
    pub translation_mm: f64,
    /// Focal length, percent.
    pub focal_percent: f64,
    /// Principal point, pixels.
    pub center_px: f64,
}

impl CalibrationError {
    pub(crate) fn validate(&self) -> Result<(), SimError> {
        check("calibration_error.rotation_deg", self.rotation_deg, 0.0, 30.0, "0 to 30 degrees")?;
        check("calibration_error.translation_mm", self.translation_mm, 0.0, 1000.0, "0 to 1000 millimetres")?;
        check("calibration_error.focal_percent", self.focal_percent, 0.0, 20.0, "0 to 20 percent")?;
        check("calibration_error.center_px", self.center_px, 0.0, 500.0, "0 to 500 pixels")
    }

    /// Returns a rig as a calibration with these errors reports it.
    pub(crate) fn reported(&self, rig: &Rig, seed: u64) -> Rig {
        if *self == (Self { seed: self.seed, ..Self::default() }) {
            return rig.clone();
        }
        let key = hash(self.seed.unwrap_or(seed), 0x00ca_11b0);
        let cameras = rig.cameras.iter().zip(0u64..).map(|(camera, slot)| self.camera(camera, hash(key, slot)));
        Rig { cameras: cameras.collect(), world_up: rig.world_up }
    }

    fn camera(&self, camera: &Camera, key: u64) -> Camera {
        // A Gaussian's far tails must not turn a focal length negative.
        let draw = |index| f64::from(gaussian(key, index)).clamp(-4.0, 4.0);
        let three = |first| DVec3::new(draw(first), draw(first + 1), draw(first + 2));
        let mut reported = camera.clone();
        let turn = DQuat::from_scaled_axis(three(0) * self.rotation_deg.to_radians());
        let eye = camera.position() + three(3) * (self.translation_mm * 1e-3);
        let rotation = (turn * camera.camera_from_world.rotation).normalize();
        reported.camera_from_world = Isometry::new(rotation, -(rotation * eye));
        reported.intrinsics.focal_px *= 1.0 + draw(6) * self.focal_percent * 0.01;
        reported.intrinsics.center_px += DVec2::new(draw(7), draw(8)) * self.center_px;
        reported
    }
}
