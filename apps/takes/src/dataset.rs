//! Files of a data set: a folder in EasyMocap's layout.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use flyrig_calib::{CalibError, load_calibration};
use flyrig_capture::{VideoOptions, VideoReplay, folder_image_size, read_image};
use flyrig_fusion::{Origin, PerceptionSettings};
use flyrig_types::{Camera, CameraId, Image, Rig, shortened};

use crate::video_files::{video_camera, video_files};

/// Files of a calibration, of which at least one lies in a calibrated folder.
const CALIBRATION_FILES: [&str; 3] = ["calibration.toml", "intri.yml", "extri.yml"];

/// Returns the named cameras of a rig, in the order of the names; all cameras if there are no names.
///
/// `place` names the rig in errors.
///
/// # Errors
/// Names a camera that the rig does not have, with those that it has; or a camera that is named twice.
///
/// ```
/// use flyrig_takes::dataset::select_cameras;
/// use flyrig_types::{Camera, Intrinsics, Isometry, Rig};
///
/// let camera = |id: &str| Camera {
///     id: id.into(),
///     intrinsics: Intrinsics::pinhole(640, 480, 500.0),
///     camera_from_world: Isometry::IDENTITY,
///     time_offset_nanos: 0,
///     color: Default::default(),
/// };
/// let rig = Rig { cameras: vec![camera("left"), camera("right")], world_up: glam::DVec3::Z };
///
/// let right = select_cameras(&rig, &["right".to_owned()], "the calibration")?;
/// assert_eq!(right.cameras.len(), 1);
/// let error = select_cameras(&rig, &["top".to_owned()], "the calibration").unwrap_err();
/// assert_eq!(error.to_string(), "camera top is not in the calibration; it has: left, right");
/// # anyhow::Ok(())
/// ```
pub fn select_cameras(rig: &Rig, names: &[String], place: &str) -> Result<Rig> {
    if names.is_empty() {
        return Ok(rig.clone());
    }
    let cameras = names
        .iter()
        .map(|name| {
            rig.slot(&name.as_str().into()).map(|slot| rig.cameras[slot].clone()).with_context(|| {
                let known: Vec<_> = rig.cameras.iter().map(|camera| camera.id.as_str()).collect();
                format!("camera {} is not in {place}; it has: {}", shortened(name), known.join(", "))
            })
        })
        .collect::<Result<Vec<Camera>>>()?;
    let selected = Rig { cameras, world_up: rig.world_up };
    selected.validate()?;
    Ok(selected)
}

/// Returns whether a folder holds a calibration, complete or not.
#[must_use]
pub fn has_calibration(folder: &Path) -> bool {
    CALIBRATION_FILES.iter().any(|file| folder.join(file).exists())
}

/// Checks that a path is a folder that exists; `what` describes its content, such as "a folder with images/CAM".
///
/// # Errors
/// The path does not exist, or is a file.
pub(crate) fn require_folder(path: &Path, what: &str) -> Result<()> {
    ensure!(path.exists(), "{} does not exist; name {what}", path.display());
    ensure!(path.is_dir(), "{} is a file; name {what}", path.display());
    Ok(())
}

/// Checks that a folder exists and holds a calibration, complete or not.
///
/// # Errors
/// Says that the folder is missing, or how it gets a calibration.
pub(crate) fn require_calibration(folder: &Path) -> Result<()> {
    require_folder(folder, "the folder of a calibration")?;
    ensure!(
        has_calibration(folder),
        "{} holds no calibration (calibration.toml, or intri.yml and extri.yml): make one with `flyrig calibrate`, or convert \
         another program's with `flyrig calibrate convert`",
        folder.display()
    );
    Ok(())
}

/// Checks that a data set has a folder of masks for every camera; `fix` is the setting with which none are needed.
///
/// # Errors
/// Names the first camera without one, and the fix.
pub(crate) fn require_given_masks(root: &Path, rig: &Rig, fix: &str) -> Result<()> {
    for camera in &rig.cameras {
        let masks = root.join("mask").join(camera.id.as_str());
        ensure!(masks.is_dir(), "camera {} has no masks ({} does not exist); {fix}", camera.id, masks.display());
    }
    Ok(())
}

/// Loads the calibrated cameras of a data set.
///
/// A calibration without image sizes needs the images or the video of every camera.
///
/// # Errors
/// Names a file that is missing or wrong; for a camera of `chosen` whose size is unknown, its missing images.
pub fn load_rig(root: &Path, chosen: &[CameraId]) -> Result<Rig> {
    load_rig_of(root, root, chosen)
}

/// Loads a calibration for images in another folder. Its sizes are checked against these images, or else against images beside the
/// calibration.
///
/// # Errors
/// See [`load_rig`].
pub(crate) fn load_rig_of(calibration: &Path, images: &Path, chosen: &[CameraId]) -> Result<Rig> {
    require_calibration(calibration)?;
    let size = |id: &CameraId| image_size(images, id).or_else(|| image_size(calibration, id));
    // Cameras that are not chosen and of which there are no images are left out later; any size reads them.
    let (mut absent, present): (Vec<CameraId>, _) = (Vec::new(), cameras_with_images(images));
    loop {
        let any = || chosen.iter().chain(&present).find_map(size);
        let read = |id: &CameraId| size(id).or_else(|| absent.contains(id).then(any).flatten());
        match load_calibration(calibration, &read) {
            Err(CalibError::UnknownSize { camera, .. })
                if ![chosen, &present, &absent].iter().any(|known| known.contains(&camera)) && any().is_some() =>
            {
                absent.push(camera);
            }
            Err(error) => {
                if matches!(error, CalibError::UnknownSize { .. }) {
                    for camera in chosen.iter().filter(|id| !video_file(images, id).exists()) {
                        folder_image_size(images, camera)?;
                    }
                }
                return Err(error.into());
            }
            Ok(rig) => return Ok(rig),
        }
    }
}

/// Lists the cameras with a folder of images or a video.
fn cameras_with_images(root: &Path) -> Vec<CameraId> {
    let folders = std::fs::read_dir(root.join("images")).into_iter().flatten().flatten();
    let folders = folders.filter(|entry| entry.path().is_dir());
    let of_images = folders.map(|entry| CameraId::from(entry.file_name().to_string_lossy().into_owned()));
    let videos = video_files(&root.join("videos")).unwrap_or_default();
    of_images.chain(videos.iter().map(|file| video_camera(file))).collect()
}

/// Returns width and height of a camera's first readable image, or else of its video, pixels.
fn image_size(root: &Path, id: &CameraId) -> Option<(u32, u32)> {
    let video_size = || VideoReplay::open(id, &video_file(root, id), &VideoOptions::default()).ok()?.image_size();
    folder_image_size(root, id).ok().or_else(video_size)
}

/// Returns the path of a camera's video, `videos/CAM.mp4` or with the ending of another video that is there.
#[must_use]
pub fn video_file(root: &Path, id: &CameraId) -> PathBuf {
    let found =
        video_files(&root.join("videos")).unwrap_or_default().into_iter().find(|file| video_camera(file) == *id);
    found.unwrap_or_else(|| root.join("videos").join(format!("{id}.mp4")))
}

/// Returns the folder of a data set's plates: that of the settings, or `background`.
#[must_use]
pub fn plate_folder(root: &Path, settings: &PerceptionSettings) -> PathBuf {
    if settings.plates.as_os_str().is_empty() { root.join("background") } else { settings.plates.clone() }
}

/// Returns the path of a camera's plate in a folder, `CAM.png`.
#[must_use]
pub fn plate_file(folder: &Path, id: &CameraId) -> PathBuf {
    folder.join(format!("{id}.png"))
}

/// Loads the plates that the settings name, or those of the data set; an absent folder of the data set has none.
///
/// # Errors
/// Those of [`load_plates`]; the folder that the settings name does not exist.
pub(crate) fn load_plates_of(root: &Path, settings: &PerceptionSettings, rig: &Rig) -> Result<Vec<Option<Image>>> {
    if !settings.plates.as_os_str().is_empty() {
        require_folder(&settings.plates, "a folder of plates CAM.png (`flyrig plate`), or none").context("plates")?;
    }
    load_plates(&plate_folder(root, settings), rig)
}

/// Loads the plates of a folder: RGB images of the empty scene, one per slot of the rig, `None` for a camera without one.
///
/// # Errors
/// Names the file that cannot be read; the camera, both sizes and the fix for a plate whose size differs from the camera's images.
pub fn load_plates(folder: &Path, rig: &Rig) -> Result<Vec<Option<Image>>> {
    rig.cameras.iter().map(|camera| load_plate(folder, camera)).collect()
}

fn load_plate(folder: &Path, camera: &Camera) -> Result<Option<Image>> {
    let path = plate_file(folder, &camera.id);
    if !path.exists() {
        return Ok(None);
    }
    let picture = read_image(&path)?;
    let (width, height) = (picture.width(), picture.height());
    let expected = (camera.intrinsics.width, camera.intrinsics.height);
    if (width, height) != expected {
        bail!(
            "camera {}: the plate {} is {width}x{height} pixels, the camera's images are {}x{}; record it again with `flyrig \
             plate`, or remove it",
            camera.id,
            path.display(),
            expected.0,
            expected.1
        );
    }
    Ok(Some(picture))
}

/// Checks that masks can be computed: masks that are neither given nor come with an estimated pose need a plate of every camera, or a key
/// colour.
///
/// # Errors
/// Names the missing plates and the alternatives.
pub fn require_masks(settings: &PerceptionSettings, plates: &[Option<Image>]) -> Result<()> {
    let from_plates = settings.masks == Origin::Estimated && settings.key_color.is_empty();
    if settings.pose == Origin::Given && from_plates && plates.iter().any(Option::is_none) {
        bail!(
            "a given pose with estimated masks needs a plate background/CAM.png of every input camera; record them with `flyrig \
             plate`, name a key colour, or let the pose be estimated too"
        );
    }
    Ok(())
}

/// Finds the skinned glTF file of a data set.
///
/// # Errors
/// The folder cannot be read, or does not hold exactly one such file.
pub fn gltf_file(root: &Path) -> Result<PathBuf> {
    let is_gltf = |path: &PathBuf| {
        path.extension().is_some_and(|e| e.eq_ignore_ascii_case("glb") || e.eq_ignore_ascii_case("gltf"))
    };
    let files: Vec<PathBuf> = std::fs::read_dir(root)
        .with_context(|| format!("cannot read the data set {}", root.display()))?
        .flatten()
        .map(|entry| entry.path())
        .filter(is_gltf)
        .collect();
    match files.as_slice() {
        [file] => Ok(file.clone()),
        _ => bail!(
            "--pose given needs one skinned glTF file with an animation in {}, found {}; use --pose estimated without",
            root.display(),
            files.len()
        ),
    }
}
