//! Footage in folders of any layout.

use std::{
    fmt,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, Result, bail, ensure};
use flyrig_capture::{VideoOptions, VideoReplay, read_image};
use flyrig_types::CameraId;

use crate::video_files::{VIDEO_ENDINGS, has_ending, is_video};

/// Endings of image files.
const IMAGE_ENDINGS: [&str; 3] = ["jpg", "jpeg", "png"];
/// Folders of images that show no camera's view of the take.
const OTHER_FOLDERS: [&str; 8] =
    ["mask", "masks", "background", "backgrounds", "plates", "depth", "calibration", "calib"];

/// Camera of found footage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct FoundCamera {
    pub name: String,
    /// A video, or the images in the order of their names.
    pub files: Vec<PathBuf>,
}

impl FoundCamera {
    /// Returns width and height of the images, pixels.
    ///
    /// # Errors
    /// Names the video or image that cannot be read.
    pub fn size(&self) -> Result<(u32, u32)> {
        let file = self.files.first().with_context(|| format!("camera {} has no images", self.name))?;
        if is_video(file) {
            let id = CameraId::from(self.name.as_str());
            let video = VideoReplay::open(&id, file, &VideoOptions::default())?;
            return video.image_size().with_context(|| format!("{}: the size is not stated", file.display()));
        }
        let image = read_image(file)?;
        Ok((image.width(), image.height()))
    }
}

/// Footage of several cameras.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct FoundFootage {
    /// Cameras by name.
    pub cameras: Vec<FoundCamera>,
    pub is_video: bool,
    /// Folder that holds masks, plates and bodies, if there are any.
    pub root: PathBuf,
}

impl fmt::Display for FoundFootage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = self.names().join(", ");
        write!(f, "found {} of {} cameras: {names}", self.kind(), self.cameras.len())
    }
}

impl FoundFootage {
    /// Finds the cameras that a command line names.
    ///
    /// # Errors
    /// Says what was looked for.
    pub fn find(inputs: &[PathBuf]) -> Result<Self> {
        for path in inputs {
            ensure!(path.exists(), "{} does not exist", path.display());
            ensure!(
                !has_ending(path, "mcap"),
                "{} is a recording, which is a take already: flyrig eval {}",
                path.display(),
                path.display()
            );
        }
        match inputs {
            [folder] if folder.is_dir() => Self::in_folder(folder),
            files => {
                if let Some(other) = files.iter().find(|file| !is_video(file)) {
                    bail!("{} is no video ({}) and no folder", other.display(), VIDEO_ENDINGS.join(", "));
                }
                let parent = files.first().and_then(|file| file.parent()).unwrap_or(Path::new("."));
                Self::of_videos(files.to_vec(), parent)
            }
        }
    }

    /// Returns the names of the cameras.
    pub fn names(&self) -> Vec<String> {
        self.cameras.iter().map(|camera| camera.name.clone()).collect()
    }

    /// Says what the footage is.
    pub fn kind(&self) -> &'static str {
        if self.is_video { "videos" } else { "images" }
    }

    fn in_folder(folder: &Path) -> Result<Self> {
        let below = subfolders(folder)?;
        // Images and videos of the folder itself come first, then those one level below, of usual names first.
        let usual = |path: &PathBuf| {
            ["images", "videos"]
                .iter()
                .position(|name| path.file_name().is_some_and(|found| found == *name))
                .unwrap_or(2)
        };
        let mut places = vec![folder.to_owned()];
        let mut sorted = below;
        sorted.sort_by_key(usual);
        places.extend(sorted);
        for place in &places {
            let videos = files_of(place, is_video)?;
            if !videos.is_empty() {
                return Self::of_videos(videos, if usual(place) < 2 { folder } else { place });
            }
            let cameras: Vec<FoundCamera> = subfolders(place)?
                .into_iter()
                .filter(|path| !path.file_name().is_some_and(|name| OTHER_FOLDERS.iter().any(|other| name == *other)))
                .map(|path| Ok(FoundCamera { name: file_name(&path), files: files_of(&path, is_image)? }))
                .collect::<Result<Vec<_>>>()?
                .into_iter()
                .filter(|camera| !camera.files.is_empty())
                .collect();
            if !cameras.is_empty() {
                let root = if place.file_name().is_some_and(|name| name == "images") && place != folder {
                    folder
                } else {
                    place
                };
                return checked(Self { cameras, is_video: false, root: root.to_owned() });
            }
        }
        bail!(
            "{} holds neither videos ({}) nor images in a folder per camera (images/CAM/*.jpg), here or one level below",
            folder.display(),
            VIDEO_ENDINGS.join(", ")
        )
    }

    fn of_videos(files: Vec<PathBuf>, root: &Path) -> Result<Self> {
        let camera = |file: PathBuf| FoundCamera {
            name: file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default(),
            files: vec![file],
        };
        let mut cameras: Vec<FoundCamera> = files.into_iter().map(camera).collect();
        cameras.sort_by(|a, b| a.name.cmp(&b.name));
        checked(Self { cameras, is_video: true, root: root.to_owned() })
    }
}

/// Checks the names of the cameras.
fn checked(found: FoundFootage) -> Result<FoundFootage> {
    for (i, camera) in found.cameras.iter().enumerate() {
        let file = camera.files.first().map_or_else(String::new, |file| file.display().to_string());
        CameraId::from(camera.name.as_str()).check().context(file)?;
        ensure!(
            found.cameras[..i].iter().all(|other| other.name != camera.name),
            "two files of camera {}; leave one out",
            camera.name
        );
    }
    Ok(found)
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

fn is_image(path: &Path) -> bool {
    !file_name(path).starts_with('.') && path.is_file() && IMAGE_ENDINGS.iter().any(|ending| has_ending(path, ending))
}

/// Lists the folders in a folder by name, without hidden ones.
pub(super) fn subfolders(folder: &Path) -> Result<Vec<PathBuf>> {
    Ok(files_of(folder, Path::is_dir)?.into_iter().filter(|path| !file_name(path).starts_with('.')).collect())
}

/// Lists the entries of a folder that pass a test, by name.
pub(super) fn files_of(folder: &Path, is_wanted: impl Fn(&Path) -> bool) -> Result<Vec<PathBuf>> {
    let listed = std::fs::read_dir(folder).with_context(|| format!("{} cannot be listed", folder.display()))?;
    let mut files: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).filter(|path| is_wanted(path)).collect();
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(root: &Path, names: &[&str]) {
        for name in names {
            std::fs::create_dir_all(root.join(name).parent().unwrap()).unwrap();
            std::fs::write(root.join(name), b"").unwrap();
        }
    }

    fn found(names: &[&str]) -> Result<(Vec<String>, bool, String)> {
        let folder = tempfile::tempdir().unwrap();
        touch(folder.path(), names);
        let found = FoundFootage::find(&[folder.path().to_owned()])?;
        let root = found.root.strip_prefix(folder.path()).unwrap().display().to_string();
        Ok((found.names(), found.is_video, root))
    }

    #[test]
    fn footage_is_found_in_the_folder_and_one_level_below() {
        let two = ["a", "b"].map(str::to_owned).to_vec();
        assert_eq!(found(&["a.mp4", "b.MOV", ".c.mp4", "notes.txt"]).unwrap(), (two.clone(), true, String::new()));
        assert_eq!(found(&["videos/a.mp4", "videos/b.mp4"]).unwrap(), (two.clone(), true, String::new()));
        assert_eq!(found(&["raw/a.mp4", "raw/b.mp4"]).unwrap(), (two.clone(), true, "raw".to_owned()));
        let images = ["images/a/0.jpg", "images/b/0.png", "mask/a/0.png", "background/a.png"];
        assert_eq!(found(&images).unwrap(), (two.clone(), false, String::new()));
        assert_eq!(found(&["a/0.jpg", "b/0.jpg", "mask/0.png"]).unwrap(), (two.clone(), false, String::new()));
        assert_eq!(found(&["x/a/0.jpg", "x/b/0.jpg"]).unwrap(), (two, false, "x".to_owned()));
    }

    #[test]
    fn what_is_no_footage_is_refused_in_words() {
        let text = |names: &[&str]| format!("{:#}", found(names).unwrap_err());
        assert!(text(&["x.txt"]).contains("holds neither videos (mp4, mov,"));
        assert!(text(&["a.mp4", "a.mov"]).contains("two files of camera a"));
        let missing = FoundFootage::find(&["nowhere".into()]).unwrap_err().to_string();
        assert_eq!(missing, "nowhere does not exist");
        let folder = tempfile::tempdir().unwrap();
        touch(folder.path(), &["x.mcap", "y.txt"]);
        let of = |name: &str| FoundFootage::find(&[folder.path().join(name)]).unwrap_err().to_string();
        assert!(of("x.mcap").contains("which is a take already"));
        assert!(of("y.txt").contains("is no video"));
    }
}
