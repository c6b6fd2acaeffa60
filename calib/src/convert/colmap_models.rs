//! Lenses and images of COLMAP's models, in text and binary.

use std::path::Path;

use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3};

use super::{
    image_names::{Shot, name_cameras},
    imported::ImportedCamera,
    shared::{bad, fisheye_lens, intrinsics, opencv_lens},
};
use crate::error::CalibError;

/// Camera models and their numbers of parameters, by their number in binary models.
pub(super) const MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];

/// Returns the cameras of images, sorted by name.
pub(super) fn named(path: &Path, shots: Vec<Shot>) -> Result<Vec<ImportedCamera>, CalibError> {
    let mut cameras = name_cameras(shots).map_err(|problem| bad(path, problem))?;
    cameras.sort_by(|a, b| a.id.cmp(&b.id));
    Ok(cameras)
}

/// Returns the intrinsics of a camera model.
pub(super) fn lens(model: &str, size: &[f64], parameters: &[f64]) -> Result<Intrinsics, String> {
    let plain = |radial, tangential| Lens::RadialTangential { radial, tangential };
    let fisheye = |coefficients| Lens::Fisheye { coefficients };
    let (focal, center, lens) = match (model, parameters) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], Lens::PINHOLE),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Lens::PINHOLE),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], plain([k, 0.0, 0.0], [0.0; 2])),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], plain([k1, k2, 0.0], [0.0; 2])),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], plain([k1, k2, 0.0], [p1, p2])),
        ("FULL_OPENCV", &[fx, fy, cx, cy, ref rest @ ..]) if rest.len() == 8 => {
            ([fx, fy], [cx, cy], opencv_lens(rest)?)
        }
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, ref rest @ ..]) if rest.len() == 4 => {
            ([fx, fy], [cx, cy], fisheye_lens(rest)?)
        }
        ("SIMPLE_FISHEYE", &[f, cx, cy]) => ([f, f], [cx, cy], fisheye([0.0; 4])),
        ("FISHEYE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], fisheye([0.0; 4])),
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => ([f, f], [cx, cy], fisheye([k, 0.0, 0.0, 0.0])),
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], fisheye([k1, k2, 0.0, 0.0])),
        // Without tangential distortion and prism it is OpenCV's.
        ("THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k1, k2, 0.0, 0.0, k3, k4, 0.0, 0.0]) => {
            ([fx, fy], [cx, cy], fisheye([k1, k2, k3, k4]))
        }
        (model, parameters) => {
            return Err(format!(
                "camera model {model} with {} parameters is not supported; use OPENCV, FULL_OPENCV or OPENCV_FISHEYE",
                parameters.len()
            ));
        }
    };
    let &[width, height] = size else { return Err("the image has no width and height".to_owned()) };
    Ok(intrinsics([width, height], DVec2::from(focal), DVec2::from(center) - 0.5, lens))
}

/// Returns an image; `pose` is qw qx qy qz tx ty tz.
pub(super) fn shot(name: &str, place: String, intrinsics: Intrinsics, pose: &[f64]) -> Result<Shot, String> {
    let &[w, x, y, z, tx, ty, tz] = pose else { return Err("the pose is not seven numbers".to_owned()) };
    let rotation = DQuat::from_xyzw(x, y, z, w);
    // Written so that NaN is refused too.
    let is_unit = (rotation.length() - 1.0).abs() <= 1e-3;
    if !is_unit {
        return Err(format!("the quaternion has length {:.4}, expected 1", rotation.length()));
    }
    let pose = Isometry::new(rotation.normalize(), DVec3::new(tx, ty, tz));
    Ok(Shot { image: name.to_owned(), place, camera: ImportedCamera::unnamed(intrinsics, Some(pose)) })
}

/// Returns the model of a lens and its parameters.
pub(super) fn model(i: &Intrinsics) -> (&'static str, Vec<f64>) {
    let (model, coefficients) = match i.lens {
        Lens::RadialTangential { radial: [k1, k2, 0.0], tangential: [p1, p2] } => ("OPENCV", vec![k1, k2, p1, p2]),
        Lens::Fisheye { coefficients } => ("OPENCV_FISHEYE", coefficients.to_vec()),
        lens => {
            let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = lens.rational().unwrap_or_default();
            ("FULL_OPENCV", vec![k1, k2, p1, p2, k3, k4, k5, k6])
        }
    };
    let center = i.center_px + 0.5;
    (model, [vec![i.focal_px.x, i.focal_px.y, center.x, center.y], coefficients].concat())
}

/// Returns the pose of a camera as qw qx qy qz tx ty tz.
pub(super) fn pose(camera: &Camera) -> [f64; 7] {
    let (q, t) = (camera.camera_from_world.rotation, camera.camera_from_world.translation);
    [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
}
