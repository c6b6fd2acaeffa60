//! Calibration folders: `calibration.toml`, or EasyMocap's two files where there is none.

use std::path::Path;

use flyrig_types::{Camera, CameraId, ColorMatch, Intrinsics, Lens, Rig};

use crate::calibration_file;
use crate::easymocap;
use crate::error::CalibError;

/// Reads the rig of a folder. `image_size` gives width and height of a camera's images in pixels for files that lack
/// them; it is checked against those that contain them.
///
/// # Errors
/// [`CalibError`] names the file, the camera and the fix.
pub fn load_calibration(dir: &Path, image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>) -> Result<Rig, CalibError> {
    let path = dir.join(calibration_file::FILE);
    // Where neither is there, the error is that of EasyMocap's files and names both.
    if !path.is_file() {
        return easymocap::load_easymocap(dir, image_size);
    }
    let rig = parse_calibration(&path, &calibration_file::read(&path)?)?;
    check_sizes(&path, rig.cameras.iter().map(|camera| (&camera.id, &camera.intrinsics)), image_size)?;
    Ok(rig)
}

/// Reads a rig from the text of a `calibration.toml`; `path` is for errors.
///
/// ```
/// use flyrig_calib::{calibration_toml, parse_calibration};
///
/// let text = r#"
/// version = 1
/// up = [0.0, 0.0, 1.0]
///
/// [[cameras]]
/// name = "front"
/// size = [1280, 720]
/// focal_px = [900.0, 900.0]
/// center_px = [639.5, 359.5]
/// lens = { model = "radial-tangential", radial = [-0.1, 0.02, 0.0], tangential = [0.0, 0.0] }
/// rotation = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
/// translation_m = [0.0, 1.2, 3.0]
/// "#;
/// let rig = parse_calibration("calibration.toml".as_ref(), text)?;
/// let eye = rig.cameras[0].position();
/// assert!((eye.y + 3.0).abs() < 1e-12 && (eye.z - 1.2).abs() < 1e-12, "in front of the origin, above the floor");
/// assert!(calibration_toml(&rig, &[])?.contains("name = \"front\""));
/// # Ok::<(), flyrig_calib::CalibError>(())
/// ```
///
/// # Errors
/// As [`load_calibration`].
pub fn parse_calibration(path: &Path, text: &str) -> Result<Rig, CalibError> {
    let imported = calibration_file::parse(path, text)?;
    let rig = imported.rig(path)?.ok_or_else(|| CalibError::Format {
        path: path.to_owned(),
        problem: "holds lenses only, no poses; run flyrig calibrate rig with --lenses".to_owned(),
    })?;
    rig.validate().map_err(|source| CalibError::Camera { path: path.to_owned(), source })?;
    Ok(rig)
}

/// Reads the lenses of a folder; poses may be missing. `image_size` as in [`load_calibration`].
///
/// # Errors
/// As [`load_calibration`].
pub fn load_lenses(
    dir: &Path,
    image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>,
) -> Result<Vec<(CameraId, Intrinsics)>, CalibError> {
    let path = dir.join(calibration_file::FILE);
    if !path.is_file() {
        return easymocap::load_lenses(dir, image_size).and_then(|lenses| with_good_names(dir, lenses));
    }
    let lenses = with_good_names(&path, calibration_file::parse(&path, &calibration_file::read(&path)?)?.lenses())?;
    check_sizes(&path, lenses.iter().map(|(id, intrinsics)| (id, intrinsics)), image_size)?;
    Ok(lenses)
}

/// Checks the names of cameras whose poses may be missing; those of a rig are checked with it.
fn with_good_names(
    path: &Path,
    lenses: Vec<(CameraId, Intrinsics)>,
) -> Result<Vec<(CameraId, Intrinsics)>, CalibError> {
    match lenses.iter().find_map(|(id, _)| id.check().err()) {
        Some(error) => Err(CalibError::Camera { path: path.to_owned(), source: error.into() }),
        None => Ok(lenses),
    }
}

fn check_sizes<'a>(
    path: &Path,
    cameras: impl Iterator<Item = (&'a CameraId, &'a Intrinsics)>,
    image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>,
) -> Result<(), CalibError> {
    for (id, intrinsics) in cameras {
        let calibrated = (intrinsics.width, intrinsics.height);
        if let Some(pictures) = image_size(id).filter(|size| *size != calibrated) {
            return Err(CalibError::OtherSize { path: path.to_owned(), camera: id.clone(), calibrated, pictures });
        }
    }
    Ok(())
}

/// Writes the rig of exported images: EasyMocap's files, which other programs read too, or `calibration.toml` where
/// those cannot represent a lens or a colour correction. Time offsets are omitted, since exported images have no
/// timestamps of their own.
///
/// # Errors
/// As [`crate::save_calibration`].
pub fn save_export(dir: &Path, rig: &Rig) -> Result<(), CalibError> {
    let mut rig = rig.clone();
    rig.cameras.iter_mut().for_each(|camera| camera.time_offset_nanos = 0);
    let needs_ours =
        |camera: &Camera| matches!(camera.intrinsics.lens, Lens::Fisheye { .. }) || camera.color != ColorMatch::NONE;
    if rig.cameras.iter().any(needs_ours) {
        return calibration_file::save_calibration(dir, &rig, &[]);
    }
    easymocap::save_easymocap(dir, &rig)
}
