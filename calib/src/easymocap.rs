//! Calibration in the format of EasyMocap and ZJU-MoCap: `intri.yml` and `extri.yml`.
//!
//! Per camera `x`: `K_x` 3x3, `dist_x` (k1 k2 p1 p2 k3, or with k4 k5 k6 of the rational model), `Rot_x` 3x3 or `R_x`
//! as a Rodrigues vector, `T_x`; `x_camera = Rot x_world + T`. Image sizes `H_x`, `W_x` are optional. EasyVolcap and 4K4D write
//! `D_x` in place of `dist_x`.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use flyrig_types::{Camera, CameraError, CameraId, Intrinsics, Isometry, Lens, MAX_IMAGE_SIDE, Rig};
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::convert::shared::{opencv_coefficients, opencv_lens, refuse_unknown, rotation_of};
use crate::error::CalibError;
use crate::up::{level_up, nearest_axis};
use crate::yaml::{Matrix, YamlFile, YamlWriter};

const INTRINSICS: &str = "intri.yml";
const EXTRINSICS: &str = "extri.yml";
/// Largest angle between two statements of one rotation, radians.
const SAME_ROTATION: f64 = 1e-3;

/// Reads `intri.yml` and `extri.yml` of a folder. `image_size` gives width and height of a camera's images in pixels
/// for files that lack them, and is checked against those that contain them. The world's axes stay as they are; the up
/// direction is the world axis that the cameras suggest.
///
/// # Errors
/// [`CalibError`] names the file, the camera and the fix.
pub fn load_easymocap(dir: &Path, image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>) -> Result<Rig, CalibError> {
    let intri = open(dir, INTRINSICS)?;
    let extri = open(dir, EXTRINSICS)?;
    let with_intrinsics = camera_names(&intri, "K_", "K_<camera>")?;
    let with_extrinsics = camera_names(&extri, "T_", "T_<camera>")?;
    for (names, others, file, other) in
        [(&with_intrinsics, &with_extrinsics, &extri, &intri), (&with_extrinsics, &with_intrinsics, &intri, &extri)]
    {
        if let Some(camera) = names.iter().find(|name| !others.contains(name)) {
            let (path, other) = (file.path().to_owned(), other.path().to_owned());
            return Err(CalibError::OnlyInOther { path, other, camera: camera.clone() });
        }
    }
    let cameras = with_intrinsics
        .into_iter()
        .map(|id| {
            let intrinsics = read_intrinsics(&intri, &id, image_size(&id))?;
            let camera_from_world = read_extrinsics(&extri, &id)?;
            Ok(Camera { time_offset_nanos: 0, color: Default::default(), id, intrinsics, camera_from_world })
        })
        .collect::<Result<Vec<_>, CalibError>>()?;
    let world_up = nearest_axis(level_up(&cameras));
    let rig = Rig { cameras, world_up };
    validate(&rig, dir)?;
    Ok(rig)
}

fn open(dir: &Path, name: &str) -> Result<YamlFile, CalibError> {
    let file = YamlFile::open(dir.join(name))?;
    let prefixes = file.keys().map(|key| key.split_once('_').map_or(key, |(prefix, _)| prefix));
    refuse_unknown(prefixes, &[]).map_err(|problem| CalibError::Format { path: file.path().to_owned(), problem })?;
    Ok(file)
}

fn validate(rig: &Rig, dir: &Path) -> Result<(), CalibError> {
    rig.validate().map_err(|source: CameraError| CalibError::Camera { path: dir.to_owned(), source })
}

/// Returns the cameras of a file: its `names`, or the suffix of every key that begins with `prefix`.
fn camera_names(file: &YamlFile, prefix: &str, expected: &'static str) -> Result<Vec<CameraId>, CalibError> {
    let names = file.strings("names").unwrap_or_else(|| {
        let of = |key: &str| key.strip_prefix(prefix).map(str::to_owned);
        let sorted: BTreeSet<String> = file.keys().filter_map(of).collect();
        sorted.into_iter().collect()
    });
    if names.is_empty() {
        return Err(CalibError::NoCameras { path: file.path().to_owned(), expected });
    }
    Ok(names.into_iter().map(CameraId::from).collect())
}

/// Value of one camera in one file, with the context of its errors.
struct Entry<'a> {
    file: &'a YamlFile,
    camera: &'a CameraId,
    key: String,
}

impl<'a> Entry<'a> {
    fn new(file: &'a YamlFile, camera: &'a CameraId, prefix: &str) -> Self {
        Self { file, camera, key: format!("{prefix}_{camera}") }
    }

    fn read(&self) -> Result<Option<Matrix>, CalibError> {
        self.file.matrix(self.camera, &self.key)
    }

    fn required(&self, mend: &'static str) -> Result<Matrix, CalibError> {
        self.read()?.ok_or_else(|| self.missing(mend))
    }

    fn missing(&self, mend: &'static str) -> CalibError {
        CalibError::Missing { path: self.path(), camera: self.camera.clone(), key: self.key.clone(), mend }
    }

    fn wrong(&self, problem: String, mend: &'static str) -> CalibError {
        CalibError::Value { path: self.path(), camera: self.camera.clone(), key: self.key.clone(), problem, mend }
    }

    fn path(&self) -> PathBuf {
        self.file.path().to_owned()
    }

    fn wrong_shape(&self, matrix: &Matrix, expected: &str) -> CalibError {
        let problem = format!("is {}x{}, expected {expected}", matrix.rows, matrix.cols);
        self.wrong(problem, "export the calibration again")
    }

    fn matrix3(&self, matrix: &Matrix) -> Result<DMat3, CalibError> {
        match <[f64; 9]>::try_from(matrix.values.as_slice()) {
            Ok(rows) if matrix.rows == 3 => Ok(DMat3::from_cols_array(&rows).transpose()),
            _ => Err(self.wrong_shape(matrix, "3x3")),
        }
    }

    fn vector3(&self, matrix: &Matrix) -> Result<DVec3, CalibError> {
        <[f64; 3]>::try_from(matrix.values.as_slice()).map(DVec3::from).map_err(|_| self.wrong_shape(matrix, "3x1"))
    }
}

fn read_intrinsics(file: &YamlFile, id: &CameraId, pictures: Option<(u32, u32)>) -> Result<Intrinsics, CalibError> {
    let entry = Entry::new(file, id, "K");
    let k = entry.matrix3(&entry.required("calibrate this camera")?)?.transpose();
    let [[fx, skew, cx], [zero_a, fy, cy], last] = k.to_cols_array_2d();
    // A skew of a hundredth of a pixel has no measurable effect.
    if skew.abs() > 0.01 || zero_a.abs() > 1e-9 || DVec3::from(last) != DVec3::Z {
        return Err(entry.wrong(
            format!("has skew {skew} or an unusual shape, expected [fx 0 cx; 0 fy cy; 0 0 1]"),
            "calibrate without skew",
        ));
    }
    let (width, height) = image_size(file, id, pictures)?;
    Ok(Intrinsics {
        width,
        height,
        focal_px: DVec2::new(fx, fy),
        center_px: DVec2::new(cx, cy),
        lens: read_lens(file, id)?,
    })
}

/// Reads EasyMocap's `dist_CAM` or EasyVolcap's `D_CAM`.
fn read_lens(file: &YamlFile, id: &CameraId) -> Result<Lens, CalibError> {
    // EasyVolcap's angles of a fisheye.
    let fisheye = Entry::new(file, id, "rdist");
    if fisheye.read()?.is_some_and(|matrix| matrix.values.iter().any(|value| *value != 0.0)) {
        return Err(fisheye.wrong("is a fisheye's".to_owned(), "undistort the images, or calibrate with dist"));
    }
    let (entry, other) = (Entry::new(file, id, "dist"), Entry::new(file, id, "D"));
    let (matrix, entry) = match (entry.read()?, other.read()?) {
        (Some(matrix), Some(second)) if matrix.values != second.values => {
            return Err(entry.wrong(format!("and {} differ", other.key), "take the wrong one out"));
        }
        (Some(matrix), _) => (matrix, entry),
        (None, Some(matrix)) => (matrix, other),
        (None, None) => return Err(entry.missing("write five zeros when the lens does not distort")),
    };
    if matrix.rows != 1 && matrix.cols != 1 || ![4, 5, 8, 12, 14].contains(&matrix.values.len()) {
        return Err(entry.wrong_shape(&matrix, "a row of 4, 5, 8, 12 or 14 numbers"));
    }
    opencv_lens(&matrix.values)
        .map_err(|problem| entry.wrong(format!("has {problem}"), "k1 k2 p1 p2 k3 k4 k5 k6 can be used"))
}

fn image_size(file: &YamlFile, id: &CameraId, pictures: Option<(u32, u32)>) -> Result<(u32, u32), CalibError> {
    let side =
        |prefix: &str| -> Result<Option<u32>, CalibError> {
            let entry = Entry::new(file, id, prefix);
            match file.number(&entry.key) {
                // EasyVolcap writes -1 or 0 for sizes that it does not know.
                None | Some(-1.0 | 0.0) => Ok(None),
                Some(pixels) if pixels >= 1.0 && pixels <= f64::from(MAX_IMAGE_SIDE) && pixels.fract() == 0.0 => {
                    Ok(Some(pixels as u32))
                }
                Some(pixels) => Err(entry
                    .wrong(format!("is {pixels}, expected 1 to {MAX_IMAGE_SIDE} pixels"), "correct it or take it out")),
            }
        };
    let calibrated = side("W")?.zip(side("H")?);
    match (calibrated, pictures) {
        (Some(calibrated), Some(pictures)) if calibrated != pictures => {
            Err(CalibError::OtherSize { path: file.path().to_owned(), camera: id.clone(), calibrated, pictures })
        }
        (Some(size), _) | (None, Some(size)) => Ok(size),
        (None, None) => Err(CalibError::UnknownSize { path: file.path().to_owned(), camera: id.clone() }),
    }
}

fn read_extrinsics(file: &YamlFile, id: &CameraId) -> Result<Isometry, CalibError> {
    let (entry, vector) = (Entry::new(file, id, "Rot"), Entry::new(file, id, "R"));
    let of_vector = match vector.read()? {
        Some(matrix) if matrix.values.len() == 9 => Some(rotation(&vector, &matrix)?),
        Some(matrix) => Some(DQuat::from_scaled_axis(vector.vector3(&matrix)?)),
        None => None,
    };
    let rotation = match (entry.read()?, of_vector) {
        (Some(matrix), of_vector) => {
            let of_matrix = rotation(&entry, &matrix)?;
            if of_vector.is_some_and(|other| other.angle_between(of_matrix) > SAME_ROTATION) {
                return Err(
                    entry.wrong(format!("and {} are different rotations", vector.key), "take the wrong one out")
                );
            }
            of_matrix
        }
        (None, Some(of_vector)) => of_vector,
        (None, None) => return Err(entry.missing("or give a Rodrigues vector R")),
    };
    let entry = Entry::new(file, id, "T");
    let translation = entry.vector3(&entry.required("calibrate the position of this camera")?)?;
    Ok(Isometry::new(rotation, translation))
}

fn rotation(entry: &Entry<'_>, matrix: &Matrix) -> Result<DQuat, CalibError> {
    rotation_of(entry.matrix3(matrix)?)
        .map_err(|problem| entry.wrong(problem, "export the calibration again; a mirrored axis gives determinant -1"))
}

/// Writes a rig as `intri.yml` and `extri.yml` with image sizes, so that [`load_easymocap`] reads the same cameras
/// back. The format cannot hold [`Rig::world_up`] and time offsets. Both files are composed before the first one is
/// written.
///
/// # Errors
/// [`CalibError`] when a camera is invalid or a fisheye, or the folder cannot be written.
pub fn save_easymocap(dir: &Path, rig: &Rig) -> Result<(), CalibError> {
    validate(rig, dir)?;
    let mut intri = YamlWriter::new(dir.join(INTRINSICS));
    let mut extri = YamlWriter::new(dir.join(EXTRINSICS));
    for file in [&mut intri, &mut extri] {
        file.strings("names", rig.cameras.iter().map(|camera| camera.id.as_str()))?;
    }
    for camera in &rig.cameras {
        let id = &camera.id;
        write_intrinsics(&mut intri, id, &camera.intrinsics)?;
        let rotation = camera.camera_from_world.rotation;
        extri.matrix(&format!("R_{id}"), 1, &rotation.to_scaled_axis().to_array());
        extri.matrix(&format!("Rot_{id}"), 3, &DMat3::from_quat(rotation).transpose().to_cols_array());
        extri.matrix(&format!("T_{id}"), 1, &camera.camera_from_world.translation.to_array());
    }
    intri.finish()?;
    extri.finish()
}

fn write_intrinsics(intri: &mut YamlWriter, id: &CameraId, i: &Intrinsics) -> Result<(), CalibError> {
    let Some(coefficients) = opencv_coefficients(&i.lens) else {
        return Err(CalibError::FisheyeUnsupported { camera: id.clone() });
    };
    let k = [i.focal_px.x, 0.0, i.center_px.x, 0.0, i.focal_px.y, i.center_px.y, 0.0, 0.0, 1.0];
    intri.matrix(&format!("K_{id}"), 3, &k);
    intri.matrix(&format!("dist_{id}"), coefficients.len(), &coefficients);
    intri.integer(&format!("H_{id}"), i.height);
    intri.integer(&format!("W_{id}"), i.width);
    Ok(())
}

/// Reads the lenses of a folder's `intri.yml`; `image_size` as in [`load_easymocap`].
///
/// # Errors
/// As [`load_easymocap`].
pub(crate) fn load_lenses(
    dir: &Path,
    image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>,
) -> Result<Vec<(CameraId, Intrinsics)>, CalibError> {
    let intri = open(dir, INTRINSICS)?;
    let names = camera_names(&intri, "K_", "K_<camera>")?;
    names.into_iter().map(|id| Ok((id.clone(), read_intrinsics(&intri, &id, image_size(&id))?))).collect()
}
