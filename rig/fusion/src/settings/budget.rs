//! Table `[budget]`: the frame rate to keep up with.

use clap::Args;
use serde::{Deserialize, Serialize};

use super::effort::Effort;
use super::range::check;
use crate::error::FusionError;

/// Settings of the time budget.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, Args)]
#[serde(deny_unknown_fields, default)]
pub struct BudgetSettings {
    /// Wanted frame sets per second: accuracy is given up, step by step, until so many are processed; 0: no accuracy is given up.
    // A name of its own: commands have frame rates as well.
    #[arg(id = "budget", long = "budget", value_name = "FPS", default_value_t = 0.0)]
    pub fps: f64,
    /// Constant effort in place of a budget, for measurements.
    #[arg(skip)]
    #[serde(skip)]
    pub effort: Option<Effort>,
}

impl BudgetSettings {
    /// Checks every value.
    ///
    /// # Errors
    /// [`FusionError::Setting`] names the key and the range.
    pub fn validate(&self) -> Result<(), FusionError> {
        check("budget.fps", self.fps, 0.0, 1000.0)
    }
}
