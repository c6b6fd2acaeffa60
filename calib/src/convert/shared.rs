//! Helpers shared by several formats.

use std::path::{Path, PathBuf};

use flyrig_types::{Intrinsics, Isometry, Lens};
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::error::CalibError;

/// Largest entry of `RᵀR - 1` that is attributed to rounding in a text file.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Builds the error of a faulty file.
pub(super) fn bad(path: &Path, problem: impl Into<String>) -> CalibError {
    CalibError::Format { path: path.to_owned(), problem: problem.into() }
}

/// Returns the first of the names that a folder contains, or the file itself.
pub(super) fn inside(path: &Path, names: &[&str]) -> PathBuf {
    if !path.is_dir() {
        return path.to_owned();
    }
    let known = names.iter().map(|name| path.join(name)).find(|file| file.is_file());
    known.unwrap_or_else(|| path.join(names.first().copied().unwrap_or_default()))
}

/// Lists the files of a folder with this ending, sorted.
pub(super) fn files_with(dir: &Path, ending: &str) -> Result<Vec<PathBuf>, CalibError> {
    let refused = |source| CalibError::Read { path: dir.to_owned(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(refused)? {
        let path = entry.map_err(refused)?.path();
        if path.is_file() && path.to_string_lossy().to_lowercase().ends_with(ending) {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Returns the file itself, or the folder's only file with that ending.
pub(super) fn one_file(path: &Path, ending: &str) -> Result<PathBuf, CalibError> {
    if !path.is_dir() {
        return Ok(path.to_owned());
    }
    let mut files = files_with(path, ending)?;
    match (files.pop(), files.is_empty()) {
        (Some(file), true) => Ok(file),
        (Some(_), false) => Err(bad(path, format!("holds several *{ending}; name one"))),
        (None, _) => Err(bad(path, format!("holds no *{ending}; name the file"))),
    }
}

/// Parts of keys that speak of a lens, axes, units or orientation.
const SPEAKING_PARTS: [&str; 34] = [
    "distort",
    "fisheye",
    "lens",
    "model",
    "projection",
    "omni",
    "equirect",
    "latlong",
    "ftheta",
    "theta",
    "shutter",
    "skew",
    "mirror",
    "flip",
    "axes",
    "axis",
    "handed",
    "coord",
    "convention",
    "unit",
    "orient",
    "rotate",
    "rotation",
    "extrinsic",
    "transform",
    "pose",
    "crop",
    "binning",
    "fov",
    "rectif",
    "line_delay",
    "polynom",
    "prism",
    "tilt",
];
/// Whole keys that do.
const SPEAKING_WORDS: [&str; 14] =
    ["up", "xi", "scale", "alpha", "beta", "gamma", "k1", "k2", "k3", "k4", "k5", "k6", "from_na", "normal_mts_args"];

/// Refuses keys that speak of a lens, axes, units or orientation and are not among the `known` ones of a reader: a default in their
/// place would be wrong without a word. Other unknown keys are ignored.
pub(crate) fn refuse_unknown<'a>(keys: impl IntoIterator<Item = &'a str>, known: &[&str]) -> Result<(), String> {
    let speaks = |key: &str| {
        let key = key.to_lowercase();
        let is_statistic = ["error", "residual", "path", "name"].iter().any(|part| key.contains(part));
        !is_statistic
            && (key.starts_with("t_")
                || SPEAKING_WORDS.contains(&key.as_str())
                || SPEAKING_PARTS.iter().any(|part| key.contains(part)))
    };
    match keys.into_iter().find(|key| !known.contains(key) && speaks(key)) {
        Some(key) => Err(format!(
            "key {key:?} is not understood, and may change lens, axes or units; take it out if it changes none of them"
        )),
        None => Ok(()),
    }
}

/// Reads a rotation matrix; the error text describes its fault.
pub(crate) fn rotation_of(matrix: DMat3) -> Result<DQuat, String> {
    let excess = matrix.transpose() * matrix - DMat3::IDENTITY;
    let deviation = excess.to_cols_array().into_iter().fold(0.0, |worst: f64, value| worst.max(value.abs()));
    // Written so that NaN is refused too: entries near the largest double overflow the product.
    let is_rotation = deviation <= ROTATION_TOLERANCE && matrix.determinant() > 0.0;
    if !is_rotation {
        let determinant = matrix.determinant();
        return Err(format!("is no rotation (determinant {determinant:.4}, columns {deviation:.2e} from orthonormal)"));
    }
    Ok(DQuat::from_mat3(&matrix).normalize())
}

/// Returns the lens of OpenCV's coefficients k1 k2 p1 p2 k3 k4 k5 k6, as many as there are; those of prisms and tilted
/// sensors must be 0.
pub(crate) fn opencv_lens(coefficients: &[f64]) -> Result<Lens, String> {
    if ![0, 4, 5, 8, 12, 14].contains(&coefficients.len()) {
        return Err(format!("{} distortion coefficients, expected 0, 4, 5, 8, 12 or 14", coefficients.len()));
    }
    let mut c = [0.0; 14];
    c[..coefficients.len()].copy_from_slice(coefficients);
    if let Some((i, value)) = c.iter().enumerate().skip(8).find(|(_, value)| **value != 0.0) {
        return Err(format!(
            "distortion coefficient {} = {value} of the prism or tilt model; calibrate without it",
            i + 1
        ));
    }
    let tangential = [c[2], c[3]];
    if c[5..8].iter().all(|k| *k == 0.0) {
        return Ok(Lens::RadialTangential { radial: [c[0], c[1], c[4]], tangential });
    }
    Ok(Lens::Rational { radial: [c[0], c[1], c[4], c[5], c[6], c[7]], tangential })
}

/// Returns the fisheye of OpenCV's coefficients k1 to k4 of the angle; a fifth, as some programs write, must be 0.
pub(crate) fn fisheye_lens(coefficients: &[f64]) -> Result<Lens, String> {
    match *coefficients {
        [k1, k2, k3, k4] | [k1, k2, k3, k4, 0.0] => Ok(Lens::Fisheye { coefficients: [k1, k2, k3, k4] }),
        ref other => Err(format!("{} coefficients of a fisheye, expected 4", other.len())),
    }
}

/// Returns the lens of a distortion model by its name in ROS, Kalibr and their kin.
pub(crate) fn named_lens(model: &str, coefficients: &[f64]) -> Result<Lens, String> {
    match model.trim().to_lowercase().replace('-', "_").as_str() {
        "plumb_bob"
        | "rational_polynomial"
        | "radtan"
        | "radial_tangential"
        | "brown_conrady"
        | "opencv"
        | "pinhole"
        | "perspective" => opencv_lens(coefficients),
        "equidistant" | "fisheye" | "kannala_brandt" | "kannala_brandt4" | "opencv_fisheye" => {
            fisheye_lens(coefficients)
        }
        "none" if coefficients.iter().all(|value| *value == 0.0) => Ok(Lens::PINHOLE),
        _ => Err(format!(
            "model {:?} with {} coefficients is not supported; calibrate with plumb_bob, rational_polynomial or equidistant",
            model.chars().take(100).collect::<String>(),
            coefficients.len()
        )),
    }
}

/// Returns OpenCV's coefficients of a lens, 5 or 8; `None` for a fisheye.
pub(crate) fn opencv_coefficients(lens: &Lens) -> Option<Vec<f64>> {
    let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = lens.rational()?;
    let plain = vec![k1, k2, p1, p2, k3];
    Some(if matches!(lens, Lens::Rational { .. }) { [plain, vec![k4, k5, k6]].concat() } else { plain })
}

/// Returns focal lengths and principal point of a matrix [fx 0 cx; 0 fy cy; 0 0 1], row by row; a skew of a hundredth of a pixel has no
/// measurable effect.
pub(super) fn camera_matrix(rows: &[f64]) -> Result<(DVec2, DVec2), String> {
    match *rows {
        [fx, skew, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] if skew.abs() <= 0.01 => {
            Ok((DVec2::new(fx, fy), DVec2::new(cx, cy)))
        }
        [_, skew, _, _, _, _, _, _, _] => Err(format!(
            "has skew {skew} or an unusual shape, expected [fx 0 cx; 0 fy cy; 0 0 1]; calibrate without skew"
        )),
        _ => Err("is not 3x3; export the camera again".to_owned()),
    }
}

/// Builds intrinsics of a size in whole pixels; other sizes are left for the check of the camera.
pub(super) fn intrinsics([width, height]: [f64; 2], focal_px: DVec2, center_px: DVec2, lens: Lens) -> Intrinsics {
    let side = |value: f64| if value.fract() == 0.0 { value as u32 } else { 0 };
    Intrinsics { width: side(width), height: side(height), focal_px, center_px, lens }
}

/// Returns rotation and translation as a 4x4 matrix, row by row.
pub(super) fn rows4(isometry: &Isometry) -> [[f64; 4]; 4] {
    let r = DMat3::from_quat(isometry.rotation).transpose().to_cols_array_2d();
    let t = isometry.translation.to_array();
    let row = |i: usize| [r[i][0], r[i][1], r[i][2], t[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

/// Reads a rigid motion from a 3x4 or 4x4 matrix, row by row.
pub(super) fn motion_of(rows: &[Vec<f64>]) -> Result<Isometry, String> {
    let is_motion =
        matches!(rows.len(), 3 | 4) && rows.iter().all(|row| row.len() == 4 && row.iter().all(|v| v.is_finite()));
    if !is_motion {
        return Err("is no 4x4 matrix of finite numbers".to_owned());
    }
    let matrix = DMat3::from_cols_array_2d(&[0, 1, 2].map(|i| [rows[i][0], rows[i][1], rows[i][2]])).transpose();
    Ok(Isometry::new(rotation_of(matrix)?, DVec3::new(rows[0][3], rows[1][3], rows[2][3])))
}
