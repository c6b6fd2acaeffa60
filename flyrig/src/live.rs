//! Real cameras: from the configuration to sources.

use anyhow::Result;
use flyrig_calib::load_easymocap;
use flyrig_capture::CameraSource;
use flyrig_types::Rig;

use crate::config::SourceSection;

/// The calibration; where its files do not say how large the pictures are, the configuration does, and where both do,
/// they must agree.
pub fn load_rig(source: &SourceSection) -> Result<Rig> {
    let size = |id: &flyrig_types::CameraId| {
        let entry = source.cameras.iter().find(|entry| entry.name() == id.as_str())?;
        entry.device().ok().map(|section| (section.size[0], section.size[1]))
    };
    Ok(load_easymocap(&source.path, &size)?)
}

/// Opens every camera of the configuration; the pictures come in the cameras' own formats.
#[cfg(target_os = "linux")]
pub fn open(source: &SourceSection) -> Result<Vec<Box<dyn CameraSource>>> {
    use flyrig_capture::V4l2Camera;

    let mut sources: Vec<Box<dyn CameraSource>> = Vec::new();
    for entry in &source.cameras {
        let camera = V4l2Camera::open(&entry.name().into(), &entry.device()?.options()?)?;
        eprintln!("camera {}: {}", entry.name(), camera.health().mode);
        sources.push(Box::new(camera));
    }
    Ok(sources)
}

/// Only Linux has V4L2.
#[cfg(not(target_os = "linux"))]
pub fn open(_source: &SourceSection) -> Result<Vec<Box<dyn CameraSource>>> {
    anyhow::bail!("source.kind \"v4l2\" needs Linux")
}
