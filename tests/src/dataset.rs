//! A small data set in EasyMocap layout, made by the simulator.

use std::path::PathBuf;

use anyhow::Result;
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{ExportOptions, SimConfig, Simulator, export};
use tempfile::TempDir;

/// Side of the images, pixels.
pub const SIDE: u32 = 160;
/// Frames a camera, 30 a second.
pub const FRAMES: u64 = 6;

/// A data set that vanishes when dropped.
#[derive(Debug)]
pub struct Dataset {
    /// Its folder.
    pub root: PathBuf,
    folder: TempDir,
}

impl Dataset {
    /// A folder beside the data set for results.
    #[must_use]
    pub fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    /// Path of an image.
    #[must_use]
    pub fn picture(&self, camera: &str, frame: u64) -> PathBuf {
        self.root.join(format!("images/{camera}/{frame:06}.png"))
    }

    /// Path of a mask.
    #[must_use]
    pub fn mask(&self, camera: &str, frame: u64) -> PathBuf {
        self.root.join(format!("mask/{camera}/{frame:06}.png"))
    }
}

/// [`write_dataset_of`] the first person.
///
/// # Errors
/// See there.
pub fn write_dataset() -> Result<Dataset> {
    write_dataset_of(1)
}

/// Exports a simulated capture of the person of a seed before seven cameras, without the truth.
///
/// # Errors
/// When there is no adapter or the folder cannot be written.
pub fn write_dataset_of(seed: u64) -> Result<Dataset> {
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let mut config = SimConfig { seed, width: SIDE, height: SIDE, texture_px: 256, ..SimConfig::default() };
    // A fast turn, so that few frames show all sides.
    config.motion.turn_secs = 2.0;
    let mut simulator = Simulator::new(&gpu, &config)?;
    let folder = tempfile::tempdir()?;
    let root = folder.path().join("data");
    export(&mut simulator, &root, ExportOptions { frames: FRAMES, truth: false }, &mut |_| true)?;
    Ok(Dataset { root, folder })
}
