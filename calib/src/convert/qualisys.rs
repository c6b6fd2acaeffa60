//! Qualisys Track Manager: the calibration as XML (`*.qca.txt`, or the XML of its real-time protocol).
//!
//! `transform` is the position in millimetres and the rotation world to camera, row by row, with camera axes x right, y
//! up, z backward. Image lengths are 64ths of a pixel, measured from the image's edge (`sensorMaxU` of an image of 1920
//! pixels is 122879): half a pixel is subtracted from the principal point. Distortion coefficients are OpenCV's.

use std::{fmt::Write as _, path::Path};

use flyrig_types::{CameraId, Isometry, Rig};
use glam::{DMat3, DVec2, DVec3};
use roxmltree::{Document, Node};

use super::{
    imported::{Imported, ImportedCamera},
    nerfstudio::flip,
    shared::{bad, intrinsics, opencv_lens, rotation_of},
};
use crate::calibration_file;
use crate::error::CalibError;

const SUBPIXELS: f64 = 64.0;

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
    Ok(Imported { cameras, up: Some(DVec3::Z) })
}

fn camera(id: &str, node: Node<'_, '_>) -> Result<ImportedCamera, String> {
    let child = |tag: &str| node.children().find(|n| n.has_tag_name(tag)).ok_or_else(|| format!("{tag} is missing"));
    let (intrinsic, transform) = (child("intrinsic")?, child("transform")?);
    let number = |node: &Node<'_, '_>, key: &str| {
        let value = node.attribute(key).and_then(|text| text.trim().parse::<f64>().ok());
        value.filter(|value| value.is_finite()).ok_or_else(|| format!("{key} is missing or no number; export it again"))
    };
    let of_lens = |key: &str| number(&intrinsic, key);
    if let Some(turn) = node.attribute("viewrotation").filter(|turn| turn.trim().parse::<f64>() != Ok(0.0)) {
        return Err(format!(
            "viewrotation is {turn}: set it to 0 in the project, and export calibration and video again"
        ));
    }
    let pixels = |key: &str| Ok::<f64, String>(of_lens(key)? / SUBPIXELS);
    let side = |low: &str, high: &str| Ok::<f64, String>((of_lens(high)? - of_lens(low)? + 1.0) / SUBPIXELS);
    let size = [side("sensorMinU", "sensorMaxU")?, side("sensorMinV", "sensorMaxV")?];
    let from = DVec2::new(pixels("sensorMinU")?, pixels("sensorMinV")?);
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
    Ok(ImportedCamera {
        id: CameraId::from(id),
        intrinsics: intrinsics(size, focal, center, opencv_lens(&coefficients)?),
        pose: Some(Isometry::new(rotation, -(rotation * position))),
        time_offset_nanos: 0,
        color: Default::default(),
    })
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
