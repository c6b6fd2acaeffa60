//! Publishing of views, Gaussians, people and statistics to viewers.
//!
//! Threads compress and encode; `transport::Publisher` sends the newest. The session never waits for any of them.

pub(crate) mod live_publisher;
pub(crate) mod live_views;
pub(crate) mod orbit;
mod person_publisher;

pub use live_publisher::LivePublisher;
pub use live_views::{LiveViews, OutputSettings};
pub use orbit::orbit;
pub use person_publisher::{PersonEncoder, PersonMessages};
