//! Replay of a folder in the layout of EasyMocap and ZJU-MoCap.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs, io,
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use flyrig_types::{CameraId, Frame, Image, Mask, PixelFormat};

use crate::error::{CaptureError, CaptureErrorKind};
use crate::image_file::{self, IMAGE_ENDINGS};
use crate::source::CameraSource;

/// Options of a folder's replay.
#[derive(Debug, Clone, PartialEq)]
pub struct FolderOptions {
    /// Frames per second: frame `n` has the time `n / fps` seconds.
    pub fps: f64,
    /// Range of frame numbers to replay; all when `None`.
    pub frames: Option<Range<u64>>,
    /// Whether to read `mask/CAM` too, which every camera must then have.
    pub with_masks: bool,
}

impl Default for FolderOptions {
    /// Returns all frames at 30 per second, without masks.
    fn default() -> Self {
        Self { fps: 30.0, frames: None, with_masks: false }
    }
}

/// Frame source of one camera of a folder `images/CAM/*.png|jpg|jpeg`, with `mask/CAM/*` of the same stems where
/// requested. Its frames are `Rgb8`.
///
/// A frame's number is its file stem where every stem of the chosen cameras is a number, otherwise its position in the
/// sorted list of all stems. The number divided by the rate gives the time, and the number is the frame's sequence
/// number. Images and masks are upright, as their EXIF orientation says. `Corrupt` errors, after which the next frame follows, are: a number that only other cameras have, a damaged
/// image, a mask that is missing or of another size, and an image of another size than the camera's first. Mask values
/// are coverage; a mask without values above 31 is taken for a label map, where everything but 0 is the person. An
/// all-zero mask is empty.
#[derive(Debug)]
pub struct FolderReplay {
    camera: CameraId,
    fps: f64,
    shots: Arc<[FolderFrame]>,
    pictures: BTreeMap<String, PathBuf>,
    masks: Option<BTreeMap<String, PathBuf>>,
    next: usize,
    size: Option<(u32, u32)>,
}

/// Frame that at least one camera has.
#[derive(Debug)]
struct FolderFrame {
    number: u64,
    /// File stems of this number: `1` and `0001` can be two cameras' names for it.
    stems: Vec<String>,
}

impl FolderReplay {
    /// Opens one source per camera, in the order of `cameras` (all cameras in lexical order when `None`).
    ///
    /// # Errors
    /// `NotFound` names the camera and lists the existing ones, or reports that the range has no frame; `Unsupported`
    /// for an invalid rate or two images of one number; `Io`.
    pub fn open(root: &Path, cameras: Option<&[CameraId]>, options: &FolderOptions) -> Result<Vec<Self>, CaptureError> {
        if !options.fps.is_finite() || options.fps <= 0.0 {
            let message = format!("the frame rate is {}, expected a positive number of frames per second", options.fps);
            return Err(CaptureError::general(CaptureErrorKind::Unsupported, message));
        }
        let cameras = match cameras {
            Some(cameras) => cameras.to_vec(),
            None => list_cameras(root)?,
        };
        let mut sources = Vec::with_capacity(cameras.len());
        for camera in cameras {
            let pictures = camera_images(root, &camera)?;
            let masks = options.with_masks.then(|| camera_files(root, "mask", &camera)).transpose()?;
            let (fps, shots) = (options.fps, Arc::default());
            sources.push(Self { camera, fps, shots, pictures, masks, next: 0, size: None });
        }
        let shots = shots(&sources, options.frames.as_ref())?;
        for source in &mut sources {
            source.shots = Arc::clone(&shots);
        }
        Ok(sources)
    }

    /// Returns the number of frames that remain, readable or not.
    #[must_use]
    pub fn remaining(&self) -> usize {
        self.shots.len() - self.next
    }

    /// Leaves out the next frame.
    pub fn skip(&mut self) {
        self.next = (self.next + 1).min(self.shots.len());
    }

    fn read(&self, shot: &FolderFrame) -> Result<Frame, CaptureError> {
        let file = |files: &BTreeMap<String, PathBuf>, what: &str| {
            shot.stems.iter().find_map(|stem| files.get(stem)).cloned().ok_or_else(|| {
                let message = format!("frame {} has no {what}, though others have; restore the file", shot.number);
                CaptureError::general(CaptureErrorKind::Corrupt, message)
            })
        };
        let picture = image_file::read(&file(&self.pictures, "image")?)?.into_rgb8();
        let (width, height) = picture.dimensions();
        if let Some((first_width, first_height)) = self.size.filter(|size| *size != (width, height)) {
            let message = format!(
                "frame {} is {width}x{height}, the frames before it {first_width}x{first_height}; \
                 all images of a camera must have one size",
                shot.number
            );
            return Err(CaptureError::general(CaptureErrorKind::Corrupt, message));
        }
        let mask = match &self.masks {
            Some(masks) => Some(read_mask(&file(masks, "mask")?, (width, height))?),
            None => None,
        };
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: shot.number,
            capture_nanos: (shot.number as f64 / self.fps * 1e9).round() as i64,
            exposure_nanos: None,
            image: Image::new(width, height, PixelFormat::Rgb8, picture.into_raw())
                .map_err(|error| CaptureError::general(CaptureErrorKind::Unsupported, error.to_string()))?,
            mask,
        })
    }
}

impl CameraSource for FolderReplay {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        let Some(shot) = self.shots.get(self.next) else {
            return Err(CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, "all frames were replayed"));
        };
        self.next += 1;
        let frame = self.read(shot).map_err(|error| error.of(&self.camera))?;
        self.size.get_or_insert((frame.image.width(), frame.image.height()));
        Ok(frame)
    }
}

/// Returns width and height of a camera's first readable image, from its header alone; for calibration files that lack
/// them.
///
/// # Errors
/// `NotFound` when there is no such camera, `Corrupt` when none of its images has a header.
pub fn folder_image_size(root: &Path, camera: &CameraId) -> Result<(u32, u32), CaptureError> {
    let pictures = camera_images(root, camera)?;
    pictures.values().find_map(|path| image_file::read_dimensions(path).ok()).ok_or_else(|| {
        CaptureError::new(
            camera,
            CaptureErrorKind::Corrupt,
            format!("none of its {} images can be read", pictures.len()),
        )
    })
}

/// Lists the folders in `images`.
fn list_cameras(root: &Path) -> Result<Vec<CameraId>, CaptureError> {
    let images = root.join("images");
    let fail = |error: &io::Error| match error.kind() {
        io::ErrorKind::NotFound => CaptureError::general(
            CaptureErrorKind::NotFound,
            format!("{} does not exist; expected a folder with images/CAM/*.jpg or *.png", images.display()),
        ),
        _ => CaptureError::general(CaptureErrorKind::Io, format!("{}: {error}", images.display())),
    };
    let mut names = BTreeSet::new();
    for entry in fs::read_dir(&images).map_err(|error| fail(&error))? {
        let entry = entry.map_err(|error| fail(&error))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if entry.path().is_dir() && !name.starts_with('.') {
            names.insert(name);
        }
    }
    if names.is_empty() {
        let message = format!("{} has no camera folders", images.display());
        return Err(CaptureError::general(CaptureErrorKind::NotFound, message));
    }
    let checked = |name: String| {
        let camera = CameraId::from(name);
        let refused =
            |error| CaptureError::general(CaptureErrorKind::Unsupported, format!("{}: {error}", images.display()));
        camera.check().map_err(refused).map(|()| camera)
    };
    names.into_iter().map(checked).collect()
}

fn camera_images(root: &Path, camera: &CameraId) -> Result<BTreeMap<String, PathBuf>, CaptureError> {
    let present = list_cameras(root)?;
    if !present.contains(camera) {
        let names: Vec<&str> = present.iter().map(CameraId::as_str).collect();
        let message = format!("is not in {}; there are: {}", root.join("images").display(), names.join(", "));
        return Err(CaptureError::new(camera, CaptureErrorKind::NotFound, message));
    }
    camera_files(root, "images", camera)
}

/// Lists the images in `root/kind/camera` by stem.
fn camera_files(root: &Path, kind: &str, camera: &CameraId) -> Result<BTreeMap<String, PathBuf>, CaptureError> {
    let folder = root.join(kind).join(camera.as_str());
    let fail = |error: &io::Error| {
        let kind =
            if error.kind() == io::ErrorKind::NotFound { CaptureErrorKind::NotFound } else { CaptureErrorKind::Io };
        CaptureError::new(camera, kind, format!("{} cannot be listed: {error}", folder.display()))
    };
    let mut files: BTreeMap<String, PathBuf> = BTreeMap::new();
    for entry in fs::read_dir(&folder).map_err(|error| fail(&error))? {
        let path = entry.map_err(|error| fail(&error))?.path();
        let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
        let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let (Some(ending), Some(stem)) = (ending, stem) else { continue };
        if stem.starts_with('.') || !IMAGE_ENDINGS.contains(&ending.as_str()) {
            continue;
        }
        if let Some(twin) = files.insert(stem, path.clone()) {
            return Err(two_of_one(camera, &twin, &path));
        }
    }
    if files.is_empty() {
        let message = format!("{} has no png, jpg or jpeg files", folder.display());
        return Err(CaptureError::new(camera, CaptureErrorKind::NotFound, message));
    }
    Ok(files)
}

fn two_of_one(camera: &CameraId, a: &Path, b: &Path) -> CaptureError {
    let message = format!("{} and {} are the same frame; take one away", a.display(), b.display());
    CaptureError::new(camera, CaptureErrorKind::Unsupported, message)
}

/// Lists the frames in the range that any camera has, by number.
fn shots(sources: &[FolderReplay], range: Option<&Range<u64>>) -> Result<Arc<[FolderFrame]>, CaptureError> {
    let stems: BTreeSet<&String> = sources.iter().flat_map(|source| source.pictures.keys()).collect();
    let numbers: Option<Vec<u64>> = stems.iter().map(|stem| stem.parse().ok()).collect();
    let numbers = numbers.unwrap_or_else(|| (0..stems.len() as u64).collect());
    let mut by_number: BTreeMap<u64, Vec<String>> = BTreeMap::new();
    for (stem, number) in stems.into_iter().zip(numbers) {
        by_number.entry(number).or_default().push(stem.clone());
    }
    for source in sources {
        for stems in by_number.values() {
            let twins: Vec<&PathBuf> = stems.iter().filter_map(|stem| source.pictures.get(stem)).collect();
            if let [a, b, ..] = twins[..] {
                return Err(two_of_one(&source.camera, a, b));
            }
        }
    }
    let ends =
        by_number.first_key_value().zip(by_number.last_key_value()).map(|((first, _), (last, _))| (*first, *last));
    let shots: Arc<[FolderFrame]> = by_number
        .into_iter()
        .filter(|(number, _)| range.is_none_or(|range| range.contains(number)))
        .map(|(number, stems)| FolderFrame { number, stems })
        .collect();
    match (range, ends) {
        (Some(range), Some((first, last))) if shots.is_empty() => Err(CaptureError::general(
            CaptureErrorKind::NotFound,
            format!("no frame is in {}..{}; there are frames {first} to {last}", range.start, range.end),
        )),
        _ => Ok(shots),
    }
}

fn read_mask(path: &Path, picture: (u32, u32)) -> Result<Mask, CaptureError> {
    /// Largest value of a label map; above it, values are coverage.
    const LAST_LABEL: u8 = 31;
    let mask = image_file::read(path)?.into_luma8();
    let (width, height) = mask.dimensions();
    if (width, height) != picture {
        let message = format!(
            "{} is {width}x{height}, its image {}x{}; make the mask again at the image's size",
            path.display(),
            picture.0,
            picture.1
        );
        return Err(CaptureError::general(CaptureErrorKind::Corrupt, message));
    }
    let mut coverage = mask.into_raw();
    if coverage.iter().all(|&value| value <= LAST_LABEL) {
        for value in &mut coverage {
            *value = if *value == 0 { 0 } else { 255 };
        }
    }
    Mask::new(width, height, coverage)
        .map_err(|error| CaptureError::general(CaptureErrorKind::Unsupported, error.to_string()))
}
