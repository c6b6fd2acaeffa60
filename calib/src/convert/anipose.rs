//! TOML of anipose, Pose2Sim and caliscope: one table per camera with `name`, `size`, `matrix`, `distortions`,
//! `fisheye`, `rotation` (a Rodrigues vector, or a matrix in older files of caliscope) and `translation`. caliscope
//! puts the tables into `[cameras]`; lengths are in the unit of the board.

use std::{fmt::Write as _, path::Path};

use flyrig_types::{CameraId, Isometry, Lens, Rig};
use glam::{DMat3, DQuat, DVec2, DVec3};
use toml::{Table, Value};

use super::{
    imported::{Imported, ImportedCamera},
    shared::{bad, intrinsics, opencv_coefficients, opencv_lens, rotation_of},
};
use crate::calibration_file;
use crate::error::CalibError;

pub(super) const FILE: &str = "anipose.toml";

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let text = calibration_file::read(path)?;
    let root: Table =
        text.parse().map_err(|error: toml::de::Error| bad(path, format!("is no TOML: {}", error.message())))?;
    let tables = root.get("cameras").and_then(Value::as_table).unwrap_or(&root);
    let cameras = tables
        .iter()
        .filter_map(|(key, value)| Some((key, value.as_table().filter(|table| table.contains_key("matrix"))?)))
        .map(|(key, table)| camera(key, table).map_err(|problem| bad(path, format!("camera {key}: {problem}"))))
        .collect::<Result<_, _>>()?;
    Ok(Imported { cameras, up: None })
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
    let missing = |key: &str| format!("{key} is missing or not what it should be; export it again");
    let list = |key: &str| table.get(key).and_then(numbers).ok_or_else(|| missing(key));
    let [fx, skew, cx, zero, fy, cy, ..] = table.get("matrix").and_then(rows3).ok_or_else(|| missing("matrix"))?;
    if skew.abs() > 0.01 || zero != 0.0 {
        return Err("matrix has skew; calibrate without it".to_owned());
    }
    let &[width, height] = list("size")?.as_slice() else { return Err(missing("size")) };
    let distortions = list("distortions")?;
    let lens = match (table.get("fisheye").and_then(Value::as_bool), distortions.as_slice()) {
        (Some(true), &[k1, k2, k3, k4]) => Lens::Fisheye { coefficients: [k1, k2, k3, k4] },
        (Some(true), other) => return Err(format!("{} coefficients of a fisheye, expected 4", other.len())),
        (_, values) => opencv_lens(values)?,
    };
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
    Ok(ImportedCamera {
        id: CameraId::from(name),
        intrinsics: intrinsics([width, height], DVec2::new(fx, fy), DVec2::new(cx, cy), lens),
        pose,
        time_offset_nanos: 0,
        color: Default::default(),
    })
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
