//! Cameras of this computer, from their configuration to sources.

use anyhow::Result;
use flyrig_calib::load_calibration;
use flyrig_capture::SourceOpener;
use flyrig_types::{CameraId, Rig};

use crate::{
    dataset,
    source_section::{CameraEntry, SourceSection},
};

/// Loads the calibration of live cameras. Image sizes that its files lack come from the configuration; sizes in both must agree.
pub(crate) fn load_rig(source: &SourceSection) -> Result<Rig> {
    let size = |id: &CameraId| {
        let entry = source.cameras.iter().find(|entry| entry.name() == id.as_str())?;
        entry.device().ok().map(|section| (section.size[0], section.size[1]))
    };
    let folder = source.calibration_folder().unwrap_or(&source.path);
    dataset::require_calibration(folder)?;
    Ok(load_calibration(folder, &size)?)
}

/// Returns an opener for every camera of the configuration; images keep the cameras' own formats.
///
/// # Errors
/// Settings with which no camera can be opened. A missing camera is no error: it joins once it is plugged in.
pub(crate) fn openers(source: &SourceSection) -> Result<Vec<SourceOpener>> {
    let opener = |entry: &CameraEntry| -> Result<SourceOpener> {
        let id = CameraId::from(entry.name());
        let options = entry.device()?.options()?;
        let thread_id = id.clone();
        Ok(SourceOpener::new(&id, move || {
            let camera = options.open(&thread_id)?;
            tracing::info!("camera {thread_id}: {}", camera.health().mode);
            Ok(camera)
        }))
    };
    source.cameras.iter().map(opener).collect()
}
