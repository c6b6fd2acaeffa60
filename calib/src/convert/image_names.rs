//! Names of cameras from the paths of their images.
//!
//! Programs that calibrate from images know no cameras, only images: one folder a camera, one folder for the images of all cameras,
//! or one folder an instant. The path tells which, together with the poses: a camera has one.

use std::collections::{BTreeMap, BTreeSet};

use flyrig_types::CameraId;

use super::imported::ImportedCamera;

/// Largest difference between the poses of one camera in two images, units of the file and radians.
const SAME_POSE: f64 = 1e-6;
/// Most levels of folders above an image that may name its camera.
const MOST_LEVELS: usize = 8;
/// Beginnings of names that folders have for what is in them, not for their camera.
const COMMON: [&str; 17] = [
    "image",
    "img",
    "rgb",
    "color",
    "colour",
    "frame",
    "photo",
    "picture",
    "undistort",
    "input",
    "train",
    "test",
    "val",
    "data",
    "png",
    "jp",
    "..",
];

/// Image with the lens and pose of the camera that took it.
pub(super) struct Shot {
    /// Path of the image.
    pub image: String,
    /// Place in the file, for errors.
    pub place: String,
    /// The camera; its name is not known yet.
    pub camera: ImportedCamera,
}

/// Names the cameras of images by the first part of their paths that tells them apart, such that all images of a name have one pose
/// and one lens: the folder of an image or the image itself (first where folders have common names, or are one), then the folders
/// above. The error text names the image that contradicts.
pub(super) fn name_cameras(shots: Vec<Shot>) -> Result<Vec<ImportedCamera>, String> {
    let paths: Vec<Vec<&str>> = shots.iter().map(|shot| parts(&shot.image)).collect();
    let folder = |path: &Vec<&str>| path.iter().rev().nth(1).copied().unwrap_or_default().to_lowercase();
    let is_common = paths.iter().map(folder).all(|name| COMMON.iter().any(|common| name.starts_with(common)));
    let levels = if is_common { [0, 1] } else { [1, 0] };
    let mut problem = None;
    for level in levels.into_iter().chain(2..MOST_LEVELS) {
        let Some(names) = paths.iter().map(|path| name(path, level)).collect::<Option<Vec<_>>>() else { continue };
        match chosen(&shots, &names) {
            Ok(_) if level == 0 && !is_common && !are_cameras(&shots, &paths) => {}
            Ok(first) => {
                let mut shots: Vec<Option<Shot>> = shots.into_iter().map(Some).collect();
                let named = |index: usize| {
                    let camera = shots[index].take()?.camera;
                    Some(ImportedCamera { id: CameraId::from(names[index].as_str()), ..camera })
                };
                return Ok(first.into_iter().filter_map(named).collect());
            }
            Err(text) => drop(problem.get_or_insert(text)),
        }
    }
    Err(problem.unwrap_or_default())
}

fn parts(path: &str) -> Vec<&str> {
    path.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".").collect()
}

/// Returns the part of a path that many levels above the image, or the image's own name where it lies in no folder.
fn name(path: &[&str], level: usize) -> Option<String> {
    let stem = |file: &str| file.rsplit_once('.').map_or(file, |(stem, _)| stem).to_owned();
    match path.iter().rev().nth(level) {
        Some(part) => Some(if level == 0 { stem(part) } else { (*part).to_owned() }),
        None if level <= 1 => Some(path.last().map(|file| stem(file)).unwrap_or_default()),
        None => None,
    }
}

/// Returns the first image of each name, in the order of the file.
fn chosen(shots: &[Shot], names: &[String]) -> Result<Vec<usize>, String> {
    let mut first: BTreeMap<&str, usize> = BTreeMap::new();
    let mut order = Vec::new();
    for (index, (shot, name)) in shots.iter().zip(names).enumerate() {
        let Some(&known) = first.get(name.as_str()) else {
            first.insert(name, index);
            order.push(index);
            continue;
        };
        let known = &shots[known].camera;
        let contradicts =
            |what: &str| Err(format!("{}: camera {name} has two {what}; give one image of each camera", shot.place));
        if !same_pose(known, &shot.camera) {
            return contradicts("poses");
        }
        if known.intrinsics != shot.camera.intrinsics {
            return contradicts("lenses");
        }
    }
    Ok(order)
}

/// Returns whether images of different names in folders of uncommon names are cameras, not instants of a camera that was moved: in one
/// folder they are named by words, or have lenses of their own; in several, each camera comes again.
fn are_cameras(shots: &[Shot], paths: &[Vec<&str>]) -> bool {
    let folder = |path: &Vec<&str>| name(path, 1).unwrap_or_default();
    let stem = |path: &Vec<&str>| name(path, 0).unwrap_or_default();
    let folders: BTreeSet<String> = paths.iter().map(folder).collect();
    let stems: BTreeSet<String> = paths.iter().map(stem).collect();
    if folders.len() > 1 {
        return stems.len() < shots.len();
    }
    let is_number = |stem: &String| stem.chars().all(|c| c.is_ascii_digit());
    let has_own_lens = shots.windows(2).any(|pair| pair[0].camera.intrinsics != pair[1].camera.intrinsics);
    has_own_lens || !stems.iter().all(is_number)
}

fn same_pose(a: &ImportedCamera, b: &ImportedCamera) -> bool {
    match (a.pose, b.pose) {
        (Some(a), Some(b)) => {
            a.rotation.angle_between(b.rotation) < SAME_POSE && a.translation.distance(b.translation) < SAME_POSE
        }
        _ => false,
    }
}
