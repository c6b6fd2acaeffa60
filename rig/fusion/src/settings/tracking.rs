//! Table `[tracking]`: the deformation of the surface.

use clap::{Args, ValueEnum};
use flyrig_tracker::{DeformSettings, DeformSolver};
use serde::{Deserialize, Serialize};

use super::range::check;
use crate::{deformation::options::DeformOptions, error::FusionError};

/// Weight of the nodes' distance from where clothes of their part's thickness would be. It holds what no view constrains: the depth before a
/// single camera, or a shift of all nodes that a corrected pose explains as well.
const ANCHOR: f64 = 100.0;
/// λ_reg of the paper's Eq. 3.
const PAPER_REGULARIZATION: f64 = 200.0;
/// Rate of the paper's gradient descent, square metres per unit of loss. The paper states none; of 1e-8 to 1e-5 this one lowered the loss
/// most on a simulated person at 512x512.
const PAPER_RATE: f64 = 3e-6;

/// Solver of the deformation beyond the pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// No deformation: the body is only skinned.
    #[value(name = "off", alias = "none")]
    #[serde(rename = "off", alias = "none")]
    None,
    /// Gradient descent as in the paper.
    Paper,
    /// Damped Gauss-Newton with the graph Laplacian.
    #[default]
    #[value(name = "default", alias = "gauss-newton")]
    #[serde(rename = "default", alias = "gauss-newton")]
    GaussNewton,
}

impl Solver {
    /// Returns the options of the deformation; `None` where the body is only skinned.
    #[must_use]
    pub fn options(self) -> Option<DeformOptions> {
        let default = DeformSettings::default();
        match self {
            Self::None => None,
            Self::Paper => Some(DeformOptions::full(DeformSettings {
                solver: DeformSolver::Paper { rate: PAPER_RATE },
                regularization: PAPER_REGULARIZATION,
                // The paper iterates on every frame.
                rest: 0.0,
                ..default
            })),
            Self::GaussNewton => Some(DeformOptions::coarse(DeformSettings { anchor: ANCHOR, ..default })),
        }
    }
}

/// Settings of the deformation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Args)]
#[serde(deny_unknown_fields, default)]
pub struct TrackingSettings {
    /// Solver with which the body follows the images beyond its pose; "off" is faster.
    #[arg(long, value_enum, default_value = "default")]
    pub solver: Solver,
    /// Number of Gaussians that the default solver compares with the images; the others follow.
    #[arg(skip = Self::default().gaussians)]
    pub gaussians: usize,
    /// Largest number of compared views; 0: all.
    #[arg(skip = Self::default().views)]
    pub views: usize,
    /// Whether every image is explained with the pose of its own capture time, for measurements.
    #[arg(skip = Self::default().per_view_time)]
    #[serde(skip)]
    pub per_view_time: bool,
    /// Options of the deformation in place of those that the settings above imply, for measurements.
    #[arg(skip)]
    #[serde(skip)]
    pub replaced: Option<DeformOptions>,
}

impl Default for TrackingSettings {
    fn default() -> Self {
        Self { solver: Solver::GaussNewton, gaussians: 30_000, views: 0, per_view_time: true, replaced: None }
    }
}

impl TrackingSettings {
    /// Returns the options of the deformation; `None` where the body is only skinned.
    #[must_use]
    pub fn options(&self) -> Option<DeformOptions> {
        let mut options = self.solver.options()?;
        if let Some(replaced) = self.replaced {
            return Some(replaced);
        }
        if self.solver == Solver::GaussNewton {
            options.gaussians = self.gaussians;
            options.views = self.views;
        }
        Some(options)
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`FusionError::Setting`] names the key and the range.
    pub fn validate(&self) -> Result<(), FusionError> {
        check("tracking.gaussians", self.gaussians as f64, 100.0, 2_000_000.0)?;
        check("tracking.views", self.views as f64, 0.0, 1000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::deformation::options::PAPER_COLOR_WEIGHT;

    #[test]
    fn the_papers_solver_has_the_papers_weights() {
        let options = Solver::Paper.options().unwrap();
        assert!((options.color_weight - PAPER_COLOR_WEIGHT).abs() < 1e-6);
        assert!((options.solver.regularization - 200.0).abs() < 1e-9);
        assert!(options.solver.rest <= 0.0, "every frame has its iterations");
        assert_eq!((options.gaussians, options.max_level), (usize::MAX, 0));
    }

    #[test]
    fn the_default_settings_change_nothing_about_the_default_solver() {
        assert_eq!(TrackingSettings::default().options(), Solver::GaussNewton.options());
    }
}
