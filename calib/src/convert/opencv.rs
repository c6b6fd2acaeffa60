//! OpenCV: one FileStorage file `CAM.yml` per camera, with the keys of OpenCV's calibration sample.
//!
//! `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients`, `fisheye_model` (1 for a fisheye), and for the pose
//! `rvec` (or `R`) and `tvec` (or `T`), `x_camera = R x_world + T`.

use std::path::Path;

use flyrig_types::{CameraId, Isometry, Lens, Rig};
use glam::{DMat3, DQuat, DVec2, DVec3};

use super::{
    imported::{Imported, ImportedCamera},
    shared::{bad, files_with, intrinsics, opencv_coefficients, opencv_lens, rotation_of},
};
use crate::error::CalibError;
use crate::yaml::{Matrix, YamlFile, YamlWriter};

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let files = if path.is_dir() { files_with(path, ".yml")? } else { vec![path.to_owned()] };
    let cameras = files.into_iter().map(|file| camera(&file)).collect::<Result<_, _>>()?;
    Ok(Imported { cameras, up: None })
}

fn camera(path: &Path) -> Result<ImportedCamera, CalibError> {
    let id = CameraId::from(path.file_stem().unwrap_or_default().to_string_lossy().as_ref());
    let file = YamlFile::open(path.to_owned())?;
    let first = |keys: &[&str]| -> Result<Option<Matrix>, CalibError> {
        for key in keys {
            if let Some(matrix) = file.matrix(&id, key)? {
                return Ok(Some(matrix));
            }
        }
        Ok(None)
    };
    let missing =
        |key: &str| bad(path, format!("{key} is missing; export the camera again with OpenCV's calibration sample"));
    let k = first(&["camera_matrix", "K"])?.ok_or_else(|| missing("camera_matrix"))?;
    let &[fx, skew, cx, zero, fy, cy, _, _, one] = k.values.as_slice() else {
        return Err(bad(path, "camera_matrix is not 3x3; export the camera again"));
    };
    if skew.abs() > 0.01 || zero != 0.0 || (one - 1.0).abs() > 1e-9 {
        return Err(bad(path, "camera_matrix has skew; calibrate without it"));
    }
    let d =
        first(&["distortion_coefficients", "dist_coeffs", "D"])?.ok_or_else(|| missing("distortion_coefficients"))?;
    let is_fisheye = file.number("fisheye_model").is_some_and(|flag| flag != 0.0);
    let lens = match (is_fisheye, d.values.as_slice()) {
        (true, &[k1, k2, k3, k4]) => Lens::Fisheye { coefficients: [k1, k2, k3, k4] },
        (true, other) => return Err(bad(path, format!("{} coefficients of a fisheye, expected 4", other.len()))),
        (false, values) => opencv_lens(values).map_err(|problem| bad(path, problem))?,
    };
    let side = |key: &str| file.number(key).ok_or_else(|| missing(key));
    let size = [side("image_width")?, side("image_height")?];
    let pose = match (first(&["rvec", "R", "rotation"])?, first(&["tvec", "T", "translation"])?) {
        (Some(rotation), Some(translation)) => {
            Some(pose(&rotation, &translation).map_err(|problem| bad(path, problem))?)
        }
        (None, None) => None,
        _ => return Err(bad(path, "one of rvec and tvec is missing; give both, or neither")),
    };
    let intrinsics = intrinsics(size, DVec2::new(fx, fy), DVec2::new(cx, cy), lens);
    Ok(ImportedCamera { id, intrinsics, pose, time_offset_nanos: 0, color: Default::default() })
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

pub(super) fn files(dir: &Path, rig: &Rig) -> Result<Vec<(String, String)>, CalibError> {
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
        Ok((name, text.into_text()))
    };
    rig.cameras.iter().map(file).collect()
}
