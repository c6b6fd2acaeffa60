//! Table `[body]`: the surface of a person.

use std::path::{Path, PathBuf};

use clap::Args;
use flyrig_body::{DEFAULT_GAUSSIAN_COUNT, DEFAULT_NODE_COUNT};
use serde::{Deserialize, Serialize};

use super::range::check;
use crate::error::FusionError;

/// Fewest Gaussians per node of a small deformation graph.
const GAUSSIANS_A_NODE: usize = 12;

/// Settings of the person's surface.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Args)]
#[serde(deny_unknown_fields, default)]
pub struct BodySettings {
    /// Skinned glTF file; empty: the built-in body.
    #[arg(skip)]
    pub template: PathBuf,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT)]
    pub gaussians: usize,
    /// Nodes of the deformation graph.
    #[arg(long, default_value_t = DEFAULT_NODE_COUNT)]
    pub nodes: usize,
    /// File with the memory of the person; empty: none.
    #[arg(skip)]
    pub person: PathBuf,
    /// File of the first person's avatar: tracking and colours start from it; empty: none.
    #[arg(skip)]
    pub avatar: PathBuf,
    /// Learn the person while the rig runs: an avatar is fitted to the past, and used where it shows views better.
    #[arg(long)]
    pub learn: bool,
}

impl Default for BodySettings {
    fn default() -> Self {
        Self {
            template: PathBuf::new(),
            gaussians: DEFAULT_GAUSSIAN_COUNT,
            nodes: DEFAULT_NODE_COUNT,
            person: PathBuf::new(),
            avatar: PathBuf::new(),
            learn: false,
        }
    }
}

impl BodySettings {
    /// Returns the defaults with another number of Gaussians and a graph that is not too fine for them.
    #[must_use]
    pub fn with_gaussians(gaussians: usize) -> Self {
        Self { gaussians, nodes: DEFAULT_NODE_COUNT.min(gaussians / GAUSSIANS_A_NODE), ..Self::default() }
    }

    /// Returns the file with the memory of the person, where one is named.
    #[must_use]
    pub fn person_file(&self) -> Option<&Path> {
        Some(self.person.as_path()).filter(|path| !path.as_os_str().is_empty())
    }

    /// Returns the file of the first person's avatar, where one is named.
    #[must_use]
    pub fn avatar_file(&self) -> Option<&Path> {
        Some(self.avatar.as_path()).filter(|path| !path.as_os_str().is_empty())
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`FusionError::Setting`] names the key and the range.
    pub fn validate(&self) -> Result<(), FusionError> {
        check("body.gaussians", self.gaussians as f64, 100.0, 2_000_000.0)?;
        check("body.nodes", self.nodes as f64, 4.0, 100_000.0)?;
        if self.nodes > self.gaussians {
            return Err(FusionError::Setting(format!(
                "body.nodes is {}, more than body.gaussians ({}): nodes are chosen among the Gaussians",
                self.nodes, self.gaussians
            )));
        }
        if let (Some(avatar), Some(person)) = (self.avatar_file(), self.person_file()) {
            return Err(FusionError::Setting(format!(
                "body.avatar ({}) and body.person ({}) both say what the person looks like; leave one of them empty",
                avatar.display(),
                person.display()
            )));
        }
        Ok(())
    }
}
