//! Direct appearance.
mod hierarchy;
mod settings;
mod update;
pub use hierarchy::{DiffusionHierarchy, DiffusionLevel};
pub use settings::{AppearanceError, AppearanceSettings, ViewInput};
pub use update::DirectAppearance;
