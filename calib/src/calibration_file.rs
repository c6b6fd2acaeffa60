//! `calibration.toml`: the cameras of a rig, or their lenses alone, in flyrig's own format.
//!
//! Conventions: OpenCV camera axes (x right, y down, z forward), `x_camera = rotation x_world + translation_m`, metres, pixel
//! centres at integers. A camera's time offset is subtracted from its timestamps.

use std::{fmt::Write as _, io::Write as _, path::Path};

use flyrig_types::{Camera, CameraId, ColorMatch, Intrinsics, Isometry, Lens, Rig, read_text, write_whole};
use glam::{DMat3, DVec2, DVec3};
use serde::Deserialize;

use crate::convert::{
    imported::{Imported, ImportedCamera},
    shared::rotation_of,
};
use crate::error::CalibError;

/// Name of the file in a calibration folder.
pub(crate) const FILE: &str = "calibration.toml";
const VERSION: u32 = 1;

/// Standard deviations of a camera's pose and time offset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// Direction, degrees.
    pub rotation_deg: f64,
    /// Position, millimetres.
    pub position_mm: f64,
    /// Time offset, milliseconds, where one was estimated.
    pub time_offset_ms: Option<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    version: u32,
    up: Option<[f64; 3]>,
    #[serde(default)]
    cameras: Vec<Entry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    size: [u32; 2],
    focal_px: [f64; 2],
    center_px: [f64; 2],
    lens: LensEntry,
    rotation: Option<[[f64; 3]; 3]>,
    translation_m: Option<[f64; 3]>,
    #[serde(default)]
    time_offset_ms: f64,
    #[serde(default)]
    color: ColorMatch,
    /// Deviations for human readers; not read back.
    #[serde(rename = "deviation")]
    _deviation: Option<DeviationEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(tag = "model", rename_all = "kebab-case", deny_unknown_fields)]
enum LensEntry {
    RadialTangential { radial: [f64; 3], tangential: [f64; 2] },
    Rational { radial: [f64; 6], tangential: [f64; 2] },
    Fisheye { coefficients: [f64; 4] },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct DeviationEntry {
    #[serde(rename = "rotation_deg")]
    _rotation_deg: f64,
    #[serde(rename = "position_mm")]
    _position_mm: f64,
    #[serde(rename = "time_offset_ms")]
    _time_offset_ms: Option<f64>,
}

/// Reads a file as text; see [`read_text`].
pub(crate) fn read(path: &Path) -> Result<String, CalibError> {
    read_text(path).map_err(|source| read_error(path, source))
}

/// Maps the error of a file that cannot be read.
pub(crate) fn read_error(path: &Path, source: std::io::Error) -> CalibError {
    match source.kind() {
        std::io::ErrorKind::InvalidData => {
            CalibError::Format { path: path.to_owned(), problem: format!("cannot be read: {source}") }
        }
        _ => CalibError::Read { path: path.to_owned(), source },
    }
}

/// Reads the text of a `calibration.toml`; `path` is for errors.
///
/// # Errors
/// [`CalibError`] names the camera, the key and the fix.
pub(crate) fn parse(path: &Path, text: &str) -> Result<Imported, CalibError> {
    let refused = |problem: String| CalibError::Format { path: path.to_owned(), problem };
    let file: File = toml::from_str(text).map_err(|error| {
        let line = error
            .span()
            .map(|span| 1 + text.as_bytes()[..span.start.min(text.len())].iter().filter(|b| **b == b'\n').count());
        let at = line.map_or_else(String::new, |line| format!("line {line}: "));
        refused(format!("{at}{}; correct it, or run the calibration again", error.message().replace('\n', " ")))
    })?;
    if file.version != VERSION {
        return Err(refused(format!("version {} is not known, expected {VERSION}; update flyrig", file.version)));
    }
    if file.cameras.is_empty() {
        return Err(CalibError::NoCameras { path: path.to_owned(), expected: "in tables [[cameras]]" });
    }
    let cameras = file.cameras.into_iter().map(|entry| camera(path, entry)).collect::<Result<Vec<_>, _>>()?;
    let direction = |up: [f64; 3]| DVec3::from(up).try_normalize().filter(|up| up.is_finite());
    let up = file.up.map(|up| {
        direction(up).ok_or_else(|| refused("up is not a direction; give [0, 0, 1], for example".to_owned()))
    });
    Ok(Imported::new(cameras, up.transpose()?))
}

fn camera(path: &Path, entry: Entry) -> Result<ImportedCamera, CalibError> {
    let id = CameraId::from(entry.name);
    let wrong = |key: &str, problem: String, mend| CalibError::Value {
        path: path.to_owned(),
        camera: id.clone(),
        key: key.to_owned(),
        problem,
        mend,
    };
    let lens = match entry.lens {
        LensEntry::RadialTangential { radial, tangential } => Lens::RadialTangential { radial, tangential },
        LensEntry::Rational { radial, tangential } => Lens::Rational { radial, tangential },
        LensEntry::Fisheye { coefficients } => Lens::Fisheye { coefficients },
    };
    let intrinsics = Intrinsics {
        width: entry.size[0],
        height: entry.size[1],
        focal_px: DVec2::from(entry.focal_px),
        center_px: DVec2::from(entry.center_px),
        lens,
    };
    let pose = match (entry.rotation, entry.translation_m) {
        (Some(rows), Some(translation)) => {
            let matrix = DMat3::from_cols_array_2d(&rows).transpose();
            let rotation =
                rotation_of(matrix).map_err(|problem| wrong("rotation", problem, "run the calibration again"))?;
            Some(Isometry::new(rotation, DVec3::from(translation)))
        }
        (None, None) => None,
        (rotation, _) => {
            let (has, misses) =
                if rotation.is_some() { ("rotation", "translation_m") } else { ("translation_m", "rotation") };
            return Err(wrong(has, format!("is given without {misses}"), "give both, or neither"));
        }
    };
    if !entry.time_offset_ms.is_finite() {
        return Err(wrong("time_offset_ms", "is not a finite number".to_owned(), "give milliseconds, or take it out"));
    }
    // Too large an offset saturates, and the rig's check names it.
    let time_offset_nanos = (entry.time_offset_ms * 1e6).round() as i64;
    Ok(ImportedCamera { id, intrinsics, pose, time_offset_nanos, color: entry.color })
}

/// Returns the text of a `calibration.toml`; `deviations` per slot, where they are known.
///
/// # Errors
/// [`CalibError::Camera`] for an invalid rig.
pub fn calibration_toml(rig: &Rig, deviations: &[Option<Deviation>]) -> Result<String, CalibError> {
    rig.validate().map_err(|source| CalibError::Camera { path: FILE.into(), source })?;
    let mut text = header();
    let _ = writeln!(text, "up = {:?}", rig.world_up.to_array());
    for (slot, camera) in rig.cameras.iter().enumerate() {
        put_lens(&mut text, &camera.id, &camera.intrinsics);
        let [x, y, z] = DMat3::from_quat(camera.camera_from_world.rotation).transpose().to_cols_array_2d();
        let _ = writeln!(text, "rotation = [\n    {x:?},\n    {y:?},\n    {z:?},\n]");
        let _ = writeln!(text, "translation_m = {:?}", camera.camera_from_world.translation.to_array());
        if camera.time_offset_nanos != 0 {
            let _ = writeln!(text, "time_offset_ms = {:.6}", camera.time_offset_nanos as f64 * 1e-6);
        }
        if camera.color != ColorMatch::NONE {
            let ColorMatch { gain, exponent, falloff } = camera.color;
            let _ = writeln!(text, "color = {{ gain = {gain:?}, exponent = {exponent:?}, falloff = {falloff:?} }}");
        }
        let finite = |d: &&Deviation| {
            d.rotation_deg.is_finite() && d.position_mm.is_finite() && d.time_offset_ms.is_none_or(f64::is_finite)
        };
        if let Some(deviation) = deviations.get(slot).and_then(Option::as_ref).filter(finite) {
            let time = deviation.time_offset_ms.map_or_else(String::new, |ms| format!(", time_offset_ms = {ms:.2}"));
            let _ = writeln!(
                text,
                "deviation = {{ rotation_deg = {:.4}, position_mm = {:.2}{time} }}",
                deviation.rotation_deg, deviation.position_mm
            );
        }
    }
    Ok(text)
}

/// Writes `calibration.toml` into a folder; see [`calibration_toml`].
///
/// # Errors
/// As [`calibration_toml`], or when the file cannot be written.
pub fn save_calibration(dir: &Path, rig: &Rig, deviations: &[Option<Deviation>]) -> Result<(), CalibError> {
    write(dir, &calibration_toml(rig, deviations)?)
}

/// Writes lenses as a `calibration.toml` of cameras whose poses are not known yet.
///
/// # Errors
/// As [`save_calibration`].
pub fn save_lenses(dir: &Path, lenses: &[(CameraId, Intrinsics)]) -> Result<(), CalibError> {
    let posed = |(id, intrinsics): &(CameraId, Intrinsics)| Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: id.clone(),
        intrinsics: *intrinsics,
        camera_from_world: Isometry::IDENTITY,
    };
    let rig = Rig { cameras: lenses.iter().map(posed).collect(), world_up: DVec3::Z };
    rig.validate().map_err(|source| CalibError::Camera { path: dir.join(FILE), source })?;
    let mut text = header();
    for (id, intrinsics) in lenses {
        put_lens(&mut text, id, intrinsics);
    }
    write(dir, &text)
}

fn header() -> String {
    format!(
        "# Cameras of a rig. x_camera = rotation x_world + translation_m, metres; camera axes: x right, y down, z forward.\n\
         # Pixel centres lie at integers. Time offsets are subtracted from timestamps.\n\
         # Colours: light = gain * linear(srgb^exponent) * exp(falloff[0] r^2 + falloff[1] r^4), r: distance from center_px over half the diagonal.\n\
         version = {VERSION}\n"
    )
}

fn put_lens(text: &mut String, id: &CameraId, i: &Intrinsics) {
    let lens = match i.lens {
        Lens::RadialTangential { radial, tangential } => {
            format!("model = \"radial-tangential\", radial = {radial:?}, tangential = {tangential:?}")
        }
        Lens::Rational { radial, tangential } => {
            format!("model = \"rational\", radial = {radial:?}, tangential = {tangential:?}")
        }
        Lens::Fisheye { coefficients } => format!("model = \"fisheye\", coefficients = {coefficients:?}"),
    };
    let _ = write!(
        text,
        "\n[[cameras]]\nname = {}\nsize = [{}, {}]\nfocal_px = {:?}\ncenter_px = {:?}\nlens = {{ {lens} }}\n",
        toml::Value::String(id.to_string()),
        i.width,
        i.height,
        i.focal_px.to_array(),
        i.center_px.to_array(),
    );
}

fn write(dir: &Path, text: &str) -> Result<(), CalibError> {
    let path = dir.join(FILE);
    write_whole(&path, |out| out.write_all(text.as_bytes()))
        .map_err(|error| CalibError::Write { path, reason: error.to_string() })
}
