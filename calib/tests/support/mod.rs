//! Folders with files of other programs.
#![allow(clippy::unwrap_used, dead_code, reason = "helpers of tests")]

use std::{fs, path::Path};

use flyrig_calib::{Format, Imported};
use flyrig_types::{CameraId, Lens, Rig};

pub const NO_SIZE: fn(&CameraId) -> Option<(u32, u32)> = |_| None;
/// The lens k1 to k4 of the angle of these tests, and that of the same numbers as k1 k2 p1 p2.
pub const FISHEYE: Lens = Lens::Fisheye { coefficients: [0.05, -0.02, 0.006, 0.001] };
pub const RADIAL: Lens = Lens::RadialTangential { radial: [0.05, -0.02, 0.0], tangential: [0.006, 0.001] };

/// File of a test: a name, which may contain folders, and bytes.
pub type File<'a> = (&'a str, &'a [u8]);

pub fn folder(files: &[File<'_>]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let path = dir.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
    dir
}

/// Reads a folder whose format is found by itself.
pub fn read(format: Format, files: &[File<'_>]) -> Result<Imported, String> {
    let dir = folder(files);
    assert_eq!(Format::detect(dir.path()), Some(format), "{:?}", files.iter().map(|file| file.0).collect::<Vec<_>>());
    format.read(dir.path(), &NO_SIZE, 1.0).map_err(|error| error.to_string())
}

pub fn rig(format: Format, files: &[File<'_>]) -> Rig {
    read(format, files).unwrap().rig(Path::new("x")).unwrap().unwrap()
}

pub fn names(rig: &Rig) -> Vec<&str> {
    rig.cameras.iter().map(|camera| camera.id.as_str()).collect()
}

/// Asserts that a file is refused with a text that holds all of these words.
pub fn refused(format: Format, name: &str, text: &str, words: &[&str]) {
    let dir = folder(&[(name, text.as_bytes())]);
    let error = format.read(&dir.path().join(name), &NO_SIZE, 1.0).unwrap_err().to_string();
    assert!(words.iter().all(|word| error.contains(word)), "{words:?}: {error}");
}
