//! Where the cameras are and when their pictures were taken: calibration files and time sync.
//!
//! Conventions are those of `flyrig_types`: OpenCV camera axes, pixel centres at integers, metres,
//! nanoseconds.

mod clocks;
#[cfg(test)]
mod clocks_tests;
mod easymocap;
mod error;
mod lags;
#[cfg(test)]
mod random;
mod silhouette_lags;
mod sync;
#[cfg(test)]
mod sync_properties;
mod yaml;

pub use clocks::{ClockAligner, ClockKind, ClockState};
pub use easymocap::{load_easymocap, save_easymocap};
pub use error::CalibError;
pub use lags::{LagEstimate, MotionSignal, estimate_lags};
pub use silhouette_lags::{SilhouetteTrack, estimate_silhouette_lags};
pub use sync::{DropCounts, SyncConfig, SyncCounts, Synchronizer};
