//! Stored footage: a folder of images, a recording, or videos.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use flyrig_capture::{CameraSource, FolderOptions, FolderReplay, McapReplay, VideoOptions, VideoReplay};
use flyrig_types::{CameraId, Rig};

use crate::{
    dataset,
    recorded::recorded_cameras,
    video_files::{has_ending, video_camera, video_files},
};

/// Inputs that a command line may name.
pub(crate) const INPUTS: &str =
    "a configuration (*.toml), a recording (*.mcap), a folder with images/CAM, or the videos of all cameras";

/// Checks that every input of a command line exists.
///
/// # Errors
/// Names the first that does not, and what may stand there.
pub fn require_inputs(paths: &[PathBuf]) -> Result<()> {
    for path in paths {
        ensure!(path.exists(), "{} does not exist; name {INPUTS}", path.display());
    }
    Ok(())
}

/// Stored images of several cameras.
///
/// ```
/// use std::path::Path;
/// use flyrig_takes::Footage;
///
/// assert!(matches!(Footage::from_dataset(Path::new("take.mcap")), Footage::Recording(_)));
/// assert!(matches!(Footage::from_dataset(Path::new("data/walk")), Footage::Folder(_)));
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Footage {
    /// Folder in EasyMocap's layout, with `images/CAM/*`.
    Folder(PathBuf),
    /// Folder of the same layout with `videos/CAM.mp4` (or another ending) and no images.
    VideoFolder(PathBuf),
    /// File of `flyrig record`, or MCAP file of another program.
    Recording(PathBuf),
    /// Video files, one per camera, each named after its camera.
    Videos(Vec<PathBuf>),
}

/// Opened cameras of [`Footage`].
pub struct OpenFootage {
    /// One source per camera.
    pub sources: Vec<Box<dyn CameraSource>>,
    /// Frames of the longest camera of a folder; 0 where the number is unknown before reading.
    pub frames: usize,
    /// Duration of the longest camera, seconds, where it is known before reading.
    pub secs: Option<f64>,
}

impl Footage {
    /// Returns the footage of a data set: a recording by the ending of its name, or else a folder, which need not exist yet.
    #[must_use]
    pub fn from_dataset(path: &Path) -> Self {
        let path_buf = path.to_owned();
        if has_ending(path, "mcap") && !path.is_dir() {
            Self::Recording(path_buf)
        } else if path.join("videos").is_dir() && !path.join("images").is_dir() {
            Self::VideoFolder(path_buf)
        } else {
            Self::Folder(path_buf)
        }
    }

    /// Finds the footage that a command line names: one folder, one recording, or videos.
    ///
    /// # Errors
    /// Names a path that does not exist, or a folder among videos.
    pub fn from_paths(paths: &[PathBuf]) -> Result<Self> {
        require_inputs(paths)?;
        match paths {
            [path] if has_ending(path, "mcap") || path.is_dir() => Ok(Self::from_dataset(path)),
            videos => {
                for path in videos {
                    ensure!(!path.is_dir(), "{} is a folder among files; name {INPUTS}", path.display());
                }
                Ok(Self::Videos(videos.to_vec()))
            }
        }
    }

    /// Checks that the folder or recording of a data set exists.
    ///
    /// # Errors
    /// Names the path, and what is expected in its place.
    pub(crate) fn check_dataset(&self) -> Result<()> {
        match self {
            Self::Folder(root) | Self::VideoFolder(root) => dataset::require_folder(
                root,
                "a folder with a calibration and images/CAM or videos, or a recording (*.mcap); `flyrig import` makes one of other files",
            ),
            Self::Recording(path) => {
                ensure!(path.exists(), "{} does not exist; name a recording of `flyrig record`", path.display());
                Ok(())
            }
            Self::Videos(_) => Ok(()),
        }
    }

    /// Returns the root folder; `None` for recordings and videos.
    #[must_use]
    pub fn folder(&self) -> Option<&Path> {
        match self {
            Self::Folder(root) | Self::VideoFolder(root) => Some(root),
            Self::Recording(_) | Self::Videos(_) => None,
        }
    }

    /// Loads the footage's own calibration; for a folder, `chosen` are the cameras whose images must be there.
    ///
    /// # Errors
    /// The calibration is missing or wrong.
    pub fn load_rig(&self, chosen: &[CameraId]) -> Result<Rig> {
        match self {
            Self::Folder(root) | Self::VideoFolder(root) => dataset::load_rig(root, chosen),
            Self::Recording(path) => {
                let recorded = recorded_cameras(path)?;
                // The error says what is missing.
                if recorded.rig.is_some() {
                    recorded.log_notes(path);
                }
                recorded.calibrated(path)
            }
            Self::Videos(_) => anyhow::bail!("videos have no calibration of their own; name its folder"),
        }
    }

    /// Opens cameras in the order of `cameras`; all of them for `None`. `options` apply to folders.
    ///
    /// # Errors
    /// Names the camera or file that cannot be opened.
    pub fn open(&self, cameras: Option<&[CameraId]>, options: &FolderOptions) -> Result<OpenFootage> {
        match self {
            Self::Folder(root) => {
                let sources = FolderReplay::open(root, cameras, options)?;
                let frames = sources.iter().map(FolderReplay::remaining).max().unwrap_or(0);
                let secs = Some(frames as f64 / options.fps);
                Ok(OpenFootage { sources: sources.into_iter().map(boxed).collect(), frames, secs })
            }
            Self::VideoFolder(root) => {
                let files = match cameras {
                    Some(ids) => ids.iter().map(|id| dataset::video_file(root, id)).collect(),
                    None => video_files(&root.join("videos"))?,
                };
                open_videos(&files, cameras, options)
            }
            Self::Recording(path) => {
                let recorded = recorded_cameras(path)?;
                let ids = cameras.unwrap_or(&recorded.ids);
                let open = |id: &CameraId| Ok(boxed(McapReplay::open_camera(&recorded.images_of(id), path)?));
                let sources = ids.iter().map(open).collect::<Result<_>>()?;
                Ok(OpenFootage { sources, frames: 0, secs: None })
            }
            Self::Videos(files) => open_videos(files, cameras, &FolderOptions::default()),
        }
    }
}

/// Opens videos, each of the camera that it is named after.
fn open_videos(files: &[PathBuf], cameras: Option<&[CameraId]>, options: &FolderOptions) -> Result<OpenFootage> {
    for file in files {
        video_camera(file).check().with_context(|| file.display().to_string())?;
    }
    let all: Vec<(CameraId, &PathBuf)> = files.iter().map(|file| (video_camera(file), file)).collect();
    let chosen = match cameras {
        None => all,
        Some(ids) => {
            let find = |id: &CameraId| all.iter().find(|(known, _)| known == id).cloned();
            ids.iter().map(|id| find(id).with_context(|| format!("no video of camera {id}"))).collect::<Result<_>>()?
        }
    };
    let video = VideoOptions { frames: options.frames.clone(), ..VideoOptions::default() };
    let videos =
        chosen.iter().map(|(id, file)| Ok(VideoReplay::open(id, file, &video)?)).collect::<Result<Vec<_>>>()?;
    let secs = videos.iter().filter_map(VideoReplay::header_secs).reduce(f64::max);
    Ok(OpenFootage { sources: videos.into_iter().map(boxed).collect(), frames: 0, secs })
}

fn boxed<S: CameraSource + 'static>(source: S) -> Box<dyn CameraSource> {
    Box::new(source)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_told_apart() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("dir.mcap")).unwrap();
        for file in ["a.mp4", "b.mp4", "take.MCAP"] {
            std::fs::write(at(file), b"").unwrap();
        }
        let find = |names: &[&str]| Footage::from_paths(&names.iter().map(|name| at(name)).collect::<Vec<_>>());
        assert_eq!(find(&["dir.mcap"]).unwrap(), Footage::Folder(at("dir.mcap")));
        assert_eq!(find(&["take.MCAP"]).unwrap(), Footage::Recording(at("take.MCAP")));
        std::fs::create_dir_all(at("videos/videos")).unwrap();
        assert_eq!(find(&["videos"]).unwrap(), Footage::VideoFolder(at("videos")));
        assert_eq!(find(&["a.mp4"]).unwrap(), Footage::Videos(vec![at("a.mp4")]));
        assert_eq!(find(&["a.mp4", "b.mp4"]).unwrap(), Footage::Videos(vec![at("a.mp4"), at("b.mp4")]));
        let error = |names: &[&str]| find(names).unwrap_err().to_string();
        assert!(error(&["nowhere"]).contains("nowhere does not exist; name a configuration (*.toml)"));
        assert!(error(&["a.mp4", "c.mp4"]).contains("c.mp4 does not exist; name"));
        assert!(error(&["a.mp4", "dir.mcap"]).contains("dir.mcap is a folder among files; name"));
    }
}
