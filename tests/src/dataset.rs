//! Small simulated data set in EasyMocap layout.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::Result;
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{ExportOptions, SimConfig, Simulator, export};
use tempfile::TempDir;

/// Side of the images, pixels.
pub const SIDE: u32 = 160;
/// Frames per camera, at 30 frames per second.
pub const FRAMES: u64 = 6;

/// Data set that is deleted when dropped.
#[derive(Debug)]
pub struct Dataset {
    /// Folder of the data set.
    pub root: PathBuf,
    folder: TempDir,
}

impl Dataset {
    /// Returns a folder beside the data set, for results.
    #[must_use]
    pub fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    /// Returns the path of an image.
    #[must_use]
    pub fn picture(&self, camera: &str, frame: u64) -> PathBuf {
        self.root.join(format!("images/{camera}/{frame:06}.png"))
    }

    /// Returns the path of a mask.
    #[must_use]
    pub fn mask(&self, camera: &str, frame: u64) -> PathBuf {
        self.root.join(format!("mask/{camera}/{frame:06}.png"))
    }
}

/// Calls [`write_dataset_of`] with the first seed.
///
/// # Errors
/// Fails as [`write_dataset_of`] does.
pub fn write_dataset() -> Result<Dataset> {
    write_dataset_of(1)
}

/// Exports a simulated capture of the person with this seed by seven cameras, without ground truth.
///
/// # Errors
/// Fails when there is no graphics adapter or the folder cannot be written.
pub fn write_dataset_of(seed: u64) -> Result<Dataset> {
    write(seed, ExportOptions { frames: FRAMES, truth: false })
}

/// Exports the first frames of the same capture with its ground truth.
///
/// # Errors
/// Fails as [`write_dataset_of`] does.
pub fn write_dataset_with_truth(seed: u64, frames: u64) -> Result<Dataset> {
    write(seed, ExportOptions { frames, truth: true })
}

fn write(seed: u64, options: ExportOptions) -> Result<Dataset> {
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let mut config = SimConfig { seed, width: SIDE, height: SIDE, texture_px: 256, ..SimConfig::default() };
    // Turn fast, so that few frames show every side.
    config.motion.turn_secs = 2.0;
    let mut simulator = Simulator::new(&gpu, &config)?;
    let folder = tempfile::tempdir()?;
    let root = folder.path().join("data");
    export(&mut simulator, &root, options, &mut |_| true)?;
    // The simulator's calibration is right.
    flyrig_takes::mark_checked(&root)?;
    Ok(Dataset { root, folder })
}

/// Copies a folder with all that is in it into another one, which need not exist.
///
/// # Errors
/// A file cannot be read or written.
pub fn copy_folder(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let (path, target) = entry.map(|entry| (entry.path(), to.join(entry.file_name())))?;
        if path.is_dir() {
            copy_folder(&path, &target)?;
        } else {
            fs::copy(&path, &target)?;
        }
    }
    Ok(())
}
