//! Table `[perception]`: the sources of poses, shapes and masks.

use std::path::PathBuf;

use clap::builder::{OsStringValueParser, TypedValueParser as _};
use clap::{Args, ValueEnum};
use flyrig_tracker::{KeyColor, PoseSettings};
use serde::{Deserialize, Serialize};

use super::range::check;
use crate::error::FusionError;

/// Source of a pose, a shape or a mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Origin {
    /// From the source or the data set.
    Given,
    /// From the images.
    #[default]
    Estimated,
}

/// Settings of perception: the sources of poses, shapes and masks, and the search for people.
///
/// A configuration estimates everything by default. The options of commands that replay data sets default to the poses, shapes and masks
/// that come with the data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Args)]
#[serde(deny_unknown_fields, default)]
pub struct PerceptionSettings {
    /// Pose from the data set's glTF animation, or from the images.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Masks from the data set, or from the images.
    #[arg(long, value_enum, default_value = "given")]
    pub masks: Origin,
    /// Shape of the body from the data set's glTF file, or from the images; by default from the source of the pose.
    #[arg(long, value_enum)]
    pub shape: Option<Origin>,
    /// Fingers and the head's rotation: as the pose has them (with an estimated pose fingers are at rest), or from landmarks
    /// of hands and face in the images. The latter needs an estimated pose and a body with fingers, as the built-in one.
    #[arg(long, value_enum, default_value = "given")]
    pub hands: Origin,
    /// Largest number of tracked people, 1 to 4; with 1 the person on whom most views agree.
    #[arg(long, default_value_t = 1)]
    pub people: usize,
    /// Landmark network: "full" or "lite" (built in; 4 to 8 ms less per frame set, less accurate), an ONNX file with another BlazePose, or a
    /// TOML file that describes any other network, which needs two cameras or more (docs/guide/people.md). Empty: "full".
    #[arg(long, value_name = "NETWORK", default_value = "", hide_default_value = true,
        value_parser = OsStringValueParser::new().map(PathBuf::from))]
    pub network: PathBuf,
    /// Settings of the pose, as keys of this table.
    #[command(flatten)]
    #[serde(flatten)]
    pub tracker: PoseSettings,
    /// Colour of a screen behind the people: "green", "blue" or one like "#00b140"; empty without a screen.
    #[arg(long, value_name = "COLOUR", default_value = "", hide_default_value = true)]
    pub key_color: String,
    /// Folder of the plates CAM.png (`flyrig plate`); background/ in the data set or the calibration's folder by default.
    // The parser of paths refuses an empty default.
    #[arg(long, value_name = "FOLDER", default_value = "", hide_default_value = true,
        value_parser = OsStringValueParser::new().map(PathBuf::from))]
    pub plates: PathBuf,
}

impl Default for PerceptionSettings {
    fn default() -> Self {
        Self {
            pose: Origin::Estimated,
            masks: Origin::Estimated,
            hands: Origin::Given,
            shape: None,
            people: 1,
            network: PathBuf::new(),
            tracker: PoseSettings::default(),
            key_color: String::new(),
            plates: PathBuf::new(),
        }
    }
}

impl PerceptionSettings {
    /// Returns settings that take pose, shape and masks from the source.
    #[must_use]
    pub fn given() -> Self {
        Self { pose: Origin::Given, masks: Origin::Given, ..Self::default() }
    }

    /// Returns the source of the shape.
    #[must_use]
    pub fn shape(&self) -> Origin {
        self.shape.unwrap_or(self.pose)
    }

    /// Returns the key colour; `None` for an empty one.
    pub(crate) fn key(&self) -> Result<Option<KeyColor>, FusionError> {
        let text = self.key_color.as_str();
        let parsed = (!text.is_empty()).then(|| text.parse::<KeyColor>()).transpose();
        parsed.map_err(|error| FusionError::Setting(format!("perception.key_color: {error}")))
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`FusionError::Setting`] names the key and the range.
    pub fn validate(&self) -> Result<(), FusionError> {
        check("perception.people", self.people as f64, 1.0, 4.0)?;
        check("perception.look_after_m", self.tracker.look_after_m, 0.0, 1.0)?;
        self.key()?;
        if self.hands == Origin::Estimated && self.pose == Origin::Given {
            return Err(FusionError::Setting(
                "perception.hands = \"estimated\" needs perception.pose = \"estimated\"; a given pose brings its own fingers"
                    .to_owned(),
            ));
        }
        check("perception.floor_m", self.tracker.floor_m, -10.0, 10.0)?;
        self.tracker.height_m.map_or(Ok(()), |height| check("perception.height_m", height, 0.5, 2.5))
    }
}
