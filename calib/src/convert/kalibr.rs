//! Kalibr: `camchain.yaml`. Poses form a chain, `T_cn_cnm1` takes points from the camera before; the world is cam0.
//!
//! Kalibr numbers its cameras; their names are read from and written to `rostopic`. `timeshift_cam_imu` gives time
//! offsets: `t_imu = t_cam + shift`.

use std::{fmt::Write as _, path::Path};

use flyrig_types::{CameraId, Isometry, Lens, Rig};
use glam::DVec2;

use super::{
    imported::{Imported, ImportedCamera},
    shared::{bad, intrinsics, motion_of, rows4},
};
use crate::error::CalibError;
use crate::yaml::{Value, parse_tree};

pub(super) const FILE: &str = "camchain.yaml";

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let tree = parse_tree(path)?;
    let mut cameras: Vec<ImportedCamera> = Vec::new();
    let mut first_shift = None;
    for number in 0.. {
        let Some(node) = tree.get(&format!("cam{number}")) else { break };
        let named = |problem: String| bad(path, format!("cam{number}: {problem}"));
        let need = |key: &str| {
            node.get(key)
                .and_then(Value::numbers)
                .ok_or_else(|| named(format!("{key} is missing or no list of numbers")))
        };
        let word = |key: &str| node.get(key).and_then(Value::word).unwrap_or_default().to_owned();
        let model = word("camera_model");
        if model != "pinhole" {
            return Err(named(format!(
                "camera_model {model:?} is not supported; calibrate with pinhole-radtan or pinhole-equi"
            )));
        }
        let &[fx, fy, cx, cy] = need("intrinsics")?.as_slice() else {
            return Err(named("intrinsics are not fx fy cx cy".to_owned()));
        };
        let coefficients = need("distortion_coeffs")?;
        let lens = match (word("distortion_model").as_str(), coefficients.as_slice()) {
            ("radtan", &[k1, k2, p1, p2]) => Lens::RadialTangential { radial: [k1, k2, 0.0], tangential: [p1, p2] },
            ("equidistant", &[k1, k2, k3, k4]) => Lens::Fisheye { coefficients: [k1, k2, k3, k4] },
            ("none", _) => Lens::PINHOLE,
            (model, c) => {
                return Err(named(format!(
                    "distortion_model {model:?} with {} coefficients; expected radtan or equidistant with 4, or none",
                    c.len()
                )));
            }
        };
        let &[width, height] = need("resolution")?.as_slice() else {
            return Err(named("resolution is not width and height".to_owned()));
        };
        let pose = match (cameras.last(), node.get("T_cn_cnm1")) {
            (None, _) => Some(Isometry::IDENTITY),
            (Some(_), None) => return Err(named("T_cn_cnm1 is missing; calibrate the cameras together".to_owned())),
            (Some(before), Some(matrix)) => {
                let rows = matrix.rows().ok_or_else(|| named("T_cn_cnm1 is no matrix".to_owned()))?;
                let step = motion_of(&rows).map_err(|problem| named(format!("T_cn_cnm1 {problem}")))?;
                before.pose.map(|pose| step * pose)
            }
        };
        let shift = node.get("timeshift_cam_imu").and_then(Value::number).unwrap_or(0.0);
        let first = *first_shift.get_or_insert(shift);
        let topic = word("rostopic");
        let name = topic.split('/').find(|part| !part.is_empty()).map_or_else(|| format!("cam{number}"), str::to_owned);
        cameras.push(ImportedCamera {
            id: CameraId::from(name),
            intrinsics: intrinsics([width, height], DVec2::new(fx, fy), DVec2::new(cx, cy), lens),
            pose,
            time_offset_nanos: ((first - shift) * 1e9).round() as i64,
            color: Default::default(),
        });
    }
    // One camera alone was calibrated for its lens.
    if let [only] = cameras.as_mut_slice() {
        only.pose = None;
    }
    Ok(Imported { cameras, up: None })
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
