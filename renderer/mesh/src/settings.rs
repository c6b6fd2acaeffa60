//! Settings of the fusion, derived from the density and uncertainty of the points.

use std::f32::consts::{FRAC_PI_3, PI};

use crate::density::{Density, median};
use crate::error::MeshError;
use crate::points::OrientedPoints;

/// Smallest voxel, metres.
const MIN_VOXEL_M: f32 = 1e-4;

/// Way of fusing points into signed distances.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Fusion {
    /// Decay with distance, and an angle test between the normals of voxel and point (HGM, Eq. 18).
    #[default]
    Hgm,
    /// Equal weights for all points within the truncation distance, whatever their normals.
    Naive,
}

/// Lengths of the grid and of the fusion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusionSettings {
    /// Side of a voxel, metres.
    pub voxel_m: f32,
    /// Bound of signed distances, and radius around a point in which it is evidence, metres.
    pub truncation_m: f32,
    /// Largest accepted angle between the normals of voxel and point, radians (`theta_t` of Eq. 18).
    pub angle_rad: f32,
    /// Standard deviation of the weight over distance, metres (`sigma` of Eq. 18).
    pub decay_m: f32,
    /// Median spacing of the points, metres; lower bound of `decay_m` in [`Self::with_voxel`].
    pub spacing_m: f32,
    /// Median uncertainty of the points, metres; lower bound of `decay_m` in [`Self::with_voxel`].
    pub uncertainty_m: f32,
}

impl FusionSettings {
    /// Derives all settings from the points: voxels of twice the spacing.
    ///
    /// # Errors
    /// [`MeshError::Coincident`] if the points have no spacing.
    pub fn from_points(points: &OrientedPoints) -> Result<Self, MeshError> {
        Ok(Self::from_density(points, &Density::measure(points)?))
    }

    /// Derives all settings from points of measured density.
    #[must_use]
    pub fn from_density(points: &OrientedPoints, density: &Density) -> Self {
        let spacing_m = density.spacing_m();
        let settings = Self {
            voxel_m: 0.0,
            truncation_m: 0.0,
            angle_rad: FRAC_PI_3,
            decay_m: 0.0,
            spacing_m,
            uncertainty_m: median(points.uncertainties().to_vec()),
        };
        settings.with_voxel((2.0 * spacing_m).max(MIN_VOXEL_M))
    }

    /// Returns settings for voxels of side `voxel_m`: the decay covers about a voxel, neighbouring points and the noise of
    /// positions; the truncation distance covers three voxels, the decay and the noise.
    #[must_use]
    pub fn with_voxel(self, voxel_m: f32) -> Self {
        let decay_m = (0.6 * voxel_m).max(1.2 * self.spacing_m).max(1.5 * self.uncertainty_m);
        let truncation_m = (3.0 * voxel_m).max(2.5 * decay_m).max(voxel_m + 3.0 * self.uncertainty_m);
        Self { voxel_m, truncation_m, decay_m, ..self }
    }

    /// Checks the ranges of the settings.
    ///
    /// # Errors
    /// [`MeshError::Setting`] with the first setting that is outside its range.
    pub fn check(&self) -> Result<(), MeshError> {
        let rejected = |name, value, fix| Err(MeshError::Setting { name, value, fix });
        if !(MIN_VOXEL_M..=1.0).contains(&self.voxel_m) {
            return rejected("voxel_m", self.voxel_m, "voxels have 0.0001 to 1 m");
        }
        if !(self.voxel_m * 1.8..=self.voxel_m * 32.0).contains(&self.truncation_m) {
            return rejected(
                "truncation_m",
                self.truncation_m,
                "it has 1.8 to 32 voxels and at least three spacings of the points; choose larger voxels or more points",
            );
        }
        if !(0.0..=PI).contains(&self.angle_rad) {
            return rejected("angle_rad", self.angle_rad, "angles have 0 to pi radians");
        }
        if !(self.truncation_m * 0.01..=self.truncation_m * 100.0).contains(&self.decay_m) {
            return rejected("decay_m", self.decay_m, "the decay has 0.01 to 100 truncation distances");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_follow_the_voxel_and_the_noise() {
        let settings = FusionSettings {
            voxel_m: 0.0,
            truncation_m: 0.0,
            angle_rad: 1.0,
            decay_m: 0.0,
            spacing_m: 0.002,
            uncertainty_m: 0.0,
        };
        let fine = settings.with_voxel(0.002);
        assert!((fine.decay_m - 0.0024).abs() < 1e-6 && (fine.truncation_m - 0.006).abs() < 1e-6);
        let noisy = FusionSettings { uncertainty_m: 0.01, ..settings }.with_voxel(0.002);
        assert!(noisy.decay_m > 0.01 && noisy.truncation_m > 0.03);
        assert!(fine.check().is_ok() && noisy.check().is_ok());
    }

    #[test]
    fn settings_outside_their_ranges_are_errors() {
        let good = FusionSettings {
            voxel_m: 0.006,
            truncation_m: 0.018,
            angle_rad: 1.0,
            decay_m: 0.004,
            spacing_m: 0.003,
            uncertainty_m: 0.0,
        };
        assert!(good.check().is_ok());
        for value in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-9, 1e9] {
            assert!(FusionSettings { voxel_m: value, ..good }.check().is_err(), "{value}");
            assert!(good.with_voxel(value).check().is_err(), "{value}");
            assert!(FusionSettings { truncation_m: value, ..good }.check().is_err(), "{value}");
            assert!(FusionSettings { decay_m: value, ..good }.check().is_err(), "{value}");
        }
        assert!(FusionSettings { angle_rad: 4.0, ..good }.check().is_err());
    }
}
