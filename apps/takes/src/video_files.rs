//! Videos in a folder, each named after its camera.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use flyrig_types::CameraId;

/// Endings of video files, in any case.
pub(crate) const VIDEO_ENDINGS: [&str; 7] = ["mp4", "mov", "m4v", "mkv", "avi", "webm", "mts"];
/// Lists the videos of a folder by name.
///
/// # Errors
/// The folder cannot be listed, or holds no video.
pub(crate) fn video_files(folder: &Path) -> Result<Vec<PathBuf>> {
    let listed = std::fs::read_dir(folder).with_context(|| format!("{} cannot be listed", folder.display()))?;
    let paths = listed.flatten().map(|entry| entry.path());
    let mut files: Vec<PathBuf> = paths.filter(|path| is_video(path)).collect();
    ensure!(!files.is_empty(), "{} holds no videos ({})", folder.display(), VIDEO_ENDINGS.join(", "));
    files.sort();
    Ok(files)
}

/// Returns whether a path is a file with the ending of a video, and is not hidden.
pub(crate) fn is_video(path: &Path) -> bool {
    let is_hidden = path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
    !is_hidden && path.is_file() && VIDEO_ENDINGS.iter().any(|ending| has_ending(path, ending))
}

/// Returns the camera of a video: the file's name without its ending.
pub(crate) fn video_camera(file: &Path) -> CameraId {
    file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default().into()
}

/// Returns whether a path has an ending such as "mcap", in any case.
pub(crate) fn has_ending(path: &Path, ending: &str) -> bool {
    path.extension().is_some_and(|found| found.eq_ignore_ascii_case(ending))
}
