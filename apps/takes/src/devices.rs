//! Real cameras: from the configuration to sources.

use anyhow::Result;
use flyrig_calib::load_calibration;
use flyrig_capture::SourceOpener;
use flyrig_types::{CameraId, Rig};

use crate::{cameras::CameraEntry, config::SourceSection};

/// Reads the calibration; where its files do not say how large the images are, the configuration does, and where both do,
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
        let of_thread = id.clone();
        Ok(SourceOpener::new(&id, move || {
            let camera = options.open(&of_thread)?;
            tracing::info!("camera {of_thread}: {}", camera.health().mode);
            Ok(camera)
        }))
    };
    source.cameras.iter().map(opener).collect()
}
