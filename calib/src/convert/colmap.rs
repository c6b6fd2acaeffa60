//! COLMAP's models, as text (`cameras.txt`, `images.txt`) and binary (`cameras.bin`, `images.bin`), with any number of images of each
//! camera. The rigs and frames of COLMAP 3.12 need not be read: images keep their own poses.
//!
//! COLMAP puts the centre of the first pixel at (0.5, 0.5): half a pixel is subtracted from its principal point.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    path::{Path, PathBuf},
};

use flyrig_types::{Intrinsics, Isometry, Rig, read_text_up_to};

use super::{
    colmap_binary,
    colmap_models::{lens, model, named, pose, shot},
    image_names::Shot,
    imported::{Imported, ImportedCamera},
    shared::bad,
};
use crate::calibration_file;
use crate::error::CalibError;

pub(super) const CAMERAS: &str = "cameras.txt";
const IMAGES: &str = "images.txt";
/// Largest text of images: it lists all their points.
const MAX_IMAGES_BYTES: u64 = 512 << 20;
/// Largest difference of a number that was written as text, relative to 1 or to the number.
const TEXT_TOLERANCE: f64 = 1e-6;
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
