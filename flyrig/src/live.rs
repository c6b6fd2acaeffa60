//! Real cameras: from the configuration to sources.

use anyhow::Result;
use flyrig_calib::load_calibration;
use flyrig_capture::{CameraOptions, CameraSource, CaptureError, NokhwaCamera, SourceOpener};
use flyrig_types::{CameraId, Rig};

use crate::{
    cameras::{CameraEntry, DeviceOptions},
    config::SourceSection,
};

/// Reads the calibration; where its files do not say how large the pictures are, the configuration does, and where both do,
/// they must agree.
pub fn load_rig(source: &SourceSection) -> Result<Rig> {
    let size = |id: &CameraId| {
        let entry = source.cameras.iter().find(|entry| entry.name() == id.as_str())?;
        entry.device().ok().map(|section| (section.size[0], section.size[1]))
    };
    Ok(load_calibration(source.calibration_folder().unwrap_or(&source.path), &size)?)
}

/// Returns an opener for every camera of the configuration; the images come in the cameras' own formats.
///
/// # Errors
/// Settings that no camera could be opened with. A camera that is missing is no error: it joins when it comes.
pub fn openers(source: &SourceSection) -> Result<Vec<SourceOpener>> {
    let opener = |entry: &CameraEntry| -> Result<SourceOpener> {
        let id = CameraId::from(entry.name());
        let options = entry.device()?.options()?;
        #[cfg(not(target_os = "linux"))]
        if let DeviceOptions::V4l2(options) = &options {
            let identity = &options.identity;
            anyhow::bail!("camera {id}: {identity} needs Linux; name it by its name or number in the key nokhwa");
        }
        let of_thread = id.clone();
        Ok(SourceOpener::new(&id, move || {
            let camera = open(&of_thread, &options)?;
            tracing::info!("camera {of_thread}: {}", camera.health().mode);
            Ok(camera)
        }))
    };
    source.cameras.iter().map(opener).collect()
}

fn open(camera: &CameraId, options: &DeviceOptions) -> Result<Box<dyn CameraSource>, CaptureError> {
    Ok(match options {
        DeviceOptions::V4l2(options) => open_v4l2(camera, options)?,
        DeviceOptions::Nokhwa(options) => Box::new(NokhwaCamera::open(camera, options)?),
    })
}

#[cfg(target_os = "linux")]
fn open_v4l2(camera: &CameraId, options: &CameraOptions) -> Result<Box<dyn CameraSource>, CaptureError> {
    Ok(Box::new(flyrig_capture::V4l2Camera::open(camera, options)?))
}

/// Only Linux has V4L2; [`openers`] refuses such a camera.
#[cfg(not(target_os = "linux"))]
fn open_v4l2(camera: &CameraId, _options: &CameraOptions) -> Result<Box<dyn CameraSource>, CaptureError> {
    Err(CaptureError::new(camera, flyrig_capture::CaptureErrorKind::Unsupported, "V4L2 needs Linux"))
}
