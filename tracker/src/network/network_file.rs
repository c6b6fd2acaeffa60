//! The file that describes a landmark network of the user's choice.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::error::{TrackError, TrackErrorKind};
use crate::landmarks::keypoints::{LANDMARK_COUNT, LANDMARK_NAMES, LEFT_HIP, LEFT_SHOULDER, RIGHT_HIP, RIGHT_SHOULDER};

/// Least number of landmarks of a network; hips and shoulders must be among them.
const LEAST_LANDMARKS: usize = 8;
/// Longest side of an input, pixels.
const LONGEST_SIDE: usize = 1024;
/// Largest ONNX file, bytes.
const MOST_BYTES: u64 = 1 << 30;

/// Description of a network: format of its input, and form and names of its landmarks.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct NetworkFile {
    /// ONNX file, relative to the description unless absolute.
    pub file: PathBuf,
    /// Width and height of the input, pixels; needed where the ONNX file leaves them open.
    pub input: Option<[usize; 2]>,
    /// Order of the input's channels.
    #[serde(default)]
    pub channels: Channels,
    /// Mean of each channel, subtracted from the bytes 0 to 255, in the order of the channels.
    #[serde(default)]
    pub mean: [f32; 3],
    /// Divisor of each channel after the mean is subtracted.
    #[serde(default = "bytes")]
    pub deviation: [f32; 3],
    /// Form of the output.
    pub output: OutputForm,
    /// Meaning of each number of a landmark in an output of points.
    #[serde(default = "xy_confidence")]
    pub point: Vec<PointValue>,
    /// Unit of those points.
    #[serde(default)]
    pub unit: Unit,
    /// Value of the confidence that counts as certain.
    #[serde(default = "one")]
    pub certain: f64,
    /// Index of each landmark in the output, by its name.
    pub landmarks: BTreeMap<String, usize>,
}

/// Order of colour channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Channels {
    #[default]
    Rgb,
    Bgr,
}

/// Form of a network's output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum OutputForm {
    /// One array of landmarks, a few numbers each.
    Points,
    /// One heatmap per landmark, with its peak at the landmark.
    Heatmaps,
    /// One row of bins along x and one along y per landmark, with their peaks at the landmark (SimCC, Li et al. 2022).
    Simcc,
}

/// Meaning of one number of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum PointValue {
    X,
    Y,
    /// 0..=1.
    Confidence,
    /// Log-odds of the confidence.
    Logit,
    /// Not used.
    Skip,
}

/// Unit of points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Unit {
    /// Pixels of the input, 0 at its border.
    #[default]
    Pixels,
    /// Shares of the input's width and height.
    Share,
}

/// Returns the default divisors, which map bytes to 0..=1.
fn bytes() -> [f32; 3] {
    [255.0; 3]
}

fn xy_confidence() -> Vec<PointValue> {
    vec![PointValue::X, PointValue::Y, PointValue::Confidence]
}

fn one() -> f64 {
    1.0
}

/// Returns an error that names a file.
fn failed(file: &Path, what: impl std::fmt::Display) -> TrackError {
    TrackError::new(TrackErrorKind::Net, format!("{}: {what}", file.display()))
}

/// Reads an ONNX file of a plausible size.
///
/// # Errors
/// Kind [`TrackErrorKind::Net`] names the file.
pub(crate) fn read_onnx(path: &Path) -> Result<Vec<u8>, TrackError> {
    let length = std::fs::metadata(path).map_err(|error| failed(path, error))?.len();
    if length > MOST_BYTES {
        return Err(failed(path, format!("{length} bytes are too many for a landmark network; at most {MOST_BYTES}")));
    }
    std::fs::read(path).map_err(|error| failed(path, error))
}

impl NetworkFile {
    /// Reads a description and the ONNX file that it names.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] names the file, and the key where one is wrong.
    pub fn read(path: &Path) -> Result<(Self, Vec<u8>), TrackError> {
        let text = std::fs::read_to_string(path).map_err(|error| failed(path, error))?;
        let described = Self::parse(&text).map_err(|what| failed(path, what))?;
        let onnx = path.parent().unwrap_or(Path::new("")).join(&described.file);
        let bytes = read_onnx(&onnx)?;
        Ok((described, bytes))
    }

    /// Parses and checks a description.
    pub fn parse(text: &str) -> Result<Self, String> {
        let described: Self = toml::from_str(text).map_err(|error| error.to_string().trim_end().to_owned())?;
        described.check()?;
        Ok(described)
    }

    /// Checks ranges and names.
    fn check(&self) -> Result<(), String> {
        let sides = self.input.unwrap_or([1, 1]);
        if sides.iter().any(|side| !(1..=LONGEST_SIDE).contains(side)) {
            return Err(format!("input is {sides:?}, expected a width and a height of 1 to {LONGEST_SIDE} pixels"));
        }
        if !self.mean.iter().all(|mean| mean.is_finite()) {
            return Err(format!("mean is {:?}, expected finite numbers", self.mean));
        }
        if !self.deviation.iter().all(|deviation| deviation.is_finite() && *deviation > 0.0) {
            return Err(format!("deviation is {:?}, expected numbers above 0", self.deviation));
        }
        if !(self.certain.is_finite() && self.certain > 0.0) {
            return Err(format!("certain is {}, expected a number above 0", self.certain));
        }
        let has = |number| self.point.iter().filter(|own| **own == number).count() == 1;
        if !(has(PointValue::X) && has(PointValue::Y)) {
            return Err(
                "point needs \"x\" and \"y\" once each, beside \"confidence\", \"logit\" or \"skip\"".to_owned()
            );
        }
        let indices = self.indices()?;
        if indices.iter().flatten().count() < LEAST_LANDMARKS {
            return Err(format!("landmarks has {} entries, expected {LEAST_LANDMARKS} or more", self.landmarks.len()));
        }
        for needed in [LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_HIP, RIGHT_HIP] {
            if indices[needed].is_none() {
                return Err(format!("landmarks has no \"{}\"; crops need it", LANDMARK_NAMES[needed]));
            }
        }
        Ok(())
    }

    /// Returns the index of each body landmark in the output.
    pub fn indices(&self) -> Result<[Option<usize>; LANDMARK_COUNT], String> {
        let mut indices = [None; LANDMARK_COUNT];
        for (name, index) in &self.landmarks {
            let Some(landmark) = LANDMARK_NAMES.iter().position(|own| own == name) else {
                return Err(format!("landmarks: there is no \"{name}\"; names are {}", LANDMARK_NAMES.join(", ")));
            };
            indices[landmark] = Some(*index);
        }
        Ok(indices)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = r#"
        file = "pose.onnx"
        output = "simcc"
        [landmarks]
        nose = 0
        "left shoulder" = 5
        "right shoulder" = 6
        "left elbow" = 7
        "right elbow" = 8
        "left hip" = 11
        "right hip" = 12
        "left knee" = 13
    "#;

    #[test]
    fn a_description_is_read_and_defaults_are_bytes_to_one() {
        let described = NetworkFile::parse(GOOD).unwrap();
        assert_eq!(
            (described.output, described.channels, described.unit),
            (OutputForm::Simcc, Channels::Rgb, Unit::Pixels)
        );
        assert_eq!(described.deviation.map(f32::to_bits), [255.0f32; 3].map(f32::to_bits));
        let indices = described.indices().unwrap();
        assert_eq!((indices[0], indices[LEFT_HIP], indices[32]), (Some(0), Some(11), None));
    }

    #[test]
    fn every_fault_names_its_key() {
        for (from, to, expected) in [
            ("output = \"simcc\"", "output = \"boxes\"", "boxes"),
            ("output = \"simcc\"", "output = \"simcc\"\nsize = 3", "size"),
            ("output = \"simcc\"", "output = \"simcc\"\ninput = [0, 256]", "input"),
            ("output = \"simcc\"", "output = \"simcc\"\ninput = [192, 99999]", "input"),
            ("output = \"simcc\"", "output = \"simcc\"\nmean = [nan, 0, 0]", "mean"),
            ("output = \"simcc\"", "output = \"simcc\"\ndeviation = [1, 0, 1]", "deviation"),
            ("output = \"simcc\"", "output = \"simcc\"\ncertain = 0", "certain"),
            ("output = \"simcc\"", "output = \"points\"\npoint = [\"x\", \"skip\"]", "point"),
            ("nose", "snout", "snout"),
            ("\"left hip\" = 11", "\"left ankle\" = 11", "left hip"),
            ("nose = 0", "", "8 or more"),
            ("nose = 0", "nose = -1", "-1"),
        ] {
            assert!(GOOD.contains(from), "{from}");
            let error = NetworkFile::parse(&GOOD.replacen(from, to, 1)).unwrap_err();
            assert!(error.contains(expected), "{to}: {error}");
        }
    }

    #[test]
    fn missing_files_are_named() {
        let folder = std::env::temp_dir().join(format!("flyrig-network-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("net.toml");
        let missing = NetworkFile::read(&path).unwrap_err().to_string();
        assert!(missing.contains("net.toml"), "{missing}");
        std::fs::write(&path, GOOD).unwrap();
        let missing = NetworkFile::read(&path).unwrap_err().to_string();
        assert!(missing.contains("pose.onnx"), "{missing}");
        std::fs::remove_dir_all(folder).unwrap();
    }
}
