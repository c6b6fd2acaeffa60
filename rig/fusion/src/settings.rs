//! Settings of a session. Each struct is a table of a configuration (serde) and a group of command-line options (clap).

mod appearance;
mod body;
mod budget;
mod perception;
mod tracking;

pub use appearance::{AppearanceMode, AppearanceOptions};
pub use body::BodySettings;
pub use budget::BudgetSettings;
pub use perception::{Origin, PerceptionSettings};
pub use tracking::{Solver, TrackingSettings};

use crate::FusionError;

/// Everything that may be chosen about a session.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SessionSettings {
    /// Where poses and masks come from.
    pub perception: PerceptionSettings,
    /// The person's surface.
    pub body: BodySettings,
    /// How the surface follows the images.
    pub tracking: TrackingSettings,
    /// How Gaussians get their colours.
    pub appearance: AppearanceOptions,
    /// How fast sets have to be taken in.
    pub budget: BudgetSettings,
}

impl SessionSettings {
    /// Checks every value.
    ///
    /// # Errors
    /// [`FusionError::Setting`] names the key and the range.
    pub fn validate(&self) -> Result<(), FusionError> {
        self.perception.validate()?;
        self.body.validate()?;
        self.tracking.validate()?;
        self.budget.validate()
    }
}

/// Checks that a value lies in a range.
pub(crate) fn check(key: &str, value: f64, low: f64, high: f64) -> Result<(), FusionError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(FusionError::Setting(format!("{key} is {value}, it must lie between {low} and {high}")))
}
