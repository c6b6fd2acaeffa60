//! OpenCV's FileStorage with errors that name the file, and without OpenCV's own words on stderr.

use std::path::{Path, PathBuf};

use flyrig_types::CameraId;
use opencv::{
    core::{
        CV_64F, FileNodeTraitConst, FileStorage, FileStorage_MEMORY, FileStorage_READ, FileStorage_WRITE,
        FileStorageTrait, FileStorageTraitConst, LogLevel, Mat, MatTraitConst, Vector, set_log_level,
    },
    prelude::MatTraitConstManual,
};

use crate::CalibError;

/// A matrix of a file, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Matrix {
    pub rows: usize,
    pub cols: usize,
    pub values: Vec<f64>,
}

/// A parsed file.
pub(crate) struct YamlFile {
    path: PathBuf,
    storage: FileStorage,
}

/// OpenCV prints what it also returns; the user shall see one error.
fn silence_opencv() {
    // Fails only without the logger, and then there is nothing to silence.
    let _ = set_log_level(LogLevel::LOG_LEVEL_SILENT);
}

fn reason(error: &opencv::Error) -> String {
    // "OpenCV(4.6.0) file:line: error: (-49:Unknown error code -49) text in function 'f'": the text.
    let text = error.message.rsplit_once(") ").map_or(error.message.as_str(), |(_, text)| text);
    text.split(" in function").next().unwrap_or(text).trim().to_owned()
}

impl YamlFile {
    pub fn open(path: PathBuf) -> Result<Self, CalibError> {
        silence_opencv();
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(source) => return Err(CalibError::Read { path, source }),
        };
        let parse = |path: &Path, reason: String| CalibError::Parse { path: path.to_owned(), reason };
        let Ok(text) = String::from_utf8(bytes) else { return Err(parse(&path, "it is not text".to_owned())) };
        if text.contains('\0') {
            return Err(parse(&path, "it is not text".to_owned()));
        }
        if !text.trim_start().starts_with("%YAML") {
            return Err(parse(&path, "it does not begin with %YAML".to_owned()));
        }
        match FileStorage::new_def(&text, FileStorage_READ | FileStorage_MEMORY) {
            Ok(storage) if storage.is_opened().unwrap_or(false) => Ok(Self { path, storage }),
            Ok(_) => Err(parse(&path, "nothing in it".to_owned())),
            Err(error) => Err(parse(&path, reason(&error))),
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    fn parse_error(&self, error: &opencv::Error) -> CalibError {
        CalibError::Parse { path: self.path.clone(), reason: reason(error) }
    }

    /// Every key of the top level.
    pub fn keys(&self) -> Result<Vec<String>, CalibError> {
        let root = self.storage.root_def().map_err(|error| self.parse_error(&error))?;
        if !root.is_map().unwrap_or(false) {
            return Err(CalibError::Parse { path: self.path.clone(), reason: "no keys in it".to_owned() });
        }
        Ok(root.keys().map_err(|error| self.parse_error(&error))?.iter().collect())
    }

    /// A list of strings; `None` when it is missing or holds anything else (YAML reads a bare 00 as
    /// the number 0).
    pub fn strings(&self, key: &str) -> Option<Vec<String>> {
        let node = self.storage.get(key).ok()?;
        let count = node.is_seq().ok()?.then(|| node.size().ok())??;
        (0..i32::try_from(count).ok()?)
            .map(|i| {
                let entry = node.at(i).ok()?;
                entry.is_string().ok()?.then(|| entry.string().ok())?
            })
            .collect()
    }

    /// A number; `None` when it is missing or no number.
    pub fn number(&self, key: &str) -> Option<f64> {
        let node = self.storage.get(key).ok()?;
        let is_number = node.is_int().ok()? || node.is_real().ok()?;
        is_number.then(|| node.real().ok())?
    }

    /// A matrix of finite numbers, `None` when the key is missing.
    pub fn matrix(&self, camera: &CameraId, key: &str) -> Result<Option<Matrix>, CalibError> {
        let broken = |problem: String| CalibError::Value {
            path: self.path.clone(),
            camera: camera.clone(),
            key: key.to_owned(),
            problem,
            mend: "export or redo the calibration of this camera",
        };
        let node = self.storage.get(key).map_err(|error| self.parse_error(&error))?;
        if node.is_none().unwrap_or(true) {
            return Ok(None);
        }
        if !node.is_map().unwrap_or(false) {
            return Err(broken("is not a matrix".to_owned()));
        }
        let read = || -> opencv::Result<Matrix> {
            let stored = node.mat()?;
            let mut mat = Mat::default();
            stored.convert_to_def(&mut mat, CV_64F)?;
            let values = if mat.empty() { Vec::new() } else { mat.data_typed::<f64>()?.to_vec() };
            Ok(Matrix { rows: mat.rows().max(0) as usize, cols: mat.cols().max(0) as usize, values })
        };
        let matrix = read().map_err(|error| broken(format!("cannot be read as a matrix ({})", reason(&error))))?;
        match matrix.values.iter().find(|value| !value.is_finite()) {
            Some(value) => Err(broken(format!("holds {value}, not a finite number"))),
            None => Ok(Some(matrix)),
        }
    }
}

/// A file in the making.
pub(crate) struct YamlWriter {
    path: PathBuf,
    storage: FileStorage,
}

impl YamlWriter {
    pub fn new(path: PathBuf) -> Result<Self, CalibError> {
        silence_opencv();
        match FileStorage::new_def("rig.yml", FileStorage_WRITE | FileStorage_MEMORY) {
            Ok(storage) => Ok(Self { path, storage }),
            Err(error) => Err(CalibError::Write { path, reason: reason(&error) }),
        }
    }

    fn checked<T>(&self, result: opencv::Result<T>) -> Result<T, CalibError> {
        result.map_err(|error| CalibError::Write { path: self.path.clone(), reason: reason(&error) })
    }

    pub fn strings<'a>(&mut self, key: &str, values: impl Iterator<Item = &'a str>) -> Result<(), CalibError> {
        let written = self.storage.write_str_vec(key, &Vector::<String>::from_iter(values));
        self.checked(written)
    }

    pub fn integer(&mut self, key: &str, value: u32) -> Result<(), CalibError> {
        let written = i32::try_from(value)
            .map_err(|_| opencv::Error::new(0, format!("{key} is too large")))
            .and_then(|value| self.storage.write_i32(key, value));
        self.checked(written)
    }

    pub fn matrix(&mut self, key: &str, cols: usize, values: &[f64]) -> Result<(), CalibError> {
        let rows = values.len() / cols.max(1);
        let written = Mat::new_rows_cols_with_data(rows as i32, cols as i32, values)
            .and_then(|mat| self.storage.write_mat(key, &mat));
        self.checked(written)
    }

    pub fn finish(mut self) -> Result<(), CalibError> {
        let text = self.storage.release_and_get_string();
        let text = self.checked(text)?;
        std::fs::write(&self.path, text)
            .map_err(|error| CalibError::Write { path: self.path.clone(), reason: error.to_string() })
    }
}
