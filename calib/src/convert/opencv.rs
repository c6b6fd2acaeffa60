//! OpenCV: one FileStorage file `CAM.yml` per camera (or `.yaml`, `.xml`, `.json`), with the keys of OpenCV's calibration sample, of
//! ROS' camera_info or of voxl.
//!
//! `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients`, the lens in `fisheye_model` (1 for a fisheye) or
//! `distortion_model`, and for the pose `rvec` (or `R`) and `tvec` (or `T`), `x_camera = R x_world + T`.

use std::path::Path;

use flyrig_types::{CameraId, Isometry, Lens, Rig};
use glam::{DMat3, DQuat, DVec3};

use super::{
    imported::{Imported, ImportedCamera},
    shared::{
        bad, camera_matrix, files_with, fisheye_lens, intrinsics, named_lens, opencv_coefficients, opencv_lens,
        refuse_unknown, rotation_of,
    },
};
use crate::error::CalibError;
use crate::yaml::{Matrix, YamlFile, YamlWriter};

/// Endings of FileStorage.
pub(super) const ENDINGS: [&str; 4] = [".yml", ".yaml", ".xml", ".json"];
const MATRIX: [&str; 3] = ["camera_matrix", "K", "M"];
const COEFFICIENTS: [&str; 5] = ["distortion_coefficients", "dist_coeffs", "distCoeffs", "D", "dist"];
const ROTATION: [&str; 3] = ["rvec", "R", "rotation"];
const TRANSLATION: [&str; 3] = ["tvec", "T", "translation"];
const WIDTH: [&str; 2] = ["image_width", "width"];
const HEIGHT: [&str; 2] = ["image_height", "height"];
const MODEL: [&str; 1] = ["distortion_model"];
const CAMERA_MODEL: [&str; 1] = ["camera_model"];
const FISHEYE: [&str; 1] = ["fisheye_model"];
/// Keys that change neither lens nor pose: poses of the board, and of images that were rectified.
const HARMLESS: [&str; 3] = ["extrinsic_parameters", "rectification_matrix", "projection_matrix"];

/// Returns whether a text holds a camera of FileStorage.
pub(super) fn is_storage(text: &str) -> bool {
    text.contains("<opencv_storage") || text.to_lowercase().contains("camera_matrix")
}

pub(super) fn read(path: &Path, image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>) -> Result<Imported, CalibError> {
    let mut files = Vec::new();
    if path.is_dir() {
        // Files of the first ending that occurs.
        for ending in ENDINGS {
            if files.is_empty() {
                files = files_with(path, ending)?;
            }
        }
    } else {
        files.push(path.to_owned());
    }
    let cameras = files.into_iter().map(|file| camera(&file, image_size)).collect::<Result<_, _>>()?;
    Ok(Imported::new(cameras, None))
}

fn camera(path: &Path, image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>) -> Result<ImportedCamera, CalibError> {
    let id = CameraId::from(path.file_stem().unwrap_or_default().to_string_lossy().as_ref());
    let file = YamlFile::open(path.to_owned())?;
    let groups: [&[&str]; 10] =
        [&MATRIX, &COEFFICIENTS, &ROTATION, &TRANSLATION, &WIDTH, &HEIGHT, &MODEL, &CAMERA_MODEL, &FISHEYE, &HARMLESS];
    let understood: Vec<&str> = groups.concat();
    let unknown = file.keys().filter(|key| !understood.iter().any(|known| known.eq_ignore_ascii_case(key)));
    refuse_unknown(unknown, &[]).map_err(|problem| bad(path, problem))?;
    let first = |keys: &[&str]| -> Result<Option<Matrix>, CalibError> {
        file.key(keys).map_or(Ok(None), |key| file.matrix(&id, key))
    };
    let missing =
        |key: &str| bad(path, format!("{key} is missing; export the camera again with OpenCV's calibration sample"));
    if file.key(&["M1"]).is_some() {
        return Err(bad(
            path,
            "holds a stereo pair (M1, D1, M2, D2); write one file for each camera, with rvec and tvec",
        ));
    }
    let k = first(&MATRIX)?.ok_or_else(|| missing("camera_matrix"))?;
    let (focal, center) = camera_matrix(&k.values).map_err(|problem| bad(path, format!("camera_matrix {problem}")))?;
    let d = first(&COEFFICIENTS)?.ok_or_else(|| missing("distortion_coefficients"))?;
    let lens = lens(&file, &d.values).map_err(|problem| bad(path, problem))?;
    let side = |keys: &[&str]| file.key(keys).and_then(|key| file.number(key));
    let size = match (side(&WIDTH), side(&HEIGHT), image_size(&id)) {
        (Some(width), Some(height), _) => [width, height],
        (None, None, Some((width, height))) => [width, height].map(f64::from),
        _ => return Err(missing("image_width or image_height")),
    };
    let pose = match (first(&ROTATION)?, first(&TRANSLATION)?) {
        (Some(rotation), Some(translation)) => {
            Some(pose(&rotation, &translation).map_err(|problem| bad(path, problem))?)
        }
        (None, None) => None,
        _ => return Err(bad(path, "one of rvec and tvec is missing; give both, or neither")),
    };
    let intrinsics = intrinsics(size, focal, center, lens);
    Ok(ImportedCamera { id, ..ImportedCamera::unnamed(intrinsics, pose) })
}

/// Returns the lens that `fisheye_model`, `distortion_model` and `camera_model` name; they must agree.
fn lens(file: &YamlFile, coefficients: &[f64]) -> Result<Lens, String> {
    let word = |keys: &[&str]| -> Result<Option<&str>, String> {
        let Some(key) = file.key(keys) else { return Ok(None) };
        file.get(key).and_then(|value| value.word()).map(Some).ok_or_else(|| format!("{key} is no word"))
    };
    let flag = match word(&FISHEYE)?.map(str::to_lowercase).as_deref() {
        None => None,
        Some("1" | "true" | "yes") => Some(fisheye_lens(coefficients)?),
        Some("0" | "false" | "no") => Some(opencv_lens(coefficients)?),
        Some(other) => return Err(format!("fisheye_model is {other:?}; give 1 for a fisheye, 0 for none")),
    };
    let named = |keys: &[&str]| -> Result<Option<Lens>, String> {
        let Some(model) = word(keys)? else { return Ok(None) };
        named_lens(model, coefficients).map(Some).map_err(|problem| format!("{}: {problem}", keys[0]))
    };
    let distortion = named(&MODEL)?;
    // A camera model "pinhole" says nothing of the distortion.
    let is_pinhole = word(&CAMERA_MODEL)?.is_some_and(|model| model.eq_ignore_ascii_case("pinhole"));
    let camera = if is_pinhole { None } else { named(&CAMERA_MODEL)? };
    let stated: Vec<Lens> = [flag, distortion, camera].into_iter().flatten().collect();
    if stated.windows(2).any(|pair| pair[0] != pair[1]) {
        return Err("fisheye_model, distortion_model and camera_model contradict each other; correct them".to_owned());
    }
    stated.first().map_or_else(|| opencv_lens(coefficients), |lens| Ok(*lens))
}

fn pose(rotation: &Matrix, translation: &Matrix) -> Result<Isometry, String> {
    let rotation = match rotation.values.as_slice() {
        &[x, y, z] => DQuat::from_scaled_axis(DVec3::new(x, y, z)),
        values => match <[f64; 9]>::try_from(values) {
            Ok(rows) => {
                rotation_of(DMat3::from_cols_array(&rows).transpose()).map_err(|problem| format!("R {problem}"))?
            }
            Err(_) => return Err(format!("rvec has {} numbers, expected 3 or 9", values.len())),
        },
    };
    match translation.values.as_slice() {
        &[x, y, z] => Ok(Isometry::new(rotation, DVec3::new(x, y, z))),
        values => Err(format!("tvec has {} numbers, expected 3", values.len())),
    }
}

pub(super) fn files(dir: &Path, rig: &Rig) -> Result<Vec<(String, Vec<u8>)>, CalibError> {
    let file = |camera: &flyrig_types::Camera| {
        let name = format!("{}.yml", camera.id);
        let i = &camera.intrinsics;
        let mut text = YamlWriter::new(dir.join(&name));
        text.integer("image_width", i.width);
        text.integer("image_height", i.height);
        text.matrix(
            "camera_matrix",
            3,
            &[i.focal_px.x, 0.0, i.center_px.x, 0.0, i.focal_px.y, i.center_px.y, 0.0, 0.0, 1.0],
        );
        let coefficients = opencv_coefficients(&i.lens);
        text.integer("fisheye_model", u32::from(coefficients.is_none()));
        text.matrix("distortion_coefficients", 1, &coefficients.unwrap_or_else(|| i.lens.coefficients()));
        text.matrix("rvec", 1, &camera.camera_from_world.rotation.to_scaled_axis().to_array());
        text.matrix("tvec", 1, &camera.camera_from_world.translation.to_array());
        Ok((name, text.into_text().into_bytes()))
    };
    rig.cameras.iter().map(file).collect()
}
