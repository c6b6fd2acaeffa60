//! Settings of a session. Each struct is a table of a configuration (serde) and a group of command-line options (clap).

pub(crate) mod appearance;
pub(crate) mod body;
pub(crate) mod budget;
pub(crate) mod effort;
pub(crate) mod perception;
pub(crate) mod range;
pub(crate) mod session;
pub(crate) mod tracking;

pub use appearance::{AppearanceMode, AppearanceOptions};
pub use body::BodySettings;
pub use budget::BudgetSettings;
pub use effort::Effort;
pub use perception::{Origin, PerceptionSettings};
pub use session::SessionSettings;
pub use tracking::{Solver, TrackingSettings};
