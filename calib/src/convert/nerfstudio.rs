//! nerfstudio and instant-ngp: `transforms.json`. Poses are camera to world with axes x right, y up, z backward; the centre of the
//! first pixel is at (0.5, 0.5).

use std::path::Path;

use flyrig_types::{Isometry, Lens, Rig};
use glam::{DQuat, DVec2, DVec3};
use serde_json::{Map, Value, json};

use super::{
    colmap::same_pose,
    imported::{Imported, ImportedCamera},
    shared::{bad, camera_of_image, intrinsics, motion_of, rows4},
};
use crate::calibration_file;
use crate::error::CalibError;

pub(super) const FILE: &str = "transforms.json";

/// Returns half a turn about x: from axes x right, y up, z backward to x right, y down, z forward, and back.
pub(super) fn flip() -> DQuat {
    DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0)
}

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let text = calibration_file::read(path)?;
    let root: Value =
        serde_json::from_str(&text).map_err(|error| bad(path, format!("is no JSON: {error}; export it again")))?;
    let frames = root
        .get("frames")
        .and_then(Value::as_array)
        .ok_or_else(|| bad(path, "has no list \"frames\"; export it again"))?;
    let mut cameras: Vec<ImportedCamera> = Vec::new();
    for (number, frame) in frames.iter().enumerate() {
        let camera = camera(&root, frame).map_err(|problem| bad(path, format!("frame {number}: {problem}")))?;
        let Some(known) = cameras.iter().find(|known| known.id == camera.id) else {
            cameras.push(camera);
            continue;
        };
        if !same_pose(known, &camera) {
            let problem = format!("camera {} has two poses; give one frame of each camera", camera.id);
            return Err(bad(path, format!("frame {number}: {problem}")));
        }
    }
    Ok(Imported { cameras, up: None })
}

fn camera(root: &Value, frame: &Value) -> Result<ImportedCamera, String> {
    let any = |key: &str| frame.get(key).or_else(|| root.get(key));
    let number = |key: &str| any(key).and_then(Value::as_f64);
    let need = |key: &str| number(key).ok_or_else(|| format!("{key} is missing or no number"));
    let or_zero = |key: &str| number(key).unwrap_or(0.0);
    let file = frame.get("file_path").and_then(Value::as_str).ok_or("file_path is missing")?;
    let fx = need("fl_x")?;
    let [k1, k2, k3, k4] = ["k1", "k2", "k3", "k4"].map(or_zero);
    let lens = match any("camera_model").and_then(Value::as_str).unwrap_or("OPENCV") {
        "OPENCV_FISHEYE" => Lens::Fisheye { coefficients: [k1, k2, k3, k4] },
        "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" if k4 == 0.0 => {
            Lens::RadialTangential { radial: [k1, k2, k3], tangential: [or_zero("p1"), or_zero("p2")] }
        }
        model => {
            return Err(format!("camera_model {model} with k4 = {k4} is not supported; use OPENCV or OPENCV_FISHEYE"));
        }
    };
    let rows = |value: &Value| -> Option<Vec<Vec<f64>>> {
        value.as_array()?.iter().map(|row| row.as_array()?.iter().map(Value::as_f64).collect()).collect()
    };
    let matrix =
        frame.get("transform_matrix").and_then(rows).ok_or("transform_matrix is missing or no matrix of numbers")?;
    let world_from_camera = motion_of(&matrix).map_err(|problem| format!("transform_matrix {problem}"))?;
    let center = DVec2::new(need("cx")?, need("cy")?) - 0.5;
    Ok(ImportedCamera {
        id: camera_of_image(file),
        intrinsics: intrinsics([need("w")?, need("h")?], DVec2::new(fx, number("fl_y").unwrap_or(fx)), center, lens),
        pose: Some(Isometry::new(flip(), DVec3::ZERO) * world_from_camera.inverse()),
        time_offset_nanos: 0,
        color: Default::default(),
    })
}

pub(super) fn text(dir: &Path, rig: &Rig) -> Result<String, CalibError> {
    let is_fisheye = |lens: &Lens| matches!(lens, Lens::Fisheye { .. });
    let fisheyes = rig.cameras.iter().filter(|camera| is_fisheye(&camera.intrinsics.lens)).count();
    let refused = |problem: String| bad(&dir.join(FILE), problem);
    if fisheyes != 0 && fisheyes != rig.cameras.len() {
        return Err(refused(
            "has one camera model for all cameras, but only some are fisheyes; write them apart".to_owned(),
        ));
    }
    let mut frames = Vec::new();
    for camera in &rig.cameras {
        let i = &camera.intrinsics;
        let coefficients: Vec<(&str, f64)> = match i.lens {
            Lens::Fisheye { coefficients } => ["k1", "k2", "k3", "k4"].into_iter().zip(coefficients).collect(),
            Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } => {
                vec![("k1", k1), ("k2", k2), ("k3", k3), ("p1", p1), ("p2", p2)]
            }
            Lens::Rational { .. } => {
                return Err(refused(format!(
                    "camera {}: nerfstudio has no rational lens; calibrate it with k1 k2 p1 p2 k3",
                    camera.id
                )));
            }
        };
        let center = i.center_px + 0.5;
        let world_from_camera = camera.camera_from_world.inverse() * Isometry::new(flip(), DVec3::ZERO);
        let mut frame = Map::new();
        frame.insert("file_path".to_owned(), json!(format!("images/{}.png", camera.id)));
        frame.insert("transform_matrix".to_owned(), json!(rows4(&world_from_camera)));
        let numbers = [("fl_x", i.focal_px.x), ("fl_y", i.focal_px.y), ("cx", center.x), ("cy", center.y)];
        frame.extend(numbers.into_iter().chain(coefficients).map(|(key, value)| (key.to_owned(), json!(value))));
        frame.insert("w".to_owned(), json!(i.width));
        frame.insert("h".to_owned(), json!(i.height));
        frames.push(Value::Object(frame));
    }
    let model = if fisheyes > 0 { "OPENCV_FISHEYE" } else { "OPENCV" };
    let root = json!({ "camera_model": model, "frames": frames });
    serde_json::to_string_pretty(&root).map_err(|error| refused(error.to_string()))
}
