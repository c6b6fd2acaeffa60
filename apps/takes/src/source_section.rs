//! `[source]`: where the frames of a configuration come from.

use std::{
    fmt,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, Result, ensure};
use flyrig_capture::{DeviceSettings, Pacing};
use flyrig_fusion::InputFormat;
use flyrig_types::{CameraId, Rig};
use serde::{
    Deserialize, Deserializer, Serialize,
    de::{MapAccess, Visitor, value::MapAccessDeserializer},
};

use crate::{dataset, footage::Footage};

/// Kind of `[source]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SourceKind {
    /// Simulated rig.
    Sim,
    /// Folder of images.
    Folder,
    /// Folder of videos, one per camera.
    Video,
    /// Cameras of this computer.
    #[serde(alias = "v4l2")]
    Cameras,
    /// Cameras of other computers.
    Network,
    /// Recording of `flyrig record`.
    Mcap,
}

impl SourceKind {
    /// Returns whether frames arrive as they are captured, with timestamps of this computer's clock.
    #[must_use]
    pub fn is_live(self) -> bool {
        matches!(self, Self::Cameras | Self::Network)
    }

    /// Returns the format of the images that the cameras deliver.
    #[must_use]
    pub fn input_format(self, rig: &Rig) -> InputFormat<'_> {
        match self {
            Self::Cameras | Self::Network | Self::Mcap => InputFormat::OfRig(rig),
            Self::Folder | Self::Video | Self::Sim => InputFormat::Rgb,
        }
    }
}

/// Section `[source]`; its keys are explained in the configuration that `flyrig config print` writes.
///
/// ```
/// use flyrig_takes::{SourceKind, SourceSection};
///
/// let source = SourceSection { kind: SourceKind::Folder, path: "data/walk".into(), ..SourceSection::default() };
/// source.validate()?;
/// assert_eq!(source.names(), ["00", "03", "05"]);
/// assert_eq!(source.calibration_folder(), Some("data/walk".as_ref()));
/// # anyhow::Ok(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SourceSection {
    /// Kind of source.
    pub kind: SourceKind,
    /// Folder or recording with the frames; folder of the calibration for real cameras.
    pub path: PathBuf,
    /// Folder of the calibration; empty if it lies in `path`.
    pub calibration: PathBuf,
    /// Chosen cameras; empty for all cameras.
    pub cameras: Vec<CameraEntry>,
    /// Frame rate of a folder of images, frames per second.
    pub fps: f64,
    /// Whether frames are delivered at the pace of their timestamps, whether or not the program keeps up.
    pub real_time: bool,
}

impl SourceSection {
    /// Returns the names of the chosen cameras; empty for all cameras.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        self.cameras.iter().map(|entry| entry.name().to_owned()).collect()
    }

    /// Returns the folder of the calibration; `None` if the recording holds it.
    #[must_use]
    pub fn calibration_folder(&self) -> Option<&Path> {
        let named = Some(self.calibration.as_path()).filter(|folder| !folder.as_os_str().is_empty());
        named.or((self.kind != SourceKind::Mcap).then_some(self.path.as_path()))
    }

    /// Returns whether a calibration is named or lies in the folder, damaged or not.
    #[must_use]
    pub fn has_calibration(&self) -> bool {
        !self.calibration.as_os_str().is_empty()
            || !self.path.as_os_str().is_empty() && dataset::has_calibration(&self.path)
    }

    /// Returns the stored footage of these cameras; `None` for simulated and live cameras.
    #[must_use]
    pub fn footage(&self, cameras: &[CameraId]) -> Option<Footage> {
        match self.kind {
            SourceKind::Folder => Some(Footage::Folder(self.path.clone())),
            SourceKind::Mcap => Some(Footage::Recording(self.path.clone())),
            SourceKind::Video => {
                Some(Footage::Videos(cameras.iter().map(|id| dataset::video_file(&self.path, id)).collect()))
            }
            SourceKind::Sim | SourceKind::Cameras | SourceKind::Network => None,
        }
    }

    /// Returns the pace at which frames are delivered to a session.
    #[must_use]
    pub fn pacing(&self) -> Pacing {
        match (self.real_time, self.kind) {
            // A real camera does not wait.
            (_, SourceKind::Cameras | SourceKind::Network) => Pacing::AsDelivered,
            (false, _) => Pacing::Lossless,
            // Simulated cameras keep the time themselves, whatever their timestamps are.
            (true, SourceKind::Sim) => Pacing::AsDelivered,
            (true, _) => Pacing::RealTime,
        }
    }

    /// Checks the entries of `cameras` against the kind of source.
    ///
    /// # Errors
    /// Names the camera and the key that are wrong.
    pub fn validate(&self) -> Result<()> {
        for (i, entry) in self.cameras.iter().enumerate() {
            let name = entry.name();
            CameraId::from(name).check().context("in source.cameras")?;
            ensure!(
                self.cameras[..i].iter().all(|before| before.name() != name),
                "camera {name} is listed twice in source.cameras"
            );
            match entry {
                CameraEntry::Named(_) if self.kind == SourceKind::Cameras => {
                    entry.device()?;
                }
                CameraEntry::Named(_) => {}
                CameraEntry::Device(section) => {
                    ensure!(
                        self.kind == SourceKind::Cameras,
                        "camera {name} of source.cameras is a table, but source.kind is not \"cameras\""
                    );
                    section.check()?;
                }
            }
        }
        ensure!(
            self.kind != SourceKind::Network || !self.cameras.is_empty(),
            "source.kind is \"network\" but source.cameras names no camera"
        );
        ensure!(
            self.kind != SourceKind::Cameras || !self.cameras.is_empty(),
            "source.kind is \"cameras\" but there is no table [[source.cameras]]"
        );
        Ok(())
    }
}

impl Default for SourceSection {
    fn default() -> Self {
        Self {
            kind: SourceKind::Sim,
            path: PathBuf::new(),
            calibration: PathBuf::new(),
            cameras: ["00", "03", "05"].map(|name| CameraEntry::Named(name.to_owned())).to_vec(),
            fps: 30.0,
            real_time: true,
        }
    }
}

/// Entry of `source.cameras`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum CameraEntry {
    /// Name of a simulated, recorded or remote camera.
    Named(String),
    /// Table of a camera of this computer.
    Device(Box<DeviceSettings>),
}

/// Written by hand: a derived untagged enum does not name unknown keys in its errors.
impl<'de> Deserialize<'de> for CameraEntry {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Entry;
        impl<'de> Visitor<'de> for Entry {
            type Value = CameraEntry;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of a camera, or a table [[source.cameras]] of a real one")
            }

            fn visit_str<E>(self, name: &str) -> Result<CameraEntry, E> {
                Ok(CameraEntry::Named(name.to_owned()))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<CameraEntry, A::Error> {
                DeviceSettings::deserialize(MapAccessDeserializer::new(map))
                    .map(|section| CameraEntry::Device(Box::new(section)))
            }
        }
        deserializer.deserialize_any(Entry)
    }
}

impl CameraEntry {
    /// Returns the camera's name in the rig.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Named(name) => name,
            Self::Device(section) => &section.name,
        }
    }

    /// Returns the table of a real camera.
    ///
    /// # Errors
    /// The entry is only a name; explains the table to write.
    pub fn device(&self) -> Result<&DeviceSettings> {
        match self {
            Self::Device(section) => Ok(section),
            Self::Named(name) => anyhow::bail!(
                "source.kind is \"cameras\", but camera {name} of source.cameras is only a name; write a table \
                 [[source.cameras]] with name, size, and one of serial, path, bus and nokhwa (`flyrig doctor` lists them)"
            ),
        }
    }
}
