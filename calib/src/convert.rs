//! Readers and writers of other programs' calibrations; each foreign format has a file below `convert/`.
//!
//! Every reader returns flyrig's conventions: OpenCV camera axes, metres, pixel centres at integers. The world's axes stay those of
//! the file.

mod anipose;
mod colmap;
mod colmap_binary;
mod colmap_models;
mod image_names;
pub(crate) mod imported;
mod kalibr;
mod mrcal;
mod nerfstudio;
mod opencv;
mod python;
mod qualisys;
pub(crate) mod shared;

use std::{
    io::Write as _,
    path::{Path, PathBuf},
};

use flyrig_types::{CameraId, Rig, write_whole};

pub use self::imported::{Imported, ImportedCamera};
use self::shared::{bad, files_with, inside, one_file};
use crate::calibration_file;
use crate::easymocap;
use crate::error::CalibError;

/// Calibration format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// `calibration.toml`.
    Flyrig,
    /// `intri.yml` and `extri.yml`; also ZJU-MoCap's.
    EasyMocap,
    /// One file of FileStorage per camera, with the keys of OpenCV's calibration sample, and `rvec`, `tvec`.
    OpenCv,
    /// `camchain.yaml`.
    Kalibr,
    /// `cameras.txt` and `images.txt`, or `cameras.bin` and `images.bin`.
    Colmap,
    /// `transforms.json`.
    Nerfstudio,
    /// `*.qca.txt` or `*.xml` of the Qualisys Track Manager.
    Qualisys,
    /// TOML of anipose, Pose2Sim and caliscope.
    Anipose,
    /// One file `CAM.cameramodel` per camera.
    Mrcal,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 9] = [
        Self::Flyrig,
        Self::EasyMocap,
        Self::OpenCv,
        Self::Kalibr,
        Self::Colmap,
        Self::Nerfstudio,
        Self::Qualisys,
        Self::Anipose,
        Self::Mrcal,
    ];

    /// Returns the name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Flyrig => "flyrig",
            Self::EasyMocap => "easymocap",
            Self::OpenCv => "opencv",
            Self::Kalibr => "kalibr",
            Self::Colmap => "colmap",
            Self::Nerfstudio => "nerfstudio",
            Self::Qualisys => "qualisys",
            Self::Anipose => "anipose",
            Self::Mrcal => "mrcal",
        }
    }

    /// Returns a line on camera axes, pixel origin, world and unit of the format.
    #[must_use]
    pub fn conventions(self) -> &'static str {
        match self {
            Self::Flyrig | Self::EasyMocap | Self::OpenCv | Self::Mrcal => {
                "camera axes x right, y down, z forward; pixel centres at integers; world to camera; metres"
            }
            Self::Kalibr => {
                "camera axes x right, y down, z forward; pixel centres at integers; each camera from the one before, the world is cam0; \
                 metres"
            }
            Self::Colmap => {
                "camera axes x right, y down, z forward; pixel centres at halves; world to camera; any scale unless it was set"
            }
            Self::Nerfstudio => {
                "camera axes x right, y up, z backward; pixel centres at halves; camera to world; any scale unless it was set"
            }
            Self::Qualisys => {
                "camera axes x right, y up, z backward; 64ths of a pixel from the image's edge; camera to world, z up; millimetres"
            }
            Self::Anipose => {
                "camera axes x right, y down, z forward; pixel centres at integers; world to camera; the unit of the board"
            }
        }
    }

    /// Detects the format of a file or folder from its name and contents.
    #[must_use]
    pub fn detect(path: &Path) -> Option<Self> {
        let has = |name: &str| path.join(name).is_file();
        let text = |path: &Path| calibration_file::read(path).unwrap_or_default();
        let storage = |text: &str| {
            let is_chain = kalibr::is_chain(text);
            is_chain.then_some(Self::Kalibr).or_else(|| opencv::is_storage(text).then_some(Self::OpenCv))
        };
        if path.is_dir() {
            let of_folder = [
                (calibration_file::FILE, Self::Flyrig),
                ("intri.yml", Self::EasyMocap),
                (kalibr::FILE, Self::Kalibr),
                (colmap::CAMERAS, Self::Colmap),
                (colmap_binary::CAMERAS, Self::Colmap),
                (nerfstudio::FILE, Self::Nerfstudio),
                (anipose::FILE, Self::Anipose),
                ("camera_array.toml", Self::Anipose),
                ("config.toml", Self::Anipose),
            ];
            let named = of_folder.into_iter().find(|(name, _)| has(name)).map(|(_, format)| format);
            let model = || colmap::model_folder(path).map(|_| Self::Colmap);
            let first = |ending: &str| files_with(path, ending).ok().and_then(|files| files.into_iter().next());
            let by_ending = || {
                let found = |(ending, format): (&str, Self)| first(ending).map(|_| format);
                [(".cameramodel", Self::Mrcal), (".qca.txt", Self::Qualisys)].into_iter().find_map(found)
            };
            let of_storage = || {
                let formats = |ending: &str| {
                    let formats = files_with(path, ending).ok()?.into_iter().map(|file| storage(&text(&file)));
                    // Others that end so are rare.
                    formats
                        .flatten()
                        .next()
                        .or_else(|| first(ending).filter(|_| ending == ".yml").map(|_| Self::OpenCv))
                };
                opencv::ENDINGS.into_iter().find_map(formats)
            };
            return named.or_else(model).or_else(by_ending).or_else(of_storage);
        }
        let name = path.file_name()?.to_string_lossy().to_lowercase();
        let storage_or = |other: Self| storage(&text(path)).unwrap_or(other);
        match name.as_str() {
            calibration_file::FILE if text(path).contains("[[cameras]]") => Some(Self::Flyrig),
            "intri.yml" | "extri.yml" => Some(Self::EasyMocap),
            "cameras.txt" | "images.txt" | "cameras.bin" | "images.bin" => Some(Self::Colmap),
            name if name.ends_with(".cameramodel") => Some(Self::Mrcal),
            name if name.ends_with(".qca.txt") => Some(Self::Qualisys),
            name if name.ends_with(".xml") => Some(storage_or(Self::Qualisys)),
            name if name.ends_with(".json") => Some(storage_or(Self::Nerfstudio)),
            name if name.ends_with(".toml") => Some(Self::Anipose),
            name if name.ends_with(".yaml") || name.ends_with(".yml") => Some(storage_or(Self::OpenCv)),
            _ => None,
        }
    }

    /// Reads a calibration from a file or a folder. `image_size` gives width and height of a camera's images for
    /// formats that may omit them. Lengths are multiplied by `scale`.
    ///
    /// # Errors
    /// [`CalibError`] names the file, the camera and the fix.
    pub fn read(
        self,
        path: &Path,
        image_size: &dyn Fn(&CameraId) -> Option<(u32, u32)>,
        scale: f64,
    ) -> Result<Imported, CalibError> {
        let dir = || if path.is_dir() { path } else { path.parent().unwrap_or(Path::new(".")) };
        let of_rig = |rig: Rig| {
            let cameras = rig.cameras.into_iter().map(|camera| ImportedCamera {
                id: camera.id,
                intrinsics: camera.intrinsics,
                pose: Some(camera.camera_from_world),
                time_offset_nanos: camera.time_offset_nanos,
                color: camera.color,
            });
            Imported::new(cameras.collect(), Some(rig.world_up))
        };
        let mut imported = match self {
            Self::Flyrig => {
                let file = inside(path, &[calibration_file::FILE]);
                calibration_file::parse(&file, &calibration_file::read(&file)?)?
            }
            Self::EasyMocap => of_rig(easymocap::load_easymocap(dir(), image_size)?),
            Self::OpenCv => opencv::read(path, image_size)?,
            Self::Kalibr => kalibr::read(&kalibr_file(path)?)?,
            Self::Colmap => colmap::read(dir())?,
            Self::Nerfstudio => nerfstudio::read(&inside(path, &[nerfstudio::FILE]), image_size)?,
            Self::Qualisys => qualisys::read(&one_file(path, ".qca.txt")?)?,
            Self::Anipose => anipose::read(&inside(path, &[anipose::FILE, "camera_array.toml", "config.toml"]))?,
            Self::Mrcal => mrcal::read(path)?,
        };
        if imported.cameras.is_empty() {
            return Err(CalibError::NoCameras { path: path.to_owned(), expected: "of this format" });
        }
        for camera in &mut imported.cameras {
            camera.scale(scale);
            camera.check(path)?;
        }
        for (i, camera) in imported.cameras.iter().enumerate() {
            if imported.cameras[..i].iter().any(|other| other.id == camera.id) {
                return Err(bad(path, format!("camera {} is in it twice; take one out", camera.id)));
            }
        }
        Ok(imported)
    }

    /// Writes a rig into a folder and returns the names of the files. Writes nothing where the format cannot represent
    /// a camera.
    ///
    /// # Errors
    /// [`CalibError`] names the camera and what the format lacks.
    pub fn write(self, dir: &Path, rig: &Rig) -> Result<Vec<String>, CalibError> {
        rig.validate().map_err(|source| CalibError::Camera { path: dir.to_owned(), source })?;
        let one = |name: &str, text: String| vec![(name.to_owned(), text.into_bytes())];
        let files: Vec<(String, Vec<u8>)> = match self {
            Self::Flyrig => one(calibration_file::FILE, calibration_file::calibration_toml(rig, &[])?),
            Self::EasyMocap => {
                easymocap::save_easymocap(dir, rig)?;
                return Ok(vec!["intri.yml".to_owned(), "extri.yml".to_owned()]);
            }
            Self::OpenCv => opencv::files(dir, rig)?,
            Self::Kalibr => one(kalibr::FILE, kalibr::text(dir, rig)?),
            Self::Colmap => colmap::files(rig),
            Self::Nerfstudio => one(nerfstudio::FILE, nerfstudio::text(dir, rig)?),
            Self::Qualisys => one("calibration.qca.txt", qualisys::text(dir, rig)?),
            Self::Anipose => one(anipose::FILE, anipose::text(rig)),
            Self::Mrcal => mrcal::files(dir, rig)?,
        };
        for (name, bytes) in &files {
            let path = dir.join(name);
            write_whole(&path, |out| out.write_all(bytes))
                .map_err(|error| CalibError::Write { path, reason: error.to_string() })?;
        }
        Ok(files.into_iter().map(|(name, _)| name).collect())
    }
}

/// Returns the chain of a folder: Kalibr names it after the recording, and OpenVINS otherwise.
fn kalibr_file(path: &Path) -> Result<PathBuf, CalibError> {
    let known = inside(path, &[kalibr::FILE]);
    if !path.is_dir() || known.is_file() {
        return Ok(known);
    }
    let is_chain = |file: &PathBuf| calibration_file::read(file).is_ok_and(|text| kalibr::is_chain(&text));
    let files = [files_with(path, ".yaml")?, files_with(path, ".yml")?].concat();
    let mut chains = files.into_iter().filter(is_chain);
    match (chains.next(), chains.next()) {
        (Some(file), None) => Ok(file),
        (Some(_), Some(_)) => Err(bad(path, "holds several camera chains; name one")),
        (None, _) => Ok(known),
    }
}
