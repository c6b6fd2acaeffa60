//! COLMAP's text model: `cameras.txt` and `images.txt`, one image per camera.
//!
//! COLMAP puts the centre of the first pixel at (0.5, 0.5): half a pixel is subtracted from its principal point.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    path::{Path, PathBuf},
};

use flyrig_types::{Intrinsics, Isometry, Lens, Rig};
use glam::{DQuat, DVec2, DVec3};

use super::{
    imported::{Imported, ImportedCamera},
    shared::{bad, camera_of_image, intrinsics},
};
use crate::calibration_file;
use crate::error::CalibError;

pub(super) const CAMERAS: &str = "cameras.txt";
const IMAGES: &str = "images.txt";
/// Largest difference between the poses of one camera in two images, units of the file and radians.
const SAME_POSE: f64 = 1e-6;

pub(super) fn read(dir: &Path) -> Result<Imported, CalibError> {
    let cameras_path = dir.join(CAMERAS);
    if !cameras_path.exists() && dir.join("cameras.bin").exists() {
        return Err(bad(dir, "is a binary model; convert it with colmap model_converter --output_type TXT"));
    }
    let mut lenses = BTreeMap::new();
    for (number, line) in content(&calibration_file::read(&cameras_path)?) {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let lens = lens(&fields).map_err(|problem| bad(&cameras_path, format!("line {number}: {problem}")))?;
        lenses.insert(fields[0].to_owned(), lens);
    }
    let images_path = dir.join(IMAGES);
    let text = calibration_file::read(&images_path)?;
    let mut cameras: Vec<ImportedCamera> = Vec::new();
    let mut is_points = false;
    for (number, line) in text.lines().enumerate().map(|(i, line)| (i + 1, line.trim())) {
        if line.starts_with('#') {
            continue;
        }
        // The second line of an image lists its points, and may be empty.
        if std::mem::take(&mut is_points) {
            continue;
        }
        if line.is_empty() {
            continue;
        }
        is_points = true;
        let camera = image(line, &lenses).map_err(|problem| bad(&images_path, format!("line {number}: {problem}")))?;
        let Some(known) = cameras.iter().find(|known| known.id == camera.id) else {
            cameras.push(camera);
            continue;
        };
        if !same_pose(known, &camera) {
            let problem = format!("line {number}: camera {} has two poses; give one image of each camera", camera.id);
            return Err(bad(&images_path, problem));
        }
    }
    cameras.sort_by(|a, b| a.id.cmp(&b.id));
    Ok(Imported { cameras, up: None })
}

pub(super) fn same_pose(a: &ImportedCamera, b: &ImportedCamera) -> bool {
    match (a.pose, b.pose) {
        (Some(a), Some(b)) => {
            a.rotation.angle_between(b.rotation) < SAME_POSE && a.translation.distance(b.translation) < SAME_POSE
        }
        _ => false,
    }
}

fn content(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

fn numbers(fields: &[&str]) -> Result<Vec<f64>, String> {
    let number = |text: &&str| {
        let value: Option<f64> = text.parse().ok().filter(|value: &f64| value.is_finite());
        value.ok_or_else(|| format!("{text:?} is no number; export the model again"))
    };
    fields.iter().map(number).collect()
}

fn lens(fields: &[&str]) -> Result<Intrinsics, String> {
    let [_, model, width, height, parameters @ ..] = fields else {
        return Err("expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS".to_owned());
    };
    let size = numbers(&[*width, *height])?;
    let parameters = numbers(parameters)?;
    let plain = |radial, tangential| Lens::RadialTangential { radial, tangential };
    let (focal, center, lens) = match (*model, parameters.as_slice()) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], Lens::PINHOLE),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Lens::PINHOLE),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], plain([k, 0.0, 0.0], [0.0; 2])),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], plain([k1, k2, 0.0], [0.0; 2])),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], plain([k1, k2, 0.0], [p1, p2])),
        ("FULL_OPENCV", &[fx, fy, cx, cy, ref rest @ ..]) if rest.len() == 8 => {
            ([fx, fy], [cx, cy], super::shared::opencv_lens(rest)?)
        }
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
            ([fx, fy], [cx, cy], Lens::Fisheye { coefficients: [k1, k2, k3, k4] })
        }
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => {
            ([f, f], [cx, cy], Lens::Fisheye { coefficients: [k, 0.0, 0.0, 0.0] })
        }
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => {
            ([f, f], [cx, cy], Lens::Fisheye { coefficients: [k1, k2, 0.0, 0.0] })
        }
        (model, parameters) => {
            return Err(format!(
                "camera model {model} with {} parameters is not supported; use OPENCV, FULL_OPENCV or OPENCV_FISHEYE",
                parameters.len()
            ));
        }
    };
    Ok(intrinsics([size[0], size[1]], DVec2::from(focal), DVec2::from(center) - 0.5, lens))
}

fn image(line: &str, lenses: &BTreeMap<String, Intrinsics>) -> Result<ImportedCamera, String> {
    let fields: Vec<&str> = line.split_whitespace().collect();
    let [_, pose @ .., camera, name] = fields.as_slice() else {
        return Err("expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME".to_owned());
    };
    let &[w, x, y, z, tx, ty, tz] = numbers(pose)?.as_slice() else {
        return Err("expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, without spaces in the name".to_owned());
    };
    let rotation = DQuat::from_xyzw(x, y, z, w);
    if (rotation.length() - 1.0).abs() > 1e-3 {
        return Err(format!("the quaternion has length {:.4}, expected 1", rotation.length()));
    }
    let intrinsics = lenses.get(*camera).ok_or_else(|| format!("camera {camera} is not in {CAMERAS}"))?;
    Ok(ImportedCamera {
        id: camera_of_image(name),
        intrinsics: *intrinsics,
        pose: Some(Isometry::new(rotation.normalize(), DVec3::new(tx, ty, tz))),
        time_offset_nanos: 0,
        color: Default::default(),
    })
}

pub(super) fn files(rig: &Rig) -> Vec<(String, String)> {
    let mut cameras = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
    let mut images =
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n".to_owned();
    for (number, camera) in rig.cameras.iter().enumerate().map(|(i, camera)| (i + 1, camera)) {
        let i = &camera.intrinsics;
        let (model, coefficients) = match i.lens {
            Lens::RadialTangential { radial: [k1, k2, 0.0], tangential: [p1, p2] } => ("OPENCV", vec![k1, k2, p1, p2]),
            Lens::Fisheye { coefficients } => ("OPENCV_FISHEYE", coefficients.to_vec()),
            lens => {
                let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = lens.rational().unwrap_or_default();
                ("FULL_OPENCV", vec![k1, k2, p1, p2, k3, k4, k5, k6])
            }
        };
        let center = i.center_px + 0.5;
        let parameters = [vec![i.focal_px.x, i.focal_px.y, center.x, center.y], coefficients].concat();
        let parameters: Vec<String> = parameters.iter().map(|value| format!("{value:?}")).collect();
        let _ = writeln!(cameras, "{number} {model} {} {} {}", i.width, i.height, parameters.join(" "));
        let (q, t) = (camera.camera_from_world.rotation, camera.camera_from_world.translation);
        let _ = writeln!(
            images,
            "{number} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {number} {}.png\n",
            q.w, q.x, q.y, q.z, t.x, t.y, t.z, camera.id
        );
    }
    let points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n".to_owned();
    let named =
        [(PathBuf::from(CAMERAS), cameras), (PathBuf::from(IMAGES), images), (PathBuf::from("points3D.txt"), points)];
    named.into_iter().map(|(name, text)| (name.to_string_lossy().into_owned(), text)).collect()
}
