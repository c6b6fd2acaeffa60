//! TOML of anipose, Pose2Sim and caliscope: one table per camera with `name`, `size`, `matrix`, `distortions`,
//! `fisheye`, `rotation` (a Rodrigues vector, or a matrix in older files of caliscope) and `translation`. caliscope
//! puts the tables into `[cameras]`; lengths are in the unit of the board.

use std::{fmt::Write as _, path::Path};

use flyrig_types::{CameraId, Isometry, Rig};
use glam::{DMat3, DQuat, DVec3};
use toml::{Table, Value};

use super::{
    imported::{Imported, ImportedCamera},
    shared::{
        bad, camera_matrix, fisheye_lens, intrinsics, opencv_coefficients, opencv_lens, refuse_unknown, rotation_of,
    },
};
use crate::calibration_file;
use crate::error::CalibError;

pub(super) const FILE: &str = "anipose.toml";
/// Keys of a camera that are understood. caliscope turns images for display alone (`rotation_count`).
const KEYS: [&str; 7] = ["matrix", "distortions", "fisheye", "rotation", "translation", "size", "rotation_count"];

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let text = calibration_file::read(path)?;
    let root: Table =
        text.parse().map_err(|error: toml::de::Error| bad(path, format!("is no TOML: {}", error.message())))?;
    let tables = root.get("cameras").and_then(Value::as_table).unwrap_or(&root);
    let scalars = root.iter().filter(|(_, value)| !value.is_table()).map(|(key, _)| key.as_str());
    let metadata = root.get("metadata").and_then(Value::as_table).into_iter().flatten().map(|(key, _)| key.as_str());
    refuse_unknown(scalars.chain(metadata), &[]).map_err(|problem| bad(path, problem))?;
    // A table with neither is the board's, for example.
    let is_camera = |table: &&Table| table.contains_key("matrix") || table.contains_key("size");
    let cameras = tables
        .iter()
        .filter_map(|(key, value)| Some((key, value.as_table().filter(is_camera)?)))
        .map(|(key, table)| camera(key, table).map_err(|problem| bad(path, format!("camera {key}: {problem}"))))
        .collect::<Result<_, _>>()?;
    let mut imported = Imported::new(cameras, None);
    for (key, table) in tables.iter().filter_map(|(key, value)| Some((key, value.as_table()?))) {
        if table.get("rotation_count").is_some_and(|turns| turns.as_integer() != Some(0)) {
            imported.warnings.push(format!(
                "camera {key}: rotation_count turns images for display; the lens is of images as recorded"
            ));
        }
    }
    Ok(imported)
}

fn number(value: &Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64))
}

fn numbers(value: &Value) -> Option<Vec<f64>> {
    value.as_array()?.iter().map(number).collect()
}

fn rows3(value: &Value) -> Option<[f64; 9]> {
    let rows: Vec<Vec<f64>> = value.as_array()?.iter().map(numbers).collect::<Option<_>>()?;
    rows.concat().try_into().ok().filter(|_| rows.len() == 3)
}

fn camera(key: &str, table: &Table) -> Result<ImportedCamera, String> {
    refuse_unknown(table.keys().map(String::as_str), &KEYS)?;
    let missing = |key: &str| format!("{key} is missing or not what it should be; export it again");
    let list = |key: &str| table.get(key).and_then(numbers).ok_or_else(|| missing(key));
    let matrix = table.get("matrix").and_then(rows3).ok_or_else(|| missing("matrix"))?;
    let (focal, center) = camera_matrix(&matrix).map_err(|problem| format!("matrix {problem}"))?;
    let &[width, height] = list("size")?.as_slice() else { return Err(missing("size")) };
    // Some versions write OpenCV's array of one row.
    let nested = table.get("distortions").and_then(Value::as_array).filter(|rows| rows.len() == 1);
    let distortions = match nested.and_then(|rows| numbers(&rows[0])) {
        Some(row) => row,
        None => list("distortions")?,
    };
    let is_fisheye = match table.get("fisheye") {
        None | Some(Value::Boolean(false) | Value::Integer(0)) => false,
        Some(Value::Boolean(true) | Value::Integer(1)) => true,
        Some(other) => return Err(format!("fisheye is {other}, neither true nor false")),
    };
    let lens = if is_fisheye { fisheye_lens(&distortions)? } else { opencv_lens(&distortions)? };
    let pose = match (table.get("rotation"), table.get("translation")) {
        (Some(rotation), Some(_)) => {
            let &[x, y, z] = list("translation")?.as_slice() else { return Err(missing("translation")) };
            let turn = match (rows3(rotation), numbers(rotation).as_deref()) {
                (Some(rows), _) => {
                    rotation_of(DMat3::from_cols_array(&rows).transpose()).map_err(|p| format!("rotation {p}"))?
                }
                (None, Some(&[rx, ry, rz])) => DQuat::from_scaled_axis(DVec3::new(rx, ry, rz)),
                _ => return Err(missing("rotation")),
            };
            Some(Isometry::new(turn, DVec3::new(x, y, z)))
        }
        _ => None,
    };
    // anipose counts its tables and names the camera inside; caliscope numbers both.
    let name = table.get("name").and_then(Value::as_str).unwrap_or(key);
    let intrinsics = intrinsics([width, height], focal, center, lens);
    Ok(ImportedCamera { id: CameraId::from(name), ..ImportedCamera::unnamed(intrinsics, pose) })
}

pub(super) fn text(rig: &Rig) -> String {
    let mut text = String::new();
    for (number, camera) in rig.cameras.iter().enumerate() {
        let i = &camera.intrinsics;
        let coefficients = opencv_coefficients(&i.lens);
        let _ = write!(
            text,
            "[cam_{number}]\nname = {}\nsize = [{}, {}]\nmatrix = [[{:?}, 0.0, {:?}], [0.0, {:?}, {:?}], [0.0, 0.0, 1.0]]\n\
             distortions = {:?}\nfisheye = {}\nrotation = {:?}\ntranslation = {:?}\n\n",
            Value::String(camera.id.to_string()),
            i.width,
            i.height,
            i.focal_px.x,
            i.center_px.x,
            i.focal_px.y,
            i.center_px.y,
            coefficients.clone().unwrap_or_else(|| i.lens.coefficients()),
            coefficients.is_none(),
            camera.camera_from_world.rotation.to_scaled_axis().to_array(),
            camera.camera_from_world.translation.to_array(),
        );
    }
    text + "[metadata]\nerror = 0.0\n"
}
