//! Where the cameras are: calibration files.
//!
//! Conventions are those of `flyrig_types`: OpenCV camera axes, pixel centres at integers, metres.

mod easymocap;
mod error;
mod yaml;

pub use easymocap::{load_easymocap, save_easymocap};
pub use error::CalibError;
