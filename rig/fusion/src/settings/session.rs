//! Settings of a session: all its tables.

use super::{
    appearance::AppearanceOptions, body::BodySettings, budget::BudgetSettings, perception::PerceptionSettings,
    tracking::TrackingSettings,
};
use crate::error::FusionError;

/// Settings of a session.
///
/// # Example
/// ```
/// use flyrig_fusion::{BodySettings, SessionSettings};
///
/// let mut settings = SessionSettings { body: BodySettings::with_gaussians(12_000), ..SessionSettings::default() };
/// settings.perception.people = 2;
/// settings.validate()?;
///
/// settings.perception.people = 9;
/// let error = settings.validate().unwrap_err().to_string();
/// assert_eq!(error, "perception.people is 9, it must lie between 1 and 4");
/// # Ok::<(), flyrig_fusion::FusionError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SessionSettings {
    /// Sources of poses, shapes and masks.
    pub perception: PerceptionSettings,
    /// Surface of the person.
    pub body: BodySettings,
    /// Deformation of the surface.
    pub tracking: TrackingSettings,
    /// Colours of the Gaussians.
    pub appearance: AppearanceOptions,
    /// Frame rate to keep up with.
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
        if self.body.learn && self.appearance.mode.is_learned() {
            return Err(FusionError::Setting(
                "body.learn needs appearance.mode = \"direct\": networks do not paint an avatar".to_owned(),
            ));
        }
        self.budget.validate()
    }
}
