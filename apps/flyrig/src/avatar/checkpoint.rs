//! The state of a build beside its avatar, from which the same command goes on after it was killed.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use flyrig_avatar::{Avatar, Fit, FitProgress};
use flyrig_report::write_whole;

use super::build::AvatarBuildArgs;

/// Ending of the file.
const ENDING: &str = "fit";

/// File of a build's state.
pub(super) struct Checkpoint {
    path: PathBuf,
    /// Everything that the result depends on.
    settings: String,
}

impl Checkpoint {
    /// Beside the avatar that is built from so many images.
    pub fn new(args: &AvatarBuildArgs, images: usize) -> Self {
        Self { path: args.out.with_extension(ENDING), settings: format!("{images} images, {args:?}") }
    }

    /// Goes on from the file, if there is one of the same build; one of another build is left alone with a warning.
    pub fn resume(&self, fit: &mut Fit, avatar: &mut Avatar) -> Result<Option<FitProgress>> {
        if !self.path.exists() {
            return Ok(None);
        }
        let bytes = std::fs::read(&self.path).with_context(|| format!("cannot read {}", self.path.display()))?;
        match fit.resume(avatar, &bytes, &self.settings) {
            Ok(progress) => {
                println!("going on after {} of {} steps, from {}", progress.done, progress.total, self.path.display());
                Ok(Some(progress))
            }
            Err(problem) => {
                tracing::warn!("{} {problem}: the build starts anew", self.path.display());
                Ok(None)
            }
        }
    }

    /// Writes the state, whole or not at all.
    pub fn save(&self, fit: &mut Fit, avatar: &mut Avatar, total: u64) -> Result<()> {
        write_whole(&self.path, &fit.checkpoint(avatar, &self.settings, total)?)
    }

    /// Removes the file of a build that is done.
    pub fn remove(&self) -> Result<()> {
        match std::fs::remove_file(&self.path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(error).with_context(|| format!("cannot remove {}", self.path.display()))
            }
            _ => Ok(()),
        }
    }
}
