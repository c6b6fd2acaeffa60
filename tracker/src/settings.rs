//! Settings of the pose that users choose, as keys of a configuration (serde) and options of commands (clap).

use clap::Args;
use serde::{Deserialize, Serialize};

/// Settings of pose and shape that depend on the rig and the person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Args)]
#[serde(default)]
pub struct PoseSettings {
    /// Distance that the body moves in a view until the network runs on that view again, metres; 0: on every view of every frame set.
    #[arg(skip = Self::default().look_after_m)]
    pub look_after_m: f64,
    /// Height of an estimated person in metres; by default measured.
    #[arg(long = "height", value_name = "METRES")]
    pub height_m: Option<f64>,
    /// Height of the floor in the calibration's world, along the rig's up, metres: a single camera measures people by where their feet
    /// stand.
    #[arg(long = "floor", value_name = "METRES", default_value_t = 0.0, allow_negative_numbers = true)]
    pub floor_m: f64,
}

impl Default for PoseSettings {
    fn default() -> Self {
        Self { look_after_m: 0.02, height_m: None, floor_m: 0.0 }
    }
}
