//! Cameras read from a foreign file.

use std::path::Path;

use flyrig_types::{Camera, CameraId, ColorMatch, Intrinsics, Isometry, Rig};
use glam::DVec3;

use super::shared::bad;
use crate::error::CalibError;
use crate::up::level_up;

/// Cameras of a file; poses may be unknown.
#[derive(Debug, Clone)]
pub struct Imported {
    /// Cameras in the file's order.
    pub cameras: Vec<ImportedCamera>,
    /// Unit vector against gravity, world axes, where the format contains it.
    pub up: Option<DVec3>,
    /// Statements of the file that flyrig cannot represent and that change no lens or pose, for the user.
    pub warnings: Vec<String>,
}

/// Camera whose pose may be unknown.
#[derive(Debug, Clone)]
pub struct ImportedCamera {
    /// Name.
    pub id: CameraId,
    /// Lens and sensor.
    pub intrinsics: Intrinsics,
    /// World to camera axes, metres.
    pub pose: Option<Isometry>,
    /// See [`Camera::time_offset_nanos`].
    pub time_offset_nanos: i64,
    /// See [`Camera::color`].
    pub color: ColorMatch,
}

impl ImportedCamera {
    /// Creates a camera whose name is set later.
    pub(super) fn unnamed(intrinsics: Intrinsics, pose: Option<Isometry>) -> Self {
        Self { id: CameraId::from(""), intrinsics, pose, time_offset_nanos: 0, color: ColorMatch::NONE }
    }

    pub(super) fn scale(&mut self, scale: f64) {
        if let Some(pose) = &mut self.pose {
            pose.translation *= scale;
        }
    }

    pub(super) fn check(&self, path: &Path) -> Result<(), CalibError> {
        self.camera(self.pose.unwrap_or(Isometry::IDENTITY))
            .validate()
            .map_err(|source| CalibError::Camera { path: path.to_owned(), source })
    }

    fn camera(&self, camera_from_world: Isometry) -> Camera {
        Camera {
            id: self.id.clone(),
            intrinsics: self.intrinsics,
            camera_from_world,
            time_offset_nanos: self.time_offset_nanos,
            color: self.color,
        }
    }
}

impl Imported {
    /// Returns cameras of a file that raised no warnings. `up` is a unit vector against gravity, world axes, where it is known.
    #[must_use]
    pub fn new(cameras: Vec<ImportedCamera>, up: Option<DVec3>) -> Self {
        Self { cameras, up, warnings: Vec::new() }
    }

    /// Returns the rig, with an estimate of the up direction where the file lacks it; `None` where no camera has a
    /// pose.
    ///
    /// # Errors
    /// Names the camera without a pose, where others have one.
    pub fn rig(&self, path: &Path) -> Result<Option<Rig>, CalibError> {
        if self.cameras.iter().all(|camera| camera.pose.is_none()) {
            return Ok(None);
        }
        let posed = |camera: &ImportedCamera| {
            let pose = camera.pose.ok_or_else(|| {
                let text = format!(
                    "camera {} has no pose, but others have; calibrate it with them, or take it out",
                    camera.id
                );
                bad(path, text)
            })?;
            Ok(camera.camera(pose))
        };
        let cameras = self.cameras.iter().map(posed).collect::<Result<Vec<_>, _>>()?;
        let world_up = self.up.unwrap_or_else(|| level_up(&cameras));
        Ok(Some(Rig { cameras, world_up }))
    }

    /// Returns the lenses.
    #[must_use]
    pub fn lenses(&self) -> Vec<(CameraId, Intrinsics)> {
        self.cameras.iter().map(|camera| (camera.id.clone(), camera.intrinsics)).collect()
    }
}
