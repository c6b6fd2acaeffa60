//! Files that the commands write.

use std::path::Path;

use anyhow::{Result, bail};

/// Files of a calibrated rig.
pub(super) const FILES: [&str; 2] = ["calibration.toml", "calibration.json"];

/// Name of the page about the calibration.
pub(super) const PAGE: &str = "calibration.html";
/// Folder of the lenses, in that of a calibration whose cameras could not be joined.
pub(super) const LENSES: &str = "lenses";

/// Refuses to replace files of an earlier run, unless forced.
pub(super) fn refuse_existing(folder: &Path, names: &[&str], force: bool) -> Result<()> {
    match names.iter().map(|name| folder.join(name)).find(|file| file.exists()) {
        Some(known) if !force => bail!("{} is there already; --force replaces it", known.display()),
        _ => Ok(()),
    }
}
