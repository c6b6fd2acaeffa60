//! Real cameras: from the configuration to sources.

use anyhow::Result;
use flyrig_calib::load_easymocap;
use flyrig_capture::{CameraOptions, CameraSource, NokhwaCamera};
use flyrig_types::{CameraId, Rig};

use crate::{cameras::DeviceOptions, config::SourceSection};

/// The calibration; where its files do not say how large the pictures are, the configuration does, and where both do,
/// they must agree.
pub fn load_rig(source: &SourceSection) -> Result<Rig> {
    let size = |id: &CameraId| {
        let entry = source.cameras.iter().find(|entry| entry.name() == id.as_str())?;
        entry.device().ok().map(|section| (section.size[0], section.size[1]))
    };
    Ok(load_easymocap(&source.path, &size)?)
}

/// Opens every camera of the configuration; the pictures come in the cameras' own formats.
pub fn open(source: &SourceSection) -> Result<Vec<Box<dyn CameraSource>>> {
    let mut sources: Vec<Box<dyn CameraSource>> = Vec::new();
    for entry in &source.cameras {
        let id = entry.name().into();
        let camera = match entry.device()?.options()? {
            DeviceOptions::V4l2(options) => open_v4l2(&id, &options)?,
            DeviceOptions::Nokhwa(options) => Box::new(NokhwaCamera::open(&id, &options)?),
        };
        eprintln!("camera {}: {}", entry.name(), camera.health().mode);
        sources.push(camera);
    }
    Ok(sources)
}

#[cfg(target_os = "linux")]
fn open_v4l2(camera: &CameraId, options: &CameraOptions) -> Result<Box<dyn CameraSource>> {
    Ok(Box::new(flyrig_capture::V4l2Camera::open(camera, options)?))
}

/// Only Linux has V4L2.
#[cfg(not(target_os = "linux"))]
fn open_v4l2(camera: &CameraId, options: &CameraOptions) -> Result<Box<dyn CameraSource>> {
    anyhow::bail!("camera {camera}: {} needs Linux; name it by its name or number in the key nokhwa", options.identity)
}
