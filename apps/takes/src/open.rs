//! Opening of takes: what a command line names, with or without its calibration.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use flyrig_capture::FolderOptions;
use flyrig_gpu::GpuContext;

use crate::{
    configured::TakeConfig,
    footage::{Footage, INPUTS},
    recorded::recorded_cameras,
    take::{Calibration, Needs, Take, ready},
    video_files::has_ending,
};

/// Source of a take.
#[derive(Debug, Clone)]
pub enum TakeInput {
    /// Stored images.
    Footage(Footage),
    /// Cameras of a configuration.
    Configuration(Box<TakeConfig>),
}

impl TakeInput {
    /// Finds what a command line names: a configuration, one folder, one recording, or videos. `read` reads a configuration file.
    ///
    /// # Errors
    /// The only path does not exist; errors of `read`.
    pub fn from_paths(paths: &[PathBuf], read: impl FnOnce(&Path) -> Result<TakeConfig>) -> Result<Self> {
        match paths {
            [path] if has_ending(path, "toml") => Ok(Self::Configuration(Box::new(read(path)?))),
            _ => Footage::from_paths(paths).map(Self::Footage),
        }
    }
}

/// Options of [`Take::open`].
#[derive(Debug, Clone, Copy)]
pub struct TakeOptions<'a> {
    /// Frame rate of a folder of images, frames per second; a configuration has its own.
    pub fps: f64,
    /// Folder of a calibration that replaces the take's own.
    pub calibration: Option<&'a Path>,
    /// Parts that are needed.
    pub needs: Needs,
}

impl Default for TakeOptions<'_> {
    fn default() -> Self {
        Self { fps: FolderOptions::default().fps, calibration: None, needs: Needs::default() }
    }
}

impl Take {
    /// Opens a take. `gpu` opens a graphics adapter, for simulated cameras alone.
    ///
    /// # Errors
    /// Names a file, camera or setting that is missing or wrong.
    pub fn open(input: &TakeInput, options: &TakeOptions<'_>, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Self> {
        let mut take = match input {
            TakeInput::Configuration(config) => config.open(options.needs, gpu)?,
            TakeInput::Footage(footage) => Self::open_footage(footage, options)?,
        };
        if let Some(folder) = options.calibration {
            ensure!(
                !take.is_live,
                "--calibration processes every frame, which takes longer than live cameras wait; record them first (flyrig \
                 record) and give the recording"
            );
            let images = match input {
                TakeInput::Footage(footage) => footage.folder(),
                TakeInput::Configuration(_) => None,
            };
            take.calibration = Some(Calibration::load(folder, images.unwrap_or(folder), &take.sources)?);
        }
        if let Some(Calibration { rig, .. }) = &take.calibration {
            take.sync = take.sync.with_offsets_of(&rig.cameras);
        }
        Ok(take)
    }

    fn open_footage(footage: &Footage, options: &TakeOptions<'_>) -> Result<Self> {
        let needs_calibration = options.needs == Needs::Calibration;
        let folder_options = FolderOptions { fps: options.fps, ..FolderOptions::default() };
        match footage {
            Footage::Folder(root) | Footage::VideoFolder(root) if needs_calibration => {
                Self::open_folder(root, footage, options, folder_options)
            }
            Footage::Recording(path) => {
                let cameras = recorded_cameras(path)?;
                cameras.log_notes(path);
                let take = Self::from_sources(ready(footage.open(Some(&cameras.ids), &folder_options)?.sources));
                Ok(Self { calibration: cameras.rig.map(Calibration::without_plates), ..take })
            }
            Footage::Videos(files) if needs_calibration && files.len() < 2 => bail!(
                "{} is one file, and neither a configuration nor a recording; name {INPUTS}",
                files.first().map_or_else(String::new, |file| file.display().to_string())
            ),
            Footage::Folder(_) | Footage::VideoFolder(_) | Footage::Videos(_) => {
                Ok(Self::from_sources(ready(footage.open(None, &folder_options)?.sources)))
            }
        }
    }

    /// Opens a folder with its calibration and plates, and with its masks if every calibrated camera has some.
    fn open_folder(
        root: &Path,
        footage: &Footage,
        options: &TakeOptions<'_>,
        folder_options: FolderOptions,
    ) -> Result<Self> {
        // Lenses without poses are no calibration of a rig: `sync-check` then compares motion.
        let has = |file: &str| root.join(file).exists();
        let is_calibrated = has("calibration.toml") || has("intri.yml") && has("extri.yml");
        let mut sources = footage.open(None, &folder_options)?.sources;
        let masks = root.join("mask");
        let given_masks = (is_calibrated || options.calibration.is_some())
            && matches!(footage, Footage::Folder(_))
            && sources.iter().all(|source| masks.join(source.camera().as_str()).is_dir());
        if given_masks {
            sources = footage.open(None, &FolderOptions { with_masks: true, ..folder_options })?.sources;
        }
        let sources = ready(sources);
        let calibration = (is_calibrated && options.calibration.is_none())
            .then(|| Calibration::load(root, root, &sources))
            .transpose()?;
        Ok(Self { calibration, given_masks, ..Self::from_sources(sources) })
    }
}
