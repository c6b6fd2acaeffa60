//! Cameras of a configuration, with their calibration and the body of the person.

use std::{
    path::PathBuf,
    sync::{Arc, Mutex},
};

use anyhow::{Context as _, Result};
use flyrig_body::{ShapeParams, default_template, load_gltf};
use flyrig_capture::{CameraSource as _, FolderOptions, SourceOpener};
use flyrig_fusion::{Origin, PerceptionSettings};
use flyrig_gpu::GpuContext;
use flyrig_sim::{SimConfig, SimTime, Simulator, camera_ring};
use flyrig_sync::SyncSettings;
use flyrig_transport::TransportConfig;
use flyrig_types::{Camera, CameraId, Image, Rig, ThreadWatch};

use crate::{
    dataset, devices,
    footage::Footage,
    network,
    source_section::{SourceKind, SourceSection},
    take::{Calibration, Needs, Take, TakeBody, ready},
};

/// Sections of a configuration that apply to a take.
#[derive(Debug, Clone)]
pub struct TakeConfig {
    /// Where the frames come from.
    pub source: SourceSection,
    /// Scene of a simulated rig.
    pub sim: SimConfig,
    /// Synchronization of the cameras.
    pub sync: SyncSettings,
    /// Origins of pose, masks and shape, and the plates.
    pub perception: PerceptionSettings,
    /// Skinned glTF file of the body; empty for the built-in one.
    pub template: PathBuf,
    /// Transport session for cameras of other computers.
    pub transport: TransportConfig,
}

impl TakeConfig {
    /// Makes simulated cameras wait for their reader, so that none of their frames is lost.
    #[must_use]
    pub fn lossless(mut self) -> Self {
        self.source.real_time &= self.source.kind != SourceKind::Sim;
        self
    }

    /// Opens the cameras.
    ///
    /// # Errors
    /// Names a file, camera or setting that is missing or wrong.
    pub(crate) fn open(&self, needs: Needs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Take> {
        let kind = self.source.kind;
        if kind == SourceKind::Cameras && needs == Needs::Frames {
            // Real cameras deliver images without a calibration.
            return Ok(Take { is_live: true, ..Take::from_sources(devices::openers(&self.source)?) });
        }
        let mut take = if kind == SourceKind::Sim { self.open_simulated(&gpu()?)? } else { self.open_calibrated()? };
        if let (Needs::Calibration, Some(calibration)) = (needs, &mut take.calibration) {
            self.load_plates(calibration)?;
            self.check_lags(&calibration.rig)?;
        }
        take.is_live = kind.is_live();
        take.given_masks = self.perception.masks == Origin::Given;
        take.sync = self.sync.clone();
        Ok(take)
    }

    /// Opens the files that the configuration names, without starting cameras, connecting to other computers or drawing: calibration, images,
    /// plates and body, with the names of the cameras.
    ///
    /// # Errors
    /// Names a file, camera or setting that is missing or wrong.
    pub fn check(&self) -> Result<()> {
        let rig = if self.source.kind == SourceKind::Sim {
            dataset::select_cameras(&camera_ring(&self.sim)?, &self.source.names(), "the simulated rig")
                .context("source.cameras ([] takes all)")?
        } else {
            let rig = self.load_rig()?;
            self.open_stored(&rig)?;
            self.load_body()?;
            rig
        };
        self.load_plates(&mut Calibration::without_plates(rig.clone()))?;
        self.check_lags(&rig)
    }

    /// Opens the simulated cameras with the plates of their room.
    fn open_simulated(&self, gpu: &GpuContext) -> Result<Take> {
        let simulator = Simulator::new(gpu, &self.sim)?;
        let (rig, template, track) =
            (simulator.reported_rig(), simulator.template().clone(), simulator.track().clone());
        // An estimator starts without knowledge of the person.
        let knows_shape = self.perception.shape() == Origin::Given;
        let template = if knows_shape { template } else { default_template(&ShapeParams::default())? };
        let rig = dataset::select_cameras(&rig, &self.source.names(), "the simulated rig")
            .context("source.cameras ([] takes all)")?;
        let plates = simulated_plates(&simulator, &rig)?;
        let simulator = Arc::new(Mutex::new(simulator));
        let time = if self.source.real_time { SimTime::Real } else { SimTime::Exact };
        let chosen = flyrig_sim::sources(&simulator, time)
            .into_iter()
            .filter(|source| rig.slot(source.camera()).is_some())
            .map(|source| SourceOpener::ready(Box::new(source)))
            .collect();
        Ok(Take {
            calibration: Some(Calibration { rig, plates }),
            body: Some(TakeBody { template, track: Some(track) }),
            ..Take::from_sources(chosen)
        })
    }

    /// Opens stored or live cameras with their calibration, without plates.
    fn open_calibrated(&self) -> Result<Take> {
        let rig = self.load_rig()?;
        let (sources, threads) = self.open_sources(&rig)?;
        let body = self.load_body()?;
        Ok(Take {
            calibration: Some(Calibration::without_plates(rig)),
            body: Some(body),
            threads,
            ..Take::from_sources(sources)
        })
    }

    fn load_body(&self) -> Result<TakeBody> {
        if self.template.as_os_str().is_empty() {
            return Ok(TakeBody { template: default_template(&ShapeParams::default())?, track: None });
        }
        let human = load_gltf(&self.template).context("body.template")?;
        Ok(TakeBody { template: human.template, track: human.track })
    }

    /// Checks that cameras with a time offset are cameras of the rig.
    fn check_lags(&self, rig: &Rig) -> Result<()> {
        let lagging: Vec<String> = self.sync.lags_nanos.keys().map(CameraId::to_string).collect();
        dataset::select_cameras(rig, &lagging, "the rig, but in sync.lags_ms")?;
        Ok(())
    }

    fn load_rig(&self) -> Result<Rig> {
        let source = &self.source;
        let rig = if source.kind.is_live() {
            devices::load_rig(source)?
        } else {
            let chosen: Vec<CameraId> = source.names().into_iter().map(CameraId::from).collect();
            let footage = source.footage(&chosen);
            if let Some(footage) = &footage {
                footage.check_dataset().context("source.path")?;
            }
            match (source.calibration_folder(), footage) {
                (None, Some(footage)) => footage.load_rig(&chosen)?,
                (folder, footage) => {
                    let folder = folder.unwrap_or(&source.path);
                    let is_recording = matches!(footage, Some(Footage::Recording(_)));
                    dataset::load_rig_of(folder, if is_recording { folder } else { &source.path }, &chosen)?
                }
            }
        };
        dataset::select_cameras(&rig, &source.names(), "the calibration").context("source.cameras ([] takes all)")
    }

    /// Opens one source per camera of the rig, and returns the threads that they need.
    fn open_sources(&self, rig: &Rig) -> Result<(Vec<SourceOpener>, Vec<ThreadWatch>)> {
        if let Some(sources) = self.open_stored(rig)? {
            return Ok((sources, Vec::new()));
        }
        if self.source.kind == SourceKind::Network {
            let (openers, clocks) = network::openers(&self.transport, rig)?;
            return Ok((openers, vec![clocks]));
        }
        Ok((devices::openers(&self.source)?, Vec::new()))
    }

    /// Opens stored cameras; `None` for live ones.
    fn open_stored(&self, rig: &Rig) -> Result<Option<Vec<SourceOpener>>> {
        let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
        let Some(footage) = self.source.footage(&ids) else { return Ok(None) };
        let with_masks = self.perception.masks == Origin::Given;
        if let (true, Some(root)) = (with_masks, footage.folder()) {
            dataset::require_given_masks(root, rig, "set perception.masks = \"estimated\"")?;
        }
        let options = FolderOptions { fps: self.source.fps, with_masks, frames: None };
        Ok(Some(ready(footage.open(Some(&ids), &options)?.sources)))
    }

    /// Loads the plates of stored and live cameras, unless a key colour replaces them.
    fn load_plates(&self, calibration: &mut Calibration) -> Result<()> {
        let folder = self.source.calibration_folder();
        let has_folder = folder.is_some() || !self.perception.plates.as_os_str().is_empty();
        if self.source.kind != SourceKind::Sim && has_folder && self.perception.key_color.is_empty() {
            let folder = folder.unwrap_or(&self.source.path);
            calibration.plates = dataset::load_plates_of(folder, &self.perception, &calibration.rig)?;
        }
        Ok(())
    }
}

/// Renders the simulated room without people, one plate per slot of `inputs`.
///
/// # Errors
/// A camera of `inputs` is not simulated, or rendering fails.
pub fn simulated_plates(simulator: &Simulator, inputs: &Rig) -> Result<Vec<Option<Image>>> {
    let plate = |camera: &Camera| -> Result<Option<Image>> {
        let slot = simulator.rig().slot(&camera.id).context("the input cameras are the simulator's")?;
        let plate = simulator.plate(slot)?;
        Ok(Some(Image::new(plate.width(), plate.height(), plate.format(), plate.bytes().to_vec())?))
    };
    inputs.cameras.iter().map(plate).collect()
}
