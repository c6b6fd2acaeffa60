//! Finding things in an EasyMocap folder.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use flyrig_calib::{CalibError, load_calibration};
use flyrig_capture::{VideoOptions, VideoReplay, folder_image_size};
use flyrig_fusion::{Origin, PerceptionSettings};
use flyrig_types::{Camera, CameraId, Image, PixelFormat, Rig};

/// The named cameras of a rig, in the order of the names; all of them for no names.
///
/// # Errors
/// Names what is missing or wrong.
pub fn pick(rig: &Rig, names: &[String], whose: &str) -> Result<Rig> {
    if names.is_empty() {
        return Ok(rig.clone());
    }
    let cameras = names
        .iter()
        .map(|name| {
            rig.slot(&name.as_str().into()).map(|slot| rig.cameras[slot].clone()).with_context(|| {
                let known: Vec<_> = rig.cameras.iter().map(|camera| camera.id.as_str()).collect();
                format!("camera {name} is not in {whose}; it has: {}", known.join(", "))
            })
        })
        .collect::<Result<Vec<Camera>>>()?;
    let picked = Rig { cameras, world_up: rig.world_up };
    picked.validate()?;
    Ok(picked)
}

/// The calibrated cameras of a data set. A calibration without image sizes needs the images of every camera; when
/// one of the `chosen` has none, the error says so.
///
/// # Errors
/// Names what is missing or wrong.
pub fn load_rig(root: &Path, chosen: &[CameraId]) -> Result<Rig> {
    load_calibration(root, &|id| image_size(root, id)).or_else(|error| {
        if matches!(error, CalibError::UnknownSize { .. }) {
            for camera in chosen.iter().filter(|id| !video_file(root, id).exists()) {
                folder_image_size(root, camera)?;
            }
        }
        Err(error.into())
    })
}

/// Size of a camera's first readable image, or else of its video, for calibrations that do not say.
fn image_size(root: &Path, id: &CameraId) -> Option<(u32, u32)> {
    let of_video = || VideoReplay::open(id, &video_file(root, id), &VideoOptions::default()).ok()?.image_size();
    folder_image_size(root, id).ok().or_else(of_video)
}

/// Where a camera's video lies.
#[must_use]
pub fn video_file(root: &Path, id: &CameraId) -> PathBuf {
    root.join("videos").join(format!("{id}.mp4"))
}

/// Returns the folder of a data set's plates: that of the settings, or `background`.
#[must_use]
pub fn plate_folder(root: &Path, settings: &PerceptionSettings) -> PathBuf {
    if settings.plates.as_os_str().is_empty() { root.join("background") } else { settings.plates.clone() }
}

/// Where a camera's plate lies in a folder.
#[must_use]
pub fn plate_file(folder: &Path, id: &CameraId) -> PathBuf {
    folder.join(format!("{id}.png"))
}

/// Returns the images of the empty scene `CAM.png` of a folder by slot, where there are any.
///
/// # Errors
/// Names the file that cannot be read; the camera, both sizes and the fix for one of another size than the camera's images.
pub fn plates(folder: &Path, rig: &Rig) -> Result<Vec<Option<Image>>> {
    rig.cameras.iter().map(|camera| plate(folder, camera)).collect()
}

fn plate(folder: &Path, camera: &Camera) -> Result<Option<Image>> {
    let path = plate_file(folder, &camera.id);
    if !path.exists() {
        return Ok(None);
    }
    let picture = image::open(&path).with_context(|| format!("cannot read {}", path.display()))?.into_rgb8();
    let (width, height) = picture.dimensions();
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
    Ok(Some(Image::new(width, height, PixelFormat::Rgb8, picture.into_raw())?))
}

/// Masks that neither lie in the data set nor come with an estimated pose need a plate of every camera, or a key colour.
///
/// # Errors
/// Names what is missing or wrong.
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

/// The one skinned glTF file of a data set.
///
/// # Errors
/// Names what is missing or wrong.
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
