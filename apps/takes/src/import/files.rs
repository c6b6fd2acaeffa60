//! Files of an imported take.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};

use super::footage::{FoundCamera, FoundFootage, files_of};
use crate::video_files::has_ending;

/// Writer of a new take, which is removed again unless it is finished.
pub(super) struct TakeWriter {
    root: PathBuf,
    is_finished: std::cell::Cell<bool>,
}

impl TakeWriter {
    /// Creates the folder.
    ///
    /// # Errors
    /// It exists and holds files, or cannot be created.
    pub fn create(root: &Path) -> Result<Self> {
        let is_taken = std::fs::read_dir(root).is_ok_and(|mut entries| entries.next().is_some());
        ensure!(!is_taken && !root.is_file(), "{} is there already; name a new folder", root.display());
        std::fs::create_dir_all(root).with_context(|| format!("cannot create {}", root.display()))?;
        Ok(Self { root: root.to_owned(), is_finished: false.into() })
    }

    /// Keeps the take.
    pub fn finish(&self) {
        self.is_finished.set(true);
    }

    /// Places the footage of these cameras, with masks, plates and body where there are some.
    ///
    /// # Errors
    /// Names the file that cannot be written.
    pub fn footage(&self, found: &FoundFootage, slots: &[usize]) -> Result<()> {
        let cameras: Vec<&FoundCamera> = slots.iter().map(|slot| &found.cameras[*slot]).collect();
        let bar = flyrig_report::progress_bar(cameras.len() as u64, "cameras copied");
        for camera in &cameras {
            for file in &camera.files {
                let name = file.file_name().unwrap_or_default();
                let to = if found.is_video {
                    self.root.join("videos").join(name)
                } else {
                    self.root.join("images").join(&camera.name).join(name)
                };
                place(file, &to)?;
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        if found.is_video {
            return Ok(());
        }
        let masks = ["mask", "masks"].map(|name| found.root.join(name)).into_iter().find(|folder| folder.is_dir());
        for camera in &cameras {
            let of_camera = masks.as_ref().map(|masks| masks.join(&camera.name)).filter(|folder| folder.is_dir());
            for file in of_camera.map(|folder| files_of(&folder, Path::is_file)).transpose()?.unwrap_or_default() {
                place(&file, &self.root.join("mask").join(&camera.name).join(file.file_name().unwrap_or_default()))?;
            }
            let plate = found.root.join("background").join(format!("{}.png", camera.name));
            if plate.is_file() {
                place(&plate, &self.root.join("background").join(format!("{}.png", camera.name)))?;
            }
        }
        let bodies = files_of(&found.root, |path| path.is_file() && has_ending(path, "glb"))?;
        if let [body] = bodies.as_slice() {
            place(body, &self.root.join(body.file_name().unwrap_or_default()))?;
        }
        Ok(())
    }
}

impl Drop for TakeWriter {
    fn drop(&mut self) {
        if !self.is_finished.get() {
            let _ = std::fs::remove_dir_all(&self.root);
        }
    }
}

/// Links a file to a place, or copies it where file systems differ.
fn place(from: &Path, to: &Path) -> Result<()> {
    let failed = || format!("cannot write {}", to.display());
    if let Some(folder) = to.parent() {
        std::fs::create_dir_all(folder).with_context(failed)?;
    }
    let from = std::fs::canonicalize(from).with_context(|| from.display().to_string())?;
    if std::fs::hard_link(&from, to).is_err() {
        std::fs::copy(&from, to).with_context(failed)?;
    }
    Ok(())
}
