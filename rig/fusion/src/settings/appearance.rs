//! Table `[appearance]`: the colours of the Gaussians.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use flyrig_renderer::AppearanceSettings;
use flyrig_stfa::{EMBEDDED, Parameters};
use serde::{Deserialize, Serialize};

use crate::error::FusionError;

/// Method that colours the Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum AppearanceMode {
    /// Projection, spatial diffusion and temporal memory.
    #[default]
    Direct,
    /// Ablation without the temporal memory.
    #[value(hide = true)]
    DirectNoTime,
    /// Ablation with projection only, the paper's "w/o ST" baseline.
    #[value(hide = true)]
    DirectNoSpaceTime,
    /// `direct`, and the corrections of trained networks.
    Stfa,
    /// Ablation of `stfa` without the temporal memory.
    #[value(hide = true)]
    StfaNoTime,
    /// Ablation of `stfa` without graph and memory.
    #[value(hide = true)]
    StfaNoSpaceTime,
}

impl AppearanceMode {
    /// Returns the renderer's settings of the mode.
    #[must_use]
    pub fn settings(self) -> AppearanceSettings {
        let (space, time) = match self {
            Self::Direct | Self::Stfa => (true, true),
            Self::DirectNoTime | Self::StfaNoTime => (true, false),
            Self::DirectNoSpaceTime | Self::StfaNoSpaceTime => (false, false),
        };
        AppearanceSettings { space, time, ..AppearanceSettings::default() }
    }

    /// Returns whether the mode leaves parts of the method out, for measurements only.
    #[must_use]
    pub fn is_ablation(self) -> bool {
        !matches!(self, Self::Direct | Self::Stfa)
    }

    /// Returns whether networks correct direct appearance.
    #[must_use]
    pub fn is_learned(self) -> bool {
        matches!(self, Self::Stfa | Self::StfaNoTime | Self::StfaNoSpaceTime)
    }
}

/// Settings of appearance and its networks.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, Args)]
#[serde(deny_unknown_fields, default)]
pub struct AppearanceOptions {
    /// Method that colours the Gaussians.
    #[arg(long = "appearance", value_enum, default_value = "direct")]
    pub mode: AppearanceMode,
    /// Weights file of the learned modes; "small" or "tiny" for the networks that come with flyrig [default: small].
    #[arg(long)]
    #[serde(with = "path_or_empty")]
    pub weights: Option<PathBuf>,
}

impl AppearanceOptions {
    /// Loads the networks that correct direct appearance; `None` for the direct modes.
    ///
    /// # Errors
    /// [`FusionError::Networks`] when the weights cannot be read.
    pub fn load_networks(&self) -> Result<Option<Parameters>, FusionError> {
        if !self.mode.is_learned() {
            return Ok(None);
        }
        Ok(Some(Parameters::named(self.weights.as_deref().unwrap_or(Path::new(EMBEDDED[0].0)))?))
    }
}

/// Serialization of an optional path; empty for `None`.
mod path_or_empty {
    use std::path::PathBuf;

    use serde::{Deserialize as _, Deserializer, Serialize as _, Serializer};

    pub fn serialize<S: Serializer>(path: &Option<PathBuf>, to: S) -> Result<S::Ok, S::Error> {
        path.clone().unwrap_or_default().serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<PathBuf>, D::Error> {
        Ok(Some(PathBuf::deserialize(from)?).filter(|path| !path.as_os_str().is_empty()))
    }
}
