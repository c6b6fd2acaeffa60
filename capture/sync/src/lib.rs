//! Capture times: frame sets of one instant, clocks of cameras, time offsets between cameras.
//!
//! Times are nanoseconds of the capturing host's `CLOCK_MONOTONIC`; an image's time is the middle of its exposure.

mod arrivals;
mod clocks;
#[cfg(test)]
mod clocks_tests;
mod hull;
mod lags;
mod overdue;
#[cfg(test)]
mod overdue_tests;
mod settings;
mod silhouette_lags;
mod sync;
#[cfg(test)]
mod sync_properties;

pub use clocks::{ClockAligner, ClockKind, ClockState};
pub use hull::{HullCorner, silhouette_hull};
pub use lags::{LagEstimate, MotionSignal, estimate_lags};
pub use settings::SyncSettings;
pub use silhouette_lags::{SilhouetteTrack, estimate_silhouette_lags};
pub use sync::{DropCounts, SyncCounts, Synchronizer};
