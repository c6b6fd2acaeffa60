//! Search for a calibration near the footage.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use flyrig_calib::Format;
use flyrig_types::{CameraId, Rig};

use super::{
    footage::{FoundFootage, subfolders},
    names::same_camera,
    options::ImportOptions,
};

/// Calibration of another program, or flyrig's own.
pub(super) struct FoundCalibration {
    pub rig: Rig,
    /// Whether the file states the up direction.
    pub up_is_stated: bool,
    /// Findings and assumptions, for the user.
    pub notes: Vec<String>,
}

impl FoundCalibration {
    /// Returns the names of the cameras.
    pub fn names(&self) -> Vec<String> {
        self.rig.cameras.iter().map(|camera| camera.id.to_string()).collect()
    }
}

/// Reads the named calibration, or the one in or beside the footage's folder.
pub(super) fn find_calibration(options: &ImportOptions, found: &FoundFootage) -> Result<FoundCalibration> {
    if let Some(path) = &options.calibration {
        return read(path, options.scale, found);
    }
    let (mut good, mut bad) = (Vec::new(), Vec::new());
    for places in [within(options, found)?, beside(options)] {
        for place in places.iter().filter(|place| Format::detect(place).is_some()) {
            match read(place, options.scale, found) {
                Ok(calibration) => good.push((place.clone(), calibration)),
                Err(error) => bad.push(error),
            }
        }
        if !good.is_empty() || !bad.is_empty() {
            break;
        }
    }
    let others: Vec<String> = good.iter().skip(1).map(|(place, _)| place.display().to_string()).collect();
    match (good.into_iter().next(), bad.into_iter().next()) {
        (Some((_, mut calibration)), _) => {
            if !others.is_empty() {
                calibration.notes.push(format!("other calibrations (--calibration names one): {}", others.join(", ")));
            }
            Ok(calibration)
        }
        (None, Some(error)) => Err(error),
        (None, None) => bail!(
            "no calibration in {} or one level below: name its file or folder with --calibration (known: {}), or make one with `flyrig \
             calibrate`",
            found.root.display(),
            Format::ALL.map(Format::name).join(", ")
        ),
    }
}

/// Returns the folders within the footage's in which a calibration is looked for, nearest first.
fn within(options: &ImportOptions, found: &FoundFootage) -> Result<Vec<PathBuf>> {
    let mut places = Vec::new();
    for folder in [Some(&found.root), options.inputs.first().filter(|path| path.is_dir())].into_iter().flatten() {
        for place in [vec![folder.clone()], subfolders(folder)?].concat() {
            if !places.contains(&place) {
                places.push(place);
            }
        }
    }
    Ok(places)
}

/// Returns the folder around the named one, and those in it: a folder of videos has its calibration beside it. Other takes are left out.
fn beside(options: &ImportOptions) -> Vec<PathBuf> {
    let named = options.inputs.first().filter(|path| path.is_dir());
    let above = named.and_then(|folder| std::path::absolute(folder).ok()?.parent().map(Path::to_owned));
    let is_take = |folder: &PathBuf| ["images", "videos"].iter().any(|name| folder.join(name).is_dir());
    let siblings =
        |above: &Path| subfolders(above).unwrap_or_default().into_iter().filter(|folder| !is_take(folder)).collect();
    above.map_or_else(Vec::new, |above| [vec![above.clone()], siblings(&above)].concat())
}

fn read(path: &Path, scale: f64, found: &FoundFootage) -> Result<FoundCalibration> {
    anyhow::ensure!(path.exists(), "{} does not exist", path.display());
    let format = Format::detect(path).with_context(|| {
        let known = Format::ALL.map(Format::name).join(", ");
        format!("{}: no format of a calibration is recognised; known: {known}", path.display())
    })?;
    let names = found.names();
    let size = |id: &CameraId| {
        // Cameras that the footage does not have are left out later; any size reads them.
        let slot = same_camera(id.as_str(), &names).unwrap_or(0);
        found.cameras.get(slot)?.size().ok()
    };
    let imported = format.read(path, &size, scale)?;
    let rig = imported.rig(path)?.with_context(|| {
        format!("{} holds lenses without poses; flyrig calibrate rig finds the poses from a board", path.display())
    })?;
    // EasyMocap's files do not state it either.
    let up_is_stated = imported.up.is_some() && format != Format::EasyMocap;
    let mut notes = vec![format!("calibration: {} ({}, {} cameras)", path.display(), format.name(), rig.cameras.len())];
    notes.extend(imported.warnings.iter().map(|warning| format!("warning: {warning}")));
    Ok(FoundCalibration { rig, up_is_stated, notes })
}
