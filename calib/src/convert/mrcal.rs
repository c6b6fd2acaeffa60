//! mrcal: one file `CAM.cameramodel` per camera, a Python dictionary with `lensmodel`, `intrinsics`, `extrinsics` (the
//! camera from the reference: Rodrigues vector and translation) and `imagersize`.

use std::path::Path;

use flyrig_types::{Camera, CameraId, Isometry, Rig};
use glam::{DQuat, DVec2, DVec3};
use serde_json::Value;

use super::{
    imported::{Imported, ImportedCamera},
    python,
    shared::{bad, files_with, intrinsics, opencv_coefficients, opencv_lens, refuse_unknown},
};
use crate::calibration_file;
use crate::error::CalibError;

const ENDING: &str = ".cameramodel";
/// Keys that are understood.
const KEYS: [&str; 5] = ["lensmodel", "lens_model", "distortion_model", "extrinsics", "rt_cam_ref"];

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let files = if path.is_dir() { files_with(path, ENDING)? } else { vec![path.to_owned()] };
    let camera = |file: &std::path::PathBuf| {
        let text = calibration_file::read(file)?;
        let root: Value = serde_json::from_str(&python::to_json(&text))
            .map_err(|error| bad(file, format!("is not a Python dictionary: {error}; export it again")))?;
        let id = CameraId::from(file.file_stem().unwrap_or_default().to_string_lossy().as_ref());
        model(id, &root).map_err(|problem| bad(file, problem))
    };
    Ok(Imported::new(files.iter().map(camera).collect::<Result<_, _>>()?, None))
}

fn model(id: CameraId, root: &Value) -> Result<ImportedCamera, String> {
    refuse_unknown(root.as_object().into_iter().flatten().map(|(key, _)| key.as_str()), &KEYS)?;
    let any = |keys: &[&str]| keys.iter().find_map(|key| root.get(key));
    let list = |keys: &[&str]| -> Result<Vec<f64>, String> {
        let numbers = any(keys).and_then(Value::as_array).and_then(|list| list.iter().map(Value::as_f64).collect());
        numbers.ok_or_else(|| format!("{} is missing or no list of numbers", keys[0]))
    };
    // Files from before 2020 say DISTORTION_OPENCV8.
    let name =
        any(&["lensmodel", "lens_model", "distortion_model"]).and_then(Value::as_str).ok_or("lensmodel is missing")?;
    let name = &name.replace("DISTORTION_", "LENSMODEL_");
    let values = list(&["intrinsics"])?;
    let [fx, fy, cx, cy, ref coefficients @ ..] = *values.as_slice() else {
        return Err(format!("intrinsics has {} numbers, expected fx fy cx cy and coefficients", values.len()));
    };
    let expected = match name.as_str() {
        "LENSMODEL_PINHOLE" => 0,
        "LENSMODEL_OPENCV4" => 4,
        "LENSMODEL_OPENCV5" => 5,
        "LENSMODEL_OPENCV8" => 8,
        "LENSMODEL_OPENCV12" => 12,
        _ => return Err(format!("{name} is not supported; run mrcal-convert-lensmodel LENSMODEL_OPENCV8")),
    };
    if coefficients.len() != expected {
        return Err(format!("{name} has {} coefficients, expected {expected}", coefficients.len()));
    }
    let &[width, height] = list(&["imagersize"])?.as_slice() else {
        return Err("imagersize is not width and height".to_owned());
    };
    let &[rx, ry, rz, x, y, z] = list(&["extrinsics", "rt_cam_ref"])?.as_slice() else {
        return Err("extrinsics are not six numbers".to_owned());
    };
    Ok(ImportedCamera {
        id,
        intrinsics: intrinsics([width, height], DVec2::new(fx, fy), DVec2::new(cx, cy), opencv_lens(coefficients)?),
        pose: Some(Isometry::new(DQuat::from_scaled_axis(DVec3::new(rx, ry, rz)), DVec3::new(x, y, z))),
        time_offset_nanos: 0,
        color: Default::default(),
    })
}

pub(super) fn files(dir: &Path, rig: &Rig) -> Result<Vec<(String, Vec<u8>)>, CalibError> {
    let file = |camera: &Camera| {
        let i = &camera.intrinsics;
        let coefficients = opencv_coefficients(&i.lens).ok_or_else(|| {
            let problem = format!(
                "camera {}: mrcal has no such fisheye; use another format, or calibrate the lens with it",
                camera.id
            );
            bad(dir, problem)
        })?;
        let numbers = [vec![i.focal_px.x, i.focal_px.y, i.center_px.x, i.center_px.y], coefficients.clone()].concat();
        let (r, t) = (camera.camera_from_world.rotation.to_scaled_axis(), camera.camera_from_world.translation);
        let text = format!(
            "{{\n    'lensmodel': 'LENSMODEL_OPENCV{}',\n    'intrinsics': {numbers:?},\n    # the camera from the reference\n    \
             'extrinsics': {:?},\n    'imagersize': [{}, {}]\n}}\n",
            coefficients.len(),
            [r.x, r.y, r.z, t.x, t.y, t.z],
            i.width,
            i.height
        );
        Ok((format!("{}{ENDING}", camera.id), text.into_bytes()))
    };
    rig.cameras.iter().map(file).collect()
}
