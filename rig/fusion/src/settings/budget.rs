//! The table `[budget]`.

use clap::Args;
use serde::{Deserialize, Serialize};

use super::check;
use crate::{Effort, FusionError};

/// How fast sets have to be taken in.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, Args)]
#[serde(deny_unknown_fields, default)]
pub struct BudgetSettings {
    /// Sets a second that are wanted: accuracy is given up, step by step, until so many are taken in; 0: none is.
    // A name of its own: commands have frame rates as well.
    #[arg(id = "budget", long = "budget", value_name = "FPS", default_value_t = 0.0)]
    pub fps: f64,
    /// The same effort for every set in place of a budget, for measurements.
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
