//! Checkpoint of a build beside its avatar, from which the same command resumes after it was killed.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use flyrig_fit::{Fit, FitProgress, Model};
use flyrig_report::write_whole;

/// Ending of the file's name.
const ENDING: &str = "fit";

/// File with the state of a build.
pub(super) struct Checkpoint {
    path: PathBuf,
    /// Description of everything that the result depends on.
    settings: String,
}

impl Checkpoint {
    /// Returns the checkpoint beside an avatar. `settings` describes everything that the result depends on.
    pub fn new(avatar: &Path, settings: String) -> Self {
        Self { path: avatar.with_extension(ENDING), settings }
    }

    /// Resumes from the file if there is one of the same build; ignores that of another build with a warning.
    pub fn resume<M: Model>(&self, fit: &mut Fit<M>) -> Result<Option<FitProgress>> {
        if !self.path.exists() {
            return Ok(None);
        }
        let bytes = std::fs::read(&self.path).with_context(|| format!("cannot read {}", self.path.display()))?;
        match fit.resume(&bytes, &self.settings) {
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
    pub fn save<M: Model>(&self, fit: &mut Fit<M>, total: u64) -> Result<()> {
        write_whole(&self.path, &fit.checkpoint(&self.settings, total)?)
    }

    /// Removes the file of a finished build.
    pub fn remove(&self) -> Result<()> {
        match std::fs::remove_file(&self.path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(error).with_context(|| format!("cannot remove {}", self.path.display()))
            }
            _ => Ok(()),
        }
    }
}
