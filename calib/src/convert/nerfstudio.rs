//! nerfstudio and instant-ngp: `transforms.json`. Poses are camera to world with axes x right, y up, z backward; the centre of the
//! first pixel is at (0.5, 0.5). nerfstudio names the lens in `camera_model`, instant-ngp in `is_fisheye`; focal lengths may be angles of
//! view (`camera_angle_x` in radians, `x_fov` in degrees).

use std::path::Path;

use flyrig_types::{CameraId, Isometry, Lens, Rig};
use glam::{DQuat, DVec2, DVec3};
use serde_json::{Map, Value, json};

use super::{
    image_names::{Shot, name_cameras},
    imported::{Imported, ImportedCamera},
    shared::{bad, intrinsics, motion_of, opencv_lens, refuse_unknown, rows4},
};
use crate::calibration_file;
use crate::error::CalibError;

pub(super) const FILE: &str = "transforms.json";
/// Keys that are understood, or change neither lens nor pose: transformations that were applied to the poses already, and those of a
/// display.
const KEYS: [&str; 24] = [
    "camera_model",
    "is_fisheye",
    "k1",
    "k2",
    "k3",
    "k4",
    "k5",
    "k6",
    "camera_angle_x",
    "camera_angle_y",
    "x_fov",
    "y_fov",
    "transform_matrix",
    "transform_matrix_start",
    "transform_matrix_end",
    "applied_transform",
    "applied_scale",
    "scale",
    "up",
    "orientation_override",
    "auto_scale_poses_override",
    "integer_depth_scale",
    "depth_unit_scale_factor",
    "rolling_shutter",
];

/// Returns half a turn about x: from axes x right, y up, z backward to x right, y down, z forward, and back.
pub(super) fn flip() -> DQuat {
    DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0)
}

pub(super) fn read(path: &Path, image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>) -> Result<Imported, CalibError> {
    let text = calibration_file::read(path)?;
    let root: Value =
        serde_json::from_str(&text).map_err(|error| bad(path, format!("is no JSON: {error}; export it again")))?;
    let frames = root
        .get("frames")
        .and_then(Value::as_array)
        .ok_or_else(|| bad(path, "has no list \"frames\"; export it again"))?;
    refuse_keys(&root).map_err(|problem| bad(path, problem))?;
    let shot = |(number, frame): (usize, &Value)| {
        let place = format!("frame {number}");
        shot(&root, frame, place.clone(), image_size).map_err(|problem| bad(path, format!("{place}: {problem}")))
    };
    let shots = frames.iter().enumerate().map(shot).collect::<Result<Vec<_>, _>>()?;
    let cameras = name_cameras(shots).map_err(|problem| bad(path, problem))?;
    let up = match root.get("up").map(|up| serde_json::from_value::<[f64; 3]>(up.clone())) {
        None => None,
        Some(up) => {
            let up = up.ok().and_then(|up| DVec3::from(up).try_normalize());
            Some(up.ok_or_else(|| bad(path, "up is not a direction; give [0, 0, 1], for example"))?)
        }
    };
    Ok(Imported::new(cameras, up))
}

fn refuse_keys(level: &Value) -> Result<(), String> {
    // False, zeros and nothing change nothing.
    fn is_set(value: &Value) -> bool {
        match value {
            Value::Null => false,
            Value::Bool(flag) => *flag,
            Value::Number(number) => number.as_f64() != Some(0.0),
            Value::String(text) => !text.is_empty(),
            Value::Array(items) => items.iter().any(is_set),
            Value::Object(_) => true,
        }
    }
    let keys = level.as_object().into_iter().flatten().filter(|(_, value)| is_set(value)).map(|(key, _)| key.as_str());
    refuse_unknown(keys, &KEYS)
}

/// Returns a value of a frame, or of the file where the frame has none.
fn shot(
    root: &Value,
    frame: &Value,
    place: String,
    image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>,
) -> Result<Shot, String> {
    refuse_keys(frame)?;
    let image = frame.get("file_path").and_then(Value::as_str).ok_or("file_path is missing")?;
    let number = |key: &str| -> Result<Option<f64>, String> {
        match frame.get(key).or_else(|| root.get(key)) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => value.as_f64().map(Some).ok_or_else(|| format!("{key} is missing or no number")),
        }
    };
    let stem = Path::new(image).file_stem().unwrap_or_default().to_string_lossy();
    let size = match (number("w")?, number("h")?, image_size(&CameraId::from(stem.as_ref()))) {
        (Some(width), Some(height), _) => [width, height],
        (None, None, Some((width, height))) => [width, height].map(f64::from),
        _ => return Err("w or h is missing or no number; add them, or give the images with --images".to_owned()),
    };
    let focal = |level: &Value, axis: &str, side: f64| {
        let number = |key: String| level.get(key).and_then(Value::as_f64);
        let of_angle = |angle: f64| 0.5 * side / (0.5 * angle).tan();
        // The first is in degrees, the last in radians.
        let of_degrees = number(format!("{axis}_fov")).map(|angle| of_angle(angle.to_radians()));
        let of_pixels = || number(format!("fl_{axis}"));
        of_degrees.or_else(of_pixels).or_else(|| number(format!("camera_angle_{axis}")).map(of_angle))
    };
    let own = focal(frame, "x", size[0]);
    let x = own.or_else(|| focal(root, "x", size[0]));
    let of_root = || if own.is_some() { number("fl_y").ok().flatten() } else { focal(root, "y", size[1]) };
    let y = focal(frame, "y", size[1]).or_else(of_root);
    let focal = match (x, y) {
        (Some(x), y) => DVec2::new(x, y.unwrap_or(x)),
        (None, Some(y)) => DVec2::splat(y),
        (None, None) => return Err("fl_x is missing or no number, and camera_angle_x too".to_owned()),
    };
    let center = match (number("cx")?, number("cy")?) {
        (Some(x), Some(y)) => DVec2::new(x, y),
        (None, None) => DVec2::from(size) * 0.5,
        _ => return Err("one of cx and cy is missing; give both, or neither".to_owned()),
    };
    let intrinsics = intrinsics(size, focal, center - 0.5, lens(root, frame, &number)?);
    let world_from_camera = pose(frame)?;
    let pose = Isometry::new(flip(), DVec3::ZERO) * world_from_camera.inverse();
    Ok(Shot { image: image.to_owned(), place, camera: ImportedCamera::unnamed(intrinsics, Some(pose)) })
}

fn lens(root: &Value, frame: &Value, number: &dyn Fn(&str) -> Result<Option<f64>, String>) -> Result<Lens, String> {
    let any = |key: &str| frame.get(key).or_else(|| root.get(key));
    let or_zero = |key: &str| number(key).map(|value| value.unwrap_or(0.0));
    let [k1, k2, k3, k4, k5, k6] =
        [or_zero("k1")?, or_zero("k2")?, or_zero("k3")?, or_zero("k4")?, or_zero("k5")?, or_zero("k6")?];
    let [p1, p2] = [or_zero("p1")?, or_zero("p2")?];
    let model = match any("camera_model") {
        None | Some(Value::Null) => None,
        Some(model) => Some(model.as_str().ok_or("camera_model is no word")?.to_uppercase()),
    };
    let flag = match any("is_fisheye") {
        None | Some(Value::Null) => None,
        Some(Value::Bool(flag)) => Some(*flag),
        Some(value) => match value.as_f64() {
            Some(0.0) => Some(false),
            Some(1.0) => Some(true),
            _ => return Err("is_fisheye is neither true nor false".to_owned()),
        },
    };
    let is_fisheye = match (model.as_deref(), flag) {
        (Some("OPENCV_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE"), flag) if flag != Some(false) => true,
        (Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "FULL_OPENCV"), flag)
            if flag != Some(true) =>
        {
            false
        }
        (None, flag) => flag.unwrap_or(false),
        (Some(model), Some(flag)) => {
            return Err(format!(
                "camera_model {model} and is_fisheye = {flag} contradict each other; correct one of them"
            ));
        }
        (Some(model), None) => {
            return Err(format!("camera_model {model} is not supported; use OPENCV or OPENCV_FISHEYE"));
        }
    };
    if !is_fisheye && model.as_deref() == Some("FULL_OPENCV") {
        return opencv_lens(&[k1, k2, p1, p2, k3, k4, k5, k6]);
    }
    if k5 != 0.0 || k6 != 0.0 || !is_fisheye && k4 != 0.0 || is_fisheye && (p1 != 0.0 || p2 != 0.0) {
        let model = if is_fisheye { "OPENCV_FISHEYE" } else { "OPENCV" };
        return Err(format!(
            "{model} with k4 = {k4}, k5 = {k5}, k6 = {k6}, p1 = {p1}, p2 = {p2} is not supported; use k1 k2 k3 p1 p2 of OPENCV, k1 to k4 of \
             OPENCV_FISHEYE, or k1 to k6 p1 p2 of FULL_OPENCV"
        ));
    }
    if is_fisheye && model.is_none() && [k1, k2, k3, k4].iter().all(|k| *k == 0.0) {
        return Err(
            "is_fisheye with k1 to k4 of 0 is no lens to instant-ngp; say camera_model OPENCV_FISHEYE or PINHOLE"
                .to_owned(),
        );
    }
    Ok(if is_fisheye {
        Lens::Fisheye { coefficients: [k1, k2, k3, k4] }
    } else {
        Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] }
    })
}

fn pose(frame: &Value) -> Result<Isometry, String> {
    let rows = |value: &Value| -> Option<Vec<Vec<f64>>> {
        value.as_array()?.iter().map(|row| row.as_array()?.iter().map(Value::as_f64).collect()).collect()
    };
    let start = frame.get("transform_matrix_start").or_else(|| frame.get("transform_matrix"));
    if frame.get("transform_matrix_end").is_some_and(|end| Some(end) != start) {
        return Err(
            "transform_matrix_end differs from the start: the camera moved during the image; give one transform_matrix"
                .to_owned(),
        );
    }
    let matrix = start.and_then(rows).ok_or("transform_matrix is missing or no matrix of numbers")?;
    motion_of(&matrix).map_err(|problem| format!("transform_matrix {problem}"))
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
