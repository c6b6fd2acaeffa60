//! Qualisys Track Manager: the calibration as XML (`*.qca.txt`, or the XML of its real-time protocol).
//!
//! `transform` is the position in millimetres and the rotation world to camera, row by row, with camera axes x right, y
//! up, z backward. Image lengths are 64ths of a pixel, measured from the image's edge: half a pixel is subtracted from the principal
//! point. `sensorMaxU` of an image of 1920 pixels is 122879, the last 64th of its last pixel, or 122816, the first one, by version.
//! Distortion coefficients are OpenCV's.

use std::{fmt::Write as _, path::Path};

use flyrig_types::{CameraId, Isometry, Rig};
use glam::{DMat3, DVec2, DVec3};
use roxmltree::{Document, Node};

use super::{
    imported::{Imported, ImportedCamera},
    nerfstudio::flip,
    shared::{bad, intrinsics, opencv_lens, refuse_unknown, rotation_of},
};
use crate::calibration_file;
use crate::error::CalibError;

const SUBPIXELS: f64 = 64.0;
/// Smallest side of a sensor, pixels: what is smaller is not in 64ths.
const LEAST_SIDE: f64 = 128.0;
/// Attributes of a camera and its elements that are understood, or name the product.
const KEYS: [&str; 14] = [
    "model",
    "viewrotation",
    "video_resolution",
    "skew",
    "focallength",
    "focalLengthU",
    "focalLengthV",
    "radialDistortion1",
    "radialDistortion2",
    "radialDistortion3",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "centerPointU",
    "centerPointV",
];
/// Elements of a camera that are understood, or are of markers alone.
const ELEMENTS: [&str; 6] = ["transform", "intrinsic", "fov_video", "fov_video_max", "fov_marker", "fov_marker_max"];

pub(super) fn read(path: &Path) -> Result<Imported, CalibError> {
    let text = calibration_file::read(path)?;
    let document = Document::parse(&text).map_err(|error| bad(path, format!("is no XML: {error}; export it again")))?;
    let is_camera =
        |node: &Node<'_, '_>| node.has_tag_name("camera") && node.children().any(|n| n.has_tag_name("intrinsic"));
    let cameras = document
        .descendants()
        .filter(is_camera)
        .map(|node| {
            let id = node.attribute("serial").unwrap_or_default();
            camera(id, node).map_err(|problem| bad(path, format!("camera {id}: {problem}")))
        })
        .collect::<Result<_, _>>()?;
    Ok(Imported::new(cameras, Some(DVec3::Z)))
}

fn camera(id: &str, node: Node<'_, '_>) -> Result<ImportedCamera, String> {
    let child = |tag: &str| node.children().find(|n| n.has_tag_name(tag)).ok_or_else(|| format!("{tag} is missing"));
    let (intrinsic, transform) = (child("intrinsic")?, child("transform")?);
    let elements = node.children().filter(Node::is_element);
    refuse_unknown(elements.map(|element| element.tag_name().name()), &ELEMENTS)?;
    for element in node.ancestors().filter(Node::is_element).chain([intrinsic, transform]) {
        refuse_unknown(element.attributes().map(|attribute| attribute.name()), &KEYS)?;
    }
    if node.attribute("calibrated").is_some_and(|flag| !matches!(flag, "true" | "True" | "1")) {
        return Err("calibrated is not true; calibrate the camera, or take it out".to_owned());
    }
    if let Some(turn) = node.attribute("viewrotation").filter(|turn| turn.trim().parse::<f64>() != Ok(0.0)) {
        return Err(format!(
            "viewrotation is {turn}: set it to 0 in the project, and export calibration and video again"
        ));
    }
    let of_lens = |key: &str| number(&intrinsic, key);
    let pixels = |key: &str| Ok::<f64, String>(of_lens(key)? / SUBPIXELS);
    let side = |low: &str, high: &str| Ok::<f64, String>(pixels(high)?.floor() - pixels(low)?.floor() + 1.0);
    let sensor = [side("sensorMinU", "sensorMaxU")?, side("sensorMinV", "sensorMaxV")?];
    if sensor.iter().any(|side| *side < LEAST_SIDE) {
        return Err(format!(
            "sensorMaxU and sensorMaxV make a sensor of {}x{} pixels; lengths are not in 64ths of a pixel, export it again",
            sensor[0], sensor[1]
        ));
    }
    if intrinsic.attribute("skew").is_some() && pixels("skew")?.abs() > 0.01 {
        return Err(format!("skew is {}; calibrate without it", of_lens("skew")?));
    }
    let (from, size) = video(node, sensor)?;
    let from = from + DVec2::new(pixels("sensorMinU")?, pixels("sensorMinV")?);
    let center = DVec2::new(pixels("centerPointU")?, pixels("centerPointV")?) - from - 0.5;
    let mut coefficients = Vec::new();
    for key in
        ["radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3"]
    {
        coefficients.push(of_lens(key)?);
    }
    let focal = DVec2::new(pixels("focalLengthU")?, pixels("focalLengthV")?);
    let mut rows = [0.0; 9];
    for (k, entry) in rows.iter_mut().enumerate() {
        *entry = number(&transform, &format!("r{}{}", k / 3 + 1, k % 3 + 1))?;
    }
    // QTM's camera axes from the world's.
    let rotation =
        rotation_of(DMat3::from_cols_array(&rows).transpose()).map_err(|problem| format!("transform {problem}"))?;
    let position = DVec3::new(number(&transform, "x")?, number(&transform, "y")?, number(&transform, "z")?) * 1e-3;
    let rotation = flip() * rotation;
    let pose = Isometry::new(rotation, -(rotation * position));
    let intrinsics = intrinsics(size, focal, center, opencv_lens(&coefficients)?);
    Ok(ImportedCamera { id: CameraId::from(id), ..ImportedCamera::unnamed(intrinsics, Some(pose)) })
}

fn number(node: &Node<'_, '_>, key: &str) -> Result<f64, String> {
    let value = node.attribute(key).and_then(|text| text.trim().parse::<f64>().ok());
    value.filter(|value| value.is_finite()).ok_or_else(|| format!("{key} is missing or no number; export it again"))
}

/// Returns the first pixel of the video on the sensor and the size of its images: `fov_video`, where the field of view was reduced.
fn video(node: Node<'_, '_>, sensor: [f64; 2]) -> Result<(DVec2, [f64; 2]), String> {
    let find = |tag: &str| node.children().find(|child| child.has_tag_name(tag));
    let Some(fov) = find("fov_video") else { return Ok((DVec2::ZERO, sensor)) };
    let edges = |fov: &Node<'_, '_>| -> Result<[f64; 4], String> {
        Ok([number(fov, "left")?, number(fov, "top")?, number(fov, "right")?, number(fov, "bottom")?])
    };
    let edges = |fov: &Node<'_, '_>| edges(fov).map_err(|problem| format!("fov_video: {problem}"));
    let [left, top, right, bottom] = edges(&fov)?;
    let [_, _, most_right, most_bottom] = find("fov_video_max").map_or_else(|| edges(&fov), |most| edges(&most))?;
    // Right and bottom are the last pixels in some versions, those behind them in others.
    let past = sensor[0] - most_right;
    let is_whole_sensor = matches!(past, 0.0 | 1.0) && (sensor[1] - most_bottom - past).abs() < 0.5;
    let size = [right - left + past, bottom - top + past];
    let is_inside = left >= 0.0 && top >= 0.0 && right <= most_right && bottom <= most_bottom;
    if !is_whole_sensor || !is_inside || size.iter().any(|side| *side < 1.0) {
        return Err(format!(
            "fov_video {left} {top} {right} {bottom} does not fit the sensor of {}x{} pixels; export it of a video at full resolution",
            sensor[0], sensor[1]
        ));
    }
    Ok((DVec2::new(left, top), size))
}

pub(super) fn text(dir: &Path, rig: &Rig) -> Result<String, CalibError> {
    let mut text =
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<calibration type=\"regular\">\n  <cameras>\n".to_owned();
    for camera in &rig.cameras {
        let i = &camera.intrinsics;
        let refused = |problem: &str| bad(dir, format!("camera {}: {problem}", camera.id));
        let flyrig_types::Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } = i.lens else {
            return Err(refused("Qualisys has no fisheye and no rational lens; calibrate it with k1 k2 p1 p2 k3"));
        };
        if camera.id.as_str().contains(['"', '<', '>', '&']) {
            return Err(refused("the name cannot stand in XML; rename it"));
        }
        let at = camera.position() * 1e3;
        let rows = DMat3::from_quat(flip() * camera.camera_from_world.rotation).transpose().to_cols_array();
        let entries: Vec<String> =
            rows.iter().enumerate().map(|(k, value)| format!("r{}{}=\"{value:?}\"", k / 3 + 1, k % 3 + 1)).collect();
        let (focal, center) = (i.focal_px * SUBPIXELS, (i.center_px + 0.5) * SUBPIXELS);
        let most = |side: u32| f64::from(side) * SUBPIXELS - 1.0;
        let _ = write!(
            text,
            "    <camera active=\"1\" serial=\"{}\" viewrotation=\"0\">\n      <transform x=\"{:?}\" y=\"{:?}\" z=\"{:?}\" {}/>\n      \
             <intrinsic sensorMinU=\"0\" sensorMaxU=\"{}\" sensorMinV=\"0\" sensorMaxV=\"{}\" focalLengthU=\"{:?}\" \
             focalLengthV=\"{:?}\" centerPointU=\"{:?}\" centerPointV=\"{:?}\" skew=\"0\" radialDistortion1=\"{k1:?}\" \
             radialDistortion2=\"{k2:?}\" radialDistortion3=\"{k3:?}\" tangentalDistortion1=\"{p1:?}\" \
             tangentalDistortion2=\"{p2:?}\"/>\n    </camera>\n",
            camera.id,
            at.x,
            at.y,
            at.z,
            entries.join(" "),
            most(i.width),
            most(i.height),
            focal.x,
            focal.y,
            center.x,
            center.y
        );
    }
    text += "  </cameras>\n</calibration>\n";
    Ok(text)
}
