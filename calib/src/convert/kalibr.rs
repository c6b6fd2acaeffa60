//! Kalibr: `camchain.yaml`, and its names with the recording in them. Poses form a chain, `T_cn_cnm1` takes points from the camera
//! before; where it is missing, `T_cam_imu` (or OpenVINS' inverse, `T_imu_cam`) places the cameras. The world is cam0.
//!
//! Kalibr numbers its cameras; their names are read from and written to `rostopic`. `timeshift_cam_imu` gives time
//! offsets: `t_imu = t_cam + shift`.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    path::Path,
};

use flyrig_types::{CameraId, Isometry, Lens, Rig};
use glam::DVec2;

use super::{
    imported::{Imported, ImportedCamera},
    shared::{bad, intrinsics, motion_of, named_lens, refuse_unknown, rows4},
};
use crate::error::CalibError;
use crate::yaml::parse_tree;
use crate::yaml_value::{Map, Value};

pub(super) const FILE: &str = "camchain.yaml";
/// Keys of a camera that are understood, or change nothing.
const KEYS: [&str; 10] = [
    "camera_model",
    "intrinsics",
    "distortion_model",
    "distortion_coeffs",
    "resolution",
    "rostopic",
    "T_cn_cnm1",
    "T_cam_imu",
    "T_imu_cam",
    "timeshift_cam_imu",
];

/// Returns whether a text is a chain of cameras.
pub(super) fn is_chain(text: &str) -> bool {
    let key = |line: &str| line.trim_start_matches(['{', ' ']).replace(['"', '\''], "").starts_with("cam0:");
    text.lines().any(key)
}

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let root = parse_tree(path)?;
    let number = |key: &str| key.strip_prefix("cam").and_then(|number| number.parse::<usize>().ok());
    let nodes: BTreeMap<usize, &Map> = root
        .iter()
        .filter_map(|(key, value)| match value {
            Value::Map(node) => Some((number(key)?, node)),
            _ => None,
        })
        .collect();
    refuse_unknown(root.keys().map(String::as_str), &[]).map_err(|problem| bad(path, problem))?;
    let mut cameras: Vec<ImportedCamera> = Vec::new();
    let mut first = None;
    let topics: Vec<&str> =
        nodes.values().map(|node| node.get("rostopic").and_then(Value::word).unwrap_or_default()).collect();
    let names = names(&topics);
    for (expected, (&number, &node)) in nodes.iter().enumerate() {
        let named = |problem: String| bad(path, format!("cam{number}: {problem}"));
        if number != expected {
            return Err(named(format!("cam{expected} is missing before it; number the cameras from cam0")));
        }
        let reader = Reader { node };
        let first: &Reader<'_> = first.get_or_insert(Reader { node });
        let read = || -> Result<ImportedCamera, String> {
            Ok(ImportedCamera {
                id: CameraId::from(names[number].as_str()),
                pose: reader.pose(first, cameras.last())?,
                time_offset_nanos: ((first.shift(&nodes)? - reader.shift(&nodes)?) * 1e9).round() as i64,
                ..reader.lens()?
            })
        };
        cameras.push(read().map_err(named)?);
    }
    // One camera alone was calibrated for its lens.
    if let [only] = cameras.as_mut_slice() {
        only.pose = None;
    }
    Ok(Imported::new(cameras, None))
}

/// Returns names from the first part of the topics that tells all cameras apart, or else from all that differ; the numbers of the
/// cameras where topics are missing or alike.
fn names(topics: &[&str]) -> Vec<String> {
    let parts: Vec<Vec<&str>> =
        topics.iter().map(|topic| topic.split('/').filter(|part| !part.is_empty()).collect()).collect();
    let distinct = |names: &[String]| {
        let sorted: BTreeSet<&String> = names.iter().collect();
        sorted.len() == names.len() && names.iter().all(|name| !name.is_empty())
    };
    let most = parts.iter().map(Vec::len).max().unwrap_or(0);
    let at = |level: usize| {
        parts.iter().map(|parts| parts.get(level).copied().unwrap_or_default().to_owned()).collect::<Vec<_>>()
    };
    if let Some(names) = (0..most).map(at).find(|names| distinct(names)) {
        return names;
    }
    let differs = |level: &usize| at(*level).windows(2).any(|pair| pair[0] != pair[1]);
    let levels: Vec<usize> = (0..most).filter(differs).collect();
    let joined = |parts: &Vec<&str>| {
        let parts: Vec<&str> = levels.iter().filter_map(|level| parts.get(*level).copied()).collect();
        parts.join("_")
    };
    let names: Vec<String> = parts.iter().map(joined).collect();
    if distinct(&names) { names } else { (0..topics.len()).map(|number| format!("cam{number}")).collect() }
}

/// Camera of a chain.
struct Reader<'a> {
    node: &'a Map,
}

impl Reader<'_> {
    fn numbers(&self, key: &str) -> Result<Vec<f64>, String> {
        let found = self.node.get(key).and_then(Value::numbers);
        found.ok_or_else(|| format!("{key} is missing or no list of numbers"))
    }

    fn word(&self, key: &str) -> &str {
        self.node.get(key).and_then(Value::word).unwrap_or_default()
    }

    fn motion(&self, key: &str) -> Result<Option<Isometry>, String> {
        let Some(matrix) = self.node.get(key) else { return Ok(None) };
        let rows = matrix.rows().ok_or_else(|| format!("{key} is no matrix"))?;
        motion_of(&rows).map(Some).map_err(|problem| format!("{key} {problem}"))
    }

    fn camera_from_imu(&self) -> Result<Option<Isometry>, String> {
        let inverse = || Ok(self.motion("T_imu_cam")?.map(|motion| motion.inverse()));
        self.motion("T_cam_imu")?.map_or_else(inverse, |motion| Ok(Some(motion)))
    }

    /// Returns the pose relative to the first camera.
    fn pose(&self, first: &Reader<'_>, before: Option<&ImportedCamera>) -> Result<Option<Isometry>, String> {
        let Some(before) = before else { return Ok(Some(Isometry::IDENTITY)) };
        if let Some(step) = self.motion("T_cn_cnm1")? {
            return Ok(before.pose.map(|pose| step * pose));
        }
        match (self.camera_from_imu()?, first.camera_from_imu()?) {
            (Some(own), Some(first)) => Ok(Some(own * first.inverse())),
            _ => {
                Err("T_cn_cnm1 is missing, and T_cam_imu of it or of cam0 too; calibrate the cameras together"
                    .to_owned())
            }
        }
    }

    /// Returns the time shift, seconds: of all cameras or of none.
    fn shift(&self, nodes: &BTreeMap<usize, &Map>) -> Result<f64, String> {
        let key = "timeshift_cam_imu";
        match self.node.get(key) {
            Some(value) => {
                value.number().filter(|shift| shift.is_finite()).ok_or_else(|| format!("{key} is no number"))
            }
            None if nodes.values().any(|node| node.contains_key(key)) => {
                Err(format!("{key} is missing, but another camera has it; give it for all, or for none"))
            }
            None => Ok(0.0),
        }
    }

    fn lens(&self) -> Result<ImportedCamera, String> {
        let model = self.word("camera_model");
        if model != "pinhole" {
            return Err(format!(
                "camera_model {model:?} is not supported; calibrate with pinhole-radtan or pinhole-equi"
            ));
        }
        refuse_unknown(self.node.keys().map(String::as_str), &KEYS)?;
        let &[fx, fy, cx, cy] = self.numbers("intrinsics")?.as_slice() else {
            return Err("intrinsics are not fx fy cx cy".to_owned());
        };
        let model = self.word("distortion_model");
        let coefficients = match self.node.get("distortion_coeffs") {
            None if model == "none" => Vec::new(),
            _ => self.numbers("distortion_coeffs")?,
        };
        let lens = match (model, coefficients.len()) {
            ("radtan" | "equidistant", 4) | ("none", _) => named_lens(model, &coefficients)?,
            (model, count) => {
                return Err(format!(
                    "distortion_model {model:?} with {count} coefficients; expected radtan or equidistant with 4, or none"
                ));
            }
        };
        let &[width, height] = self.numbers("resolution")?.as_slice() else {
            return Err("resolution is not width and height".to_owned());
        };
        let intrinsics = intrinsics([width, height], DVec2::new(fx, fy), DVec2::new(cx, cy), lens);
        Ok(ImportedCamera::unnamed(intrinsics, None))
    }
}

pub(super) fn text(dir: &Path, rig: &Rig) -> Result<String, CalibError> {
    let mut text = String::new();
    let mut before: Option<Isometry> = None;
    let has_offsets = rig.cameras.iter().any(|camera| camera.time_offset_nanos != 0);
    for (number, camera) in rig.cameras.iter().enumerate() {
        let i = &camera.intrinsics;
        let (model, coefficients) = match i.lens {
            Lens::RadialTangential { radial: [k1, k2, 0.0], tangential: [p1, p2] } => ("radtan", [k1, k2, p1, p2]),
            Lens::Fisheye { coefficients } => ("equidistant", coefficients),
            _ => {
                let problem = format!(
                    "camera {}: Kalibr has no k3 and no rational lens; calibrate the lens with k1 k2 p1 p2",
                    camera.id
                );
                return Err(bad(&dir.join(FILE), problem));
            }
        };
        let _ = writeln!(text, "cam{number}:");
        if let Some(before) = before {
            let _ = writeln!(text, "  T_cn_cnm1:");
            for row in rows4(&(camera.camera_from_world * before.inverse())) {
                let _ = writeln!(text, "  - {row:?}");
            }
        }
        before = Some(camera.camera_from_world);
        let _ = writeln!(
            text,
            "  camera_model: pinhole\n  distortion_coeffs: {coefficients:?}\n  distortion_model: {model}\n  intrinsics: [{:?}, {:?}, \
             {:?}, {:?}]\n  resolution: [{}, {}]\n  rostopic: /{}/image_raw",
            i.focal_px.x, i.focal_px.y, i.center_px.x, i.center_px.y, i.width, i.height, camera.id
        );
        if has_offsets {
            let _ = writeln!(text, "  timeshift_cam_imu: {:?}", -1e-9 * camera.time_offset_nanos as f64);
        }
    }
    Ok(text)
}
