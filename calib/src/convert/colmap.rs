//! COLMAP's models, as text (`cameras.txt`, `images.txt`) and binary (`cameras.bin`, `images.bin`), with any number of images of each
//! camera. The rigs and frames of COLMAP 3.12 need not be read: images keep their own poses.
//!
//! COLMAP puts the centre of the first pixel at (0.5, 0.5): half a pixel is subtracted from its principal point.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    path::{Path, PathBuf},
};

use flyrig_types::{Camera, Intrinsics, Isometry, Lens, Rig, read_text_up_to};
use glam::{DQuat, DVec2, DVec3};

use super::{
    colmap_binary,
    image_names::{Shot, name_cameras},
    imported::{Imported, ImportedCamera},
    shared::{bad, fisheye_lens, intrinsics, opencv_lens},
};
use crate::calibration_file;
use crate::error::CalibError;

pub(super) const CAMERAS: &str = "cameras.txt";
const IMAGES: &str = "images.txt";
/// Largest text of images: it lists all their points.
const MAX_IMAGES_BYTES: u64 = 512 << 20;
/// Largest difference of a number that was written as text, relative to 1 or to the number.
const TEXT_TOLERANCE: f64 = 1e-6;
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

/// Returns the folder of the model: the folder itself, or `sparse/0` or `sparse` of a workspace with one model.
pub(super) fn model_folder(dir: &Path) -> Option<PathBuf> {
    let is_model = |dir: &PathBuf| dir.join(CAMERAS).is_file() || dir.join(colmap_binary::CAMERAS).is_file();
    let several = dir.join("sparse/1").is_dir();
    [dir.to_owned(), dir.join("sparse/0"), dir.join("sparse")]
        .into_iter()
        .find(is_model)
        .filter(|found| !several || found == dir)
}

pub(super) fn read(dir: &Path) -> Result<Imported, CalibError> {
    let dir = model_folder(dir).unwrap_or_else(|| dir.to_owned());
    let text = || read_text(&dir);
    let binary = || colmap_binary::read(&dir);
    let cameras = match (dir.join(CAMERAS).is_file(), dir.join(colmap_binary::CAMERAS).is_file()) {
        (true, true) => {
            let (text, binary) = (text()?, binary()?);
            if !agree(&text, &binary) {
                return Err(bad(&dir, "holds a model as text and another one as *.bin; take the older one out"));
            }
            binary
        }
        (false, true) => binary()?,
        (_, false) => text()?,
    };
    Ok(Imported::new(cameras, None))
}

/// Returns whether cameras are the same up to the rounding of text.
fn agree(a: &[ImportedCamera], b: &[ImportedCamera]) -> bool {
    let numbers = |camera: &ImportedCamera| {
        let i = &camera.intrinsics;
        let pose = camera.pose.unwrap_or(Isometry::IDENTITY);
        // A quaternion and its negative turn alike.
        let q = pose.rotation * pose.rotation.w.signum();
        let mut all =
            vec![f64::from(i.width), f64::from(i.height), i.focal_px.x, i.focal_px.y, i.center_px.x, i.center_px.y];
        all.extend(i.lens.coefficients());
        all.extend([q.x, q.y, q.z, q.w].into_iter().chain(pose.translation.to_array()));
        all
    };
    let is_same = |(a, b): (&ImportedCamera, &ImportedCamera)| {
        let (x, y) = (numbers(a), numbers(b));
        let is_near = |(x, y): (&f64, &f64)| (x - y).abs() <= TEXT_TOLERANCE * x.abs().max(1.0);
        a.id == b.id && x.len() == y.len() && x.iter().zip(&y).all(is_near)
    };
    a.len() == b.len() && a.iter().zip(b).all(is_same)
}

fn read_text(dir: &Path) -> Result<Vec<ImportedCamera>, CalibError> {
    let cameras_path = dir.join(CAMERAS);
    let mut lenses = BTreeMap::new();
    for (number, line) in content(&calibration_file::read(&cameras_path)?) {
        let refused = |problem: String| bad(&cameras_path, format!("line {number}: {problem}"));
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [id, model, width, height, parameters @ ..] = fields.as_slice() else {
            return Err(refused("expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS".to_owned()));
        };
        let read = || lens(model, &numbers(&[*width, *height])?, &numbers(parameters)?);
        if lenses.insert((*id).to_owned(), read().map_err(refused)?).is_some() {
            return Err(refused(format!("camera {id} is there twice; take one out")));
        }
    }
    let images_path = dir.join(IMAGES);
    let text = read_text_up_to(&images_path, MAX_IMAGES_BYTES)
        .map_err(|source| calibration_file::read_error(&images_path, source))?;
    let mut shots = Vec::new();
    let mut is_points = false;
    for (number, line) in text.lines().enumerate().map(|(i, line)| (i + 1, line.trim())) {
        if line.starts_with('#') {
            continue;
        }
        let place = format!("line {number}");
        // The second line of an image lists its points, and may be empty.
        if std::mem::take(&mut is_points) {
            let is_list = line.split_whitespace().count() % 3 == 0
                && line.split_whitespace().next_back().is_none_or(|id| id.parse::<i64>().is_ok());
            if !is_list {
                let expected = "expected the points of the image above as X Y POINT3D_ID, or an empty line";
                return Err(bad(&images_path, format!("{place}: {expected}; export the model again")));
            }
            continue;
        }
        if line.is_empty() {
            continue;
        }
        is_points = true;
        shots.push(
            image(line, &lenses, place.clone()).map_err(|problem| bad(&images_path, format!("{place}: {problem}")))?,
        );
    }
    named(&images_path, shots)
}

/// Returns the cameras of images, sorted by name.
pub(super) fn named(path: &Path, shots: Vec<Shot>) -> Result<Vec<ImportedCamera>, CalibError> {
    let mut cameras = name_cameras(shots).map_err(|problem| bad(path, problem))?;
    cameras.sort_by(|a, b| a.id.cmp(&b.id));
    Ok(cameras)
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

fn image(line: &str, lenses: &BTreeMap<String, Intrinsics>, place: String) -> Result<Shot, String> {
    let mut fields = Vec::new();
    let mut name = line;
    for _ in 0..9 {
        let (field, rest) =
            name.split_once(char::is_whitespace).ok_or("expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")?;
        fields.push(field);
        name = rest.trim_start();
    }
    let pose = numbers(&fields[1..8])?;
    let intrinsics = lenses.get(fields[8]).ok_or_else(|| format!("camera {} is not in {CAMERAS}", fields[8]))?;
    shot(name, place, *intrinsics, &pose)
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

/// Returns the files of a model, text and binary: COLMAP's own programs prefer the second, people the first.
pub(super) fn files(rig: &Rig) -> Vec<(String, Vec<u8>)> {
    let mut cameras = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
    let mut images =
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n".to_owned();
    let words = |numbers: &[f64]| numbers.iter().map(|value| format!("{value:?}")).collect::<Vec<_>>().join(" ");
    for (number, camera) in rig.cameras.iter().enumerate().map(|(i, camera)| (i + 1, camera)) {
        let i = &camera.intrinsics;
        let (model, parameters) = model(i);
        let _ = writeln!(cameras, "{number} {model} {} {} {}", i.width, i.height, words(&parameters));
        let _ = writeln!(images, "{number} {} {number} {}.png\n", words(&pose(camera)), camera.id);
    }
    let points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n".to_owned();
    let text =
        [(CAMERAS, cameras), (IMAGES, images), ("points3D.txt", points)].map(|(name, text)| (name, text.into_bytes()));
    let all = text.into_iter().chain(colmap_binary::files(rig));
    all.map(|(name, bytes)| (name.to_owned(), bytes)).collect()
}
