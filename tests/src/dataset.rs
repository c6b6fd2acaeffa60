//! A small data set in EasyMocap layout, made by the simulator.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use flyrig_body::write_glb;
use flyrig_calib::save_easymocap;
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator};
use tempfile::TempDir;

/// Side of the pictures, pixels.
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

    /// Path of a picture.
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

/// Simulates the person of a seed before seven cameras and writes pictures, masks, plates, calibration and the unclothed body with
/// its motion.
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
    for slot in 0..simulator.rig().cameras.len() {
        let id = simulator.rig().cameras[slot].id.clone();
        let folders = ["images", "mask"].map(|kind| root.join(kind).join(id.as_str()));
        for folder in &folders {
            std::fs::create_dir_all(folder)?;
        }
        std::fs::create_dir_all(root.join("background"))?;
        save_rgb(&root.join(format!("background/{id}.png")), simulator.plate(slot)?.bytes())?;
        for frame in 0..FRAMES {
            // Far enough apart that the person turns visibly.
            let (picture, mask) = simulator.capture(simulator.frame_nanos(frame), slot)?;
            save_rgb(&folders[0].join(format!("{frame:06}.png")), picture.bytes())?;
            let mask = image::GrayImage::from_raw(SIDE, SIDE, mask.coverage().to_vec()).context("mask size")?;
            mask.save(folders[1].join(format!("{frame:06}.png")))?;
        }
    }
    save_easymocap(&root, simulator.rig())?;
    write_glb(&root.join("subject.glb"), simulator.template(), simulator.track())?;
    Ok(Dataset { root, folder })
}

fn save_rgb(path: &Path, rgb: &[u8]) -> Result<()> {
    let picture = image::RgbImage::from_raw(SIDE, SIDE, rgb.to_vec()).context("picture size")?;
    picture.save(path).with_context(|| format!("writing {}", path.display()))
}
